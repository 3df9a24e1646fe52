"""The wheel holds every room, the scenes and the meshes."""

from __future__ import annotations

from pathlib import Path

import pytest

tomllib = pytest.importorskip("tomllib")  # Python 3.11

ROOT = Path(__file__).resolve().parent.parent


def test_every_room_is_packaged() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    rooms = {
        ".".join(init.parent.relative_to(ROOT).parts) for init in (ROOT / "lyra_petsc").rglob("__init__.py")
    }
    assert set(listed) == rooms | {"lyra_petsc.configs", "lyra_petsc.meshes"}
    assert len(listed) == len(set(listed))
