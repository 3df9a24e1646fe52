"""Numbers in wrong units are noted with the likely mistake; right ones are not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from physics import grid, scene_of

from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.materials.library import material_names
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.units_check import figures, unit_notes

WOVEN = {"density": 0.15, "membrane": {"c11": 800, "c22": 700, "c12": 160, "c33": 240}, "bending": 2e-5}
SOFT = {key: WOVEN["membrane"][key] / 1e3 for key in ("c11", "c22", "c12", "c33")}  # type: ignore[index]
FILM = {"young": 2.0e9, "poisson": 0.3, "thickness": 1e-4, "density": 0.14}
STEEL = {"young": 2.1e11, "poisson": 0.3, "thickness": 1e-2, "density": 78.5}


def rest_of(material: Any, size: float = 1.0, scale: float = 1.0, **more: Any) -> RestShape:
    source = grid(size, size, 2, 2) | {"transform": {"scale": scale}}
    scene = scene_of({"mesh": source, "material": material, "gravity": [0, 0, -9.81]} | more)
    return RestShape(scene, build_scene_mesh(scene))


@pytest.mark.parametrize(
    ("material", "words"),
    [
        (WOVEN | {"density": 150}, "150 g/m² is 0.15 kg/m²"),
        ({"density": 150, "membrane": WOVEN["membrane"]}, "heavier than any cloth"),
        (WOVEN | {"bending": 20}, "lighter than any cloth: is bending in N·mm"),
        (WOVEN | {"bending": 0.05}, "gf·cm²/cm"),
        (WOVEN | {"membrane": SOFT}, "membrane in N/mm"),
        ({"density": 0.15, "membrane": {k: v / 1e3 for k, v in SOFT.items()}}, "by its own weight"),
        (
            WOVEN | {"membrane": {"c11": 2e9, "c22": 2e9, "c12": 6e8, "c33": 7e8}},
            "modulus times the thickness",
        ),
        (FILM | {"young": 2.0}, "young in GPa"),
        (FILM | {"density": 1400}, "1400 kg/m³ times the thickness is 0.14 kg/m²"),
        (FILM | {"thickness": 0.1}, "thickness in mm"),
        (STEEL | {"density": 7850}, "times the thickness is 78.5 kg/m²"),
    ],
)
def test_a_number_in_another_unit_is_noted(material: dict[str, Any], words: str) -> None:
    (note,) = unit_notes(rest_of(material))
    assert note.startswith("material: ")
    assert words in note


@pytest.mark.parametrize("size", [200.0, 1000.0])
def test_a_mesh_in_millimetres_is_noted(size: float) -> None:
    for material in (WOVEN, FILM, {"cloth": "gray-interlock"}):
        (note,) = unit_notes(rest_of(material, size))
        assert "if its file is in millimetres, give it transform: {scale: 0.001}" in note
        assert unit_notes(rest_of(material, size, scale=0.001)) == []


def test_materials_are_named_by_number_where_there_are_several() -> None:
    sheets = [grid(1, 1, 2, 2) | {"name": "a"}, grid(1, 1, 2, 2) | {"name": "b"}]
    scene = scene_of({"mesh": sheets, "material": [WOVEN, FILM | {"young": 2.0, "group": "b"}]})
    (note,) = unit_notes(RestShape(scene, build_scene_mesh(scene)))
    assert note.startswith("material[1]: a modulus of")


@pytest.mark.parametrize("name", material_names())
def test_nothing_is_noted_for_materials_of_the_library(name: str) -> None:
    for change in ({}, {"thicken": 0.3}, {"thicken": 3.0}, {"stretching_scale": 10.0}):
        assert unit_notes(rest_of({"cloth": name} | change)) == []


@pytest.mark.parametrize("material", [WOVEN, FILM, STEEL, {"density": 0.15, "membrane": WOVEN["membrane"]}])
def test_nothing_is_noted_for_right_units(material: dict[str, Any]) -> None:
    assert unit_notes(rest_of(material)) == []
    assert unit_notes(rest_of(material, 1e-3)) == []
    static = rest_of(material | {"density": 1.0e4}, gravity=[0, 0, 0], time={"analysis": "static"})
    assert unit_notes(static) == []  # where the mass has no effect


def test_nothing_is_noted_for_the_shipped_scenes() -> None:
    for path in sorted((Path(__file__).parents[2] / "configs").glob("*.yaml")):
        scene = load_scene(path)
        if not scene.has_scripts:
            assert unit_notes(RestShape(scene, build_scene_mesh(scene))) == [], path


def test_figures_of_a_homogeneous_sheet() -> None:
    (found,) = figures(rest_of(FILM))
    assert found.thickness == pytest.approx(1e-4)
    stiffness = 2e9 * 1e-12 / 12 / (1 - 0.09)
    assert found.bending_length == pytest.approx((stiffness / (0.14 * 9.81)) ** (1 / 3))
    assert str(found) == "0.14 kg/m², 1.4e+03 kg/m³ if 0.1 mm thick, bending length 51.1 mm"
    (found,) = figures(rest_of({"density": 0.15, "membrane": WOVEN["membrane"]}, gravity=[0, 0, 0]))
    assert str(found) == "0.15 kg/m², bending length 0 mm"
    assert np.isfinite(found.bending_length)


def test_the_largest_gravity_of_a_curve_counts() -> None:
    ramp = [[0, [0, 0, 0]], [1, [0, 0, -9.81]], [2, [0, 0, 0]]]
    (plain,), (varying,) = (figures(rest_of(WOVEN, gravity=g)) for g in ([0, 0, -9.81], ramp))
    assert varying == plain
    (note,) = unit_notes(rest_of(WOVEN | {"membrane": SOFT}, gravity=ramp))
    assert "membrane in N/mm" in note
