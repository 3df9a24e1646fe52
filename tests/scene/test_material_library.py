"""Conventions of the material library, compared with values computed by hand from the published tables."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.scene.material_block import Material
from lyra_petsc.scene.materials.library import (
    PROJECTION_FLOOR,
    ShellMaterial,
    material_names,
    resolve_material,
)


def shell(**keys: object) -> ShellMaterial:
    return resolve_material(Material.model_validate(keys))[0]


@pytest.mark.parametrize("name", material_names())
def test_every_material_can_be_simulated(name: str) -> None:
    material, notes = resolve_material(Material(cloth=name))
    assert material.density > 0
    assert material.c33 > 0
    c = np.array([[material.c11, material.c12], [material.c12, material.c22]])
    assert np.linalg.eigvalsh(c).min() > 0
    assert min(material.bending) > 0
    assert bool(notes) == (name == "navy-sparkle-sweat")


def test_factors_of_measured_cloths() -> None:
    cloth = shell(cloth="gray-interlock")
    assert cloth.density == 0.187
    assert cloth.c11 == pytest.approx(33.187664, rel=1e-12)  # 2 × 16.593832
    assert cloth.c12 == pytest.approx(-29.39198, rel=1e-12)  # kept: 33.19 × 68.95 > 29.39²
    assert cloth.c22 == pytest.approx(68.954246, rel=1e-12)
    assert cloth.c33 == pytest.approx(36.860302, rel=1e-12)  # engineering shear: not doubled
    assert cloth.bending == pytest.approx((5.7979245e-06, 6.187491e-06, 3.566906e-06), rel=1e-12)


def test_cloth_of_the_papers_scene() -> None:
    paper = shell(cloth="paper")
    assert (paper.density, paper.c11, paper.c12, paper.c22, paper.c33) == (0.1, 1e6, 0.0, 1e6, 5e5)
    assert paper.bending == pytest.approx((1e-4,) * 3, rel=1e-15)


def test_isotropic_material_of_the_original_lyra() -> None:
    sheet = shell(cloth="isotropic")
    assert (sheet.density, sheet.c11, sheet.c12, sheet.c22, sheet.c33) == (0.1, 80.0, 0.0, 80.0, 40.0)
    assert sheet.bending == pytest.approx((5e-6,) * 3, rel=1e-15)


def test_indefinite_cloths_are_projected() -> None:
    material, (note,) = resolve_material(Material(cloth="navy-sparkle-sweat"))
    measured = 2 * np.array([[12.486332, -19.875324], [-19.875324, 3.272434]])
    values, vectors = np.linalg.eigh(measured)
    assert values[0] < 0
    expected = vectors @ np.diag([PROJECTION_FLOOR * values[1], values[1]]) @ vectors.T
    got = np.array([[material.c11, material.c12], [material.c12, material.c22]])
    assert got == pytest.approx(expected, rel=1e-12)
    assert material.c33 == 17.616289
    assert "navy-sparkle-sweat" in note
    assert "projected" in note


def test_isotropic_sheets_are_in_plane_stress() -> None:
    sheet = shell(young=1e6, poisson=0.25, thickness=0.01, density=0.5)
    # E h = 1e4 N/m; 1 − ν² = 15/16; E h³ = 1 N·m
    assert sheet.c11 == sheet.c22 == pytest.approx(1e4 * 16 / 15, rel=1e-14)
    assert sheet.c12 == pytest.approx(0.25e4 * 16 / 15, rel=1e-14)
    assert sheet.c33 == pytest.approx(4e3, rel=1e-14)
    assert sheet.bending == pytest.approx((16 / 15 / 12,) * 3, rel=1e-14)
    assert sheet.density == 0.5


def test_density_of_engineering_materials_is_per_area() -> None:
    assert shell(cloth="steel-sheet-500um").density == pytest.approx(7850 * 0.5e-3, rel=1e-14)


def test_given_constants_are_unchanged() -> None:
    membrane = {"c11": 120, "c22": 110, "c12": -40, "c33": 30}
    sheet = shell(density=0.2, membrane=membrane)
    assert (sheet.c11, sheet.c22, sheet.c12, sheet.c33) == (120.0, 110.0, -40.0, 30.0)
    assert sheet.bending == (0.0, 0.0, 0.0)
    assert shell(density=0.2, membrane=membrane, bending=1e-5).bending == (1e-5,) * 3
    assert shell(density=0.2, membrane=membrane, bending=[1, 2, 3]).bending == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    "keys",
    [
        {"cloth": "gray-interlock"},
        {"cloth": "pet-film-100um"},
        {"young": 1e6, "poisson": 0.3, "thickness": 1e-3, "density": 1},
        {"density": 1, "membrane": {"c11": 3, "c22": 2, "c12": 1, "c33": 1}, "bending": [1, 2, 3]},
    ],
    ids=lambda keys: next(iter(keys)),
)
def test_scale_factors_apply_to_each_kind_of_material(keys: dict[str, object]) -> None:
    plain = shell(**keys)
    scaled = shell(
        **keys, density_scale=3, stretching_scale=5, bending_scale=7, thicken=2,
        damping=0.03, warp_degrees=30, rest_curvature=[1, 2, 3],
    )  # fmt: skip
    assert scaled.density == pytest.approx(plain.density * 3 * 2, rel=1e-14)
    for name in ("c11", "c12", "c22", "c33"):
        assert getattr(scaled, name) == pytest.approx(getattr(plain, name) * 5 * 2, rel=1e-14)
    assert scaled.bending == pytest.approx([b * 7 * 8 for b in plain.bending], rel=1e-14)
    assert (scaled.damping, scaled.warp_degrees, scaled.rest_curvature) == (0.03, 30.0, (1.0, 2.0, 3.0))
    assert (plain.damping, plain.warp_degrees, plain.rest_curvature) == (0.0, 0.0, None)


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_scaled_values_outside_the_range_are_refused(scale: float) -> None:
    with pytest.raises(InputError, match=r"too large|too small"):
        shell(cloth="paper", density_scale=scale, stretching_scale=scale, thicken=scale)
    assert math.isfinite(shell(cloth="paper", thicken=1e3).c11)
