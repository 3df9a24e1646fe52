"""The keys of plastic bending: defaults, refusals, thickness."""

from __future__ import annotations

from typing import Any

import pytest
from physics import grid

from lyra_petsc.errors import InputError
from lyra_petsc.scene.load import scene_of
from lyra_petsc.scene.materials.library import ShellMaterial, resolve_material

NUMBERS: dict[str, Any] = {"density": 0.1, "membrane": {"c11": 1e4, "c22": 1e4, "c12": 0.0, "c33": 5e3}}


def shell_of(keys: dict[str, Any]) -> ShellMaterial:
    content = {"mesh": grid(1.0, 1.0, 2, 2), "material": NUMBERS | keys, "time": {"end": 1.0, "step": 0.1}}
    return resolve_material(scene_of(content).material[0])[0]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"bending": 1e-3, "yield_curvature": 0.0}, "material.yield_curvature: must be > 0"),
        ({"bending": 1e-3, "yield_curvature": 10.0, "hardening": 1.0}, "material.hardening: must be < 1"),
        ({"bending": 1e-3, "yield_curvature": 10.0, "hardening": -0.1}, "material.hardening: must be >= 0"),
        ({"bending": 1e-3, "hardening": 0.1}, "begins at yield_curvature; give that, too"),
        ({"yield_curvature": 10.0}, "yield_curvature needs a bending stiffness"),
    ],
)
def test_wrong_numbers_are_refused(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        shell_of(keys)


def test_a_thicker_sheet_yields_at_less_curvature() -> None:
    keys = {"bending": 1e-3, "yield_curvature": 10.0, "thicken": 2.0}
    shell = shell_of(keys)
    assert (shell.yield_curvature, shell.hardening) == (5.0, 0.0)
