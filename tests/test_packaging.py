"""The wheel has every package, the scenes and the meshes."""

from __future__ import annotations

from pathlib import Path

import pytest

tomllib = pytest.importorskip("tomllib")  # Python 3.11

ROOT = Path(__file__).resolve().parent.parent


def test_every_package_is_in_the_wheel() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    packages = {
        ".".join(init.parent.relative_to(ROOT).parts) for init in (ROOT / "lyra_petsc").rglob("__init__.py")
    }
    assert set(listed) == packages | {"lyra_petsc.configs", "lyra_petsc.meshes"}
    assert len(listed) == len(set(listed))
