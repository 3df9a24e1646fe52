"""Friction within the fabric, and numbers of KES reports, from the scene to the constants of a shell."""

from __future__ import annotations

from typing import Any

import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.load import scene_of
from lyra_petsc.scene.materials.library import ShellMaterial, resolve_material
from lyra_petsc.scene.text import parse_yaml

pytestmark = pytest.mark.quick

SCENE = {"mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": 1, "ny": 1}}, "time": {"end": 1.0, "step": 0.1}}
NUMBERS = {"density": 0.2, "membrane": {"c11": 900.0, "c22": 800.0, "c12": 0.0}}
SHEET = {"young": 1e6, "poisson": 0.3, "thickness": 1e-3}
CURVES = {direction: [[0.1, 10.0]] for direction in ("warp", "weft", "shear")}
REPORT = {"B": 0.1, "2HB": 0.05, "G": 0.6, "2HG": 1.5}


def shell_of(**keys: Any) -> ShellMaterial:
    return resolve_material(scene_of(SCENE | {"material": keys}).material[0])[0]


@pytest.mark.parametrize("model", ["hinge", "midedge"])
def test_a_report_is_converted_from_its_own_units(model: str) -> None:
    kes = {name: value for name, value in REPORT.items() if name != "2HB" or model == "midedge"}
    shell = shell_of(**NUMBERS, bending_model=model, kes=kes)
    assert shell.bending == pytest.approx((9.80665e-6, 9.80665e-6, 9.80665e-6))
    assert shell.c33 == pytest.approx(0.6 * 0.980665 * 57.29577951)
    assert shell.friction_force == pytest.approx(0.75 * 0.980665)
    if model == "midedge":
        assert shell.friction_moment == pytest.approx((0.025 * 9.80665e-3,) * 2)
        assert shell.plate == pytest.approx((9.80665e-6, 0.0, 9.80665e-6, 0.5 * 9.80665e-6))


def test_warp_and_weft() -> None:
    kes = {"B": [0.2, 0.1]}
    hinge = shell_of(cloth="gray-interlock", kes=kes)
    midedge = shell_of(cloth="gray-interlock", kes=kes | {"2HB": [0.06, 0.02]})
    warp, weft = 0.2 * 9.80665e-5, 0.1 * 9.80665e-5
    assert hinge.bending == pytest.approx((weft, 0.5 * (warp + weft), warp))  # of hinges along the warp
    assert midedge.plate[:3] == pytest.approx((warp, 0.0, weft))
    assert midedge.friction_moment == pytest.approx((0.03 * 9.80665e-3, 0.01 * 9.80665e-3))


def test_friction_is_scaled_like_bending_and_membrane() -> None:
    shell = shell_of(
        **(NUMBERS | {"membrane": NUMBERS["membrane"] | {"c33": 1.0}}),  # type: ignore[operator]
        bending=1e-5,
        friction_moment=1e-4,
        friction_force=0.5,
        bending_scale=2.0,
        stretching_scale=3.0,
    )
    assert shell.friction_moment == (2e-4, 2e-4)
    assert shell.friction_force == 1.5


@pytest.mark.parametrize(
    ("moment", "model"), [(0, "hinge"), ([0, 0], "hinge"), (1e-4, "midedge"), ([0, 1], "midedge")]
)
def test_friction_in_bending_selects_midedge(moment: Any, model: str) -> None:
    membrane = NUMBERS["membrane"] | {"c33": 1.0}  # type: ignore[operator]
    scene = scene_of(
        SCENE | {"material": NUMBERS | {"membrane": membrane, "bending": 1e-5, "friction_moment": moment}}
    )
    assert scene.material[0].bending_model == model
    assert scene_of(parse_yaml(dump_scene(scene), file=None)).material == scene.material


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"bending": 1e-5, "kes": REPORT}, "kes has B"),
        ({"friction_moment": 1e-4, "kes": REPORT}, "kes has 2HB"),
        ({"friction_force": 1.0, "kes": REPORT}, "kes has 2HG"),
        ({"kes": {"G": 0.5, "2HB": 0.1}}, "friction_moment needs a bending stiffness"),
        ({"kes": {"B": 0.0, "G": 1.0}}, "must be > 0"),
        ({"kes": {"HB": 0.1, "G": 1.0}}, "unknown key"),
        ({"kes": REPORT, "bending_model": "hinge"}, "is for bending_model: midedge"),
        (
            {"kes": {"G": 1.0}, "bending": 1e-5, "friction_moment": [0, 1e-4], "bending_model": "hinge"},
            "2HB of kes",
        ),
        ({"bending": 1e-5, "friction_moment": -1.0, "kes": {"G": 1.0}}, "must be >= 0"),
        ({"kes": REPORT | {"B": 100.0}}, "kes.B: must be 0.0001 to 50 gf·cm²/cm as of fabrics, not 100"),
        ({"kes": REPORT | {"B": [0.1, 1e-5]}}, "not 1e-05"),
        ({"kes": REPORT | {"G": 500.0}}, "kes.G: must be 0.001 to 100"),
        ({"kes": REPORT | {"2HB": 5.0}}, "kes.2HB: must be at most 5 B = 0.5, not 5"),
        ({"kes": REPORT | {"2HG": 50.0}}, "kes.2HG: must be at most 16 G = 9.6"),
        ({"membrane": {"c11": 9.0, "c22": 9.0, "c12": 0.0, "c33": 3.0}, "kes": REPORT}, "the place of c33"),
        ({"membrane": None, "law": CURVES, "kes": REPORT}, "the place of the curve of shear"),
        ({"membrane": None, **SHEET, "kes": {"B": 0.1}}, "has B, which young, poisson and thickness give"),
        ({"membrane": None, **SHEET, "kes": {"G": 0.1}}, "has G, which young, poisson and thickness give"),
    ],
)
def test_contradictions_are_refused(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        shell_of(**(NUMBERS | keys))
