"""Cases of ``stress``: the scenes that they make, and their known answers."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.stress.cases import FAMILIES, selected
from lyra_petsc.experiments.stress.stress_scenes import (
    NotApplicable,
    Scope,
    hanging_sheet,
    move_handles,
    scale,
    set_wind,
    setting_of,
)
from lyra_petsc.scene.schema import Scene

CLOTH = """\
mesh: {grid: {width: 2.0, height: 1.0, nx: 4, ny: 2}}
material:
- {cloth: gray-interlock, stretching_scale: 2.0}
- {group: sheet, cloth: gray-interlock, damping: 0.1}
gravity: [0, -9.81, 0]
handles: [{nodes: [0, 4], until: 0.5, fade: 0.1}, {nodes: [2], from: 1.0}]
initial: {noise: 0.001}
time: {end: 4, step: auto}
output: {every: 0.1}
probes: {tip: {nodes: [3]}}
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.yaml"
    path.write_text(CLOTH, encoding="utf-8")
    return path


def test_names_are_unique_and_cases_have_titles() -> None:
    families = FAMILIES.all()
    assert [family.name for family in families] == list(FAMILIES.entries)
    names = [case.name for family in families for case in family.cases]
    assert len(names) == len(set(names))
    assert not set(names) & set(FAMILIES.entries)
    assert all(family.title and all(case.title for case in family.cases) for family in families)


def test_levels_are_nested_and_the_usual_one_has_every_family() -> None:
    quick, usual, full = (
        [case.name for case in selected([], level)] for level in (Scope.QUICK, Scope.USUAL, Scope.FULL)
    )
    assert set(quick) < set(usual) < set(full)
    assert {case.family for case in selected([], Scope.USUAL)} == set(FAMILIES.entries) - {"products"}


def test_a_case_is_found_by_name_at_any_level_and_a_family_by_level() -> None:
    assert [case.name for case in selected(["plate-1e8-1e3-1ms"], Scope.QUICK)] == ["plate-1e8-1e3-1ms"]
    assert [case.name for case in selected(["wind"], Scope.QUICK)] == ["wind-200"]
    assert len(selected(["wind"], Scope.USUAL)) == 2


def test_a_family_without_a_case_at_the_level_is_refused() -> None:
    with pytest.raises(InputError, match="--full"):
        selected(["products"], Scope.QUICK)


@pytest.mark.parametrize("name", ["stiff-1e7-5ms", "winds"])
def test_an_unknown_name_is_refused(name: str) -> None:
    with pytest.raises(InputError, match="did you mean"):
        selected([name], Scope.QUICK)


@pytest.mark.parametrize("of_user", [False, True])
def test_every_case_is_a_scene(comm: MPI.Comm, scene: Path, of_user: bool) -> None:
    setting = setting_of(scene if of_user else None, (), Scope.QUICK)
    count, left_out = 0, []
    with Bench(comm, direct=False) as bench:
        for case in selected([], Scope.FULL):
            try:
                content = case.content(setting, bench)
            except NotApplicable:
                left_out.append(case.name)
                continue
            checked = Scene.model_validate(content)
            assert checked.time.end == pytest.approx(case.steps * float(checked.time.step))
            assert checked.solver == Scene.model_validate(setting.base).solver
            assert checked.petsc == {}
            count += 1
    assert setting.base == setting_of(scene if of_user else None, (), Scope.QUICK).base
    assert count > 200
    assert bool(left_out) is of_user


def test_a_given_scene_keeps_its_materials_and_mesh(scene: Path) -> None:
    setting = setting_of(scene, ("gravity=[0, 0, -1]",), Scope.QUICK)
    assert setting.base["gravity"] == [0, 0, -1]
    assert setting.step == 0.005
    assert not {"output", "probes"} & setting.base.keys()
    scaled = scale(setting.content(), stretching=1e3, bending=0.0, density=10.0)["material"]
    assert [block["stretching_scale"] for block in scaled] == [2e3, 1e3]
    assert [block["bending_scale"] for block in scaled] == [0.0, 0.0]
    assert [block["density_scale"] for block in scaled] == [10.0, 10.0]


def test_a_static_scene_is_refused(scene: Path) -> None:
    scene.write_text(CLOTH.replace("{end: 4, step: auto}", "{analysis: static}"), encoding="utf-8")
    with pytest.raises(InputError, match="analysis"):
        setting_of(scene, (), Scope.QUICK)


def test_wind_has_the_speed_of_the_case_and_the_air_of_the_scene() -> None:
    content = set_wind(
        hanging_sheet(4) | {"wind": {"velocity": [1, 0, 0], "density": 0.5, "drag": 0.1}}, 50.0
    )["wind"]
    assert math.hypot(*content["velocity"]) == pytest.approx(50.0)
    assert (content["density"], content["drag"]) == (0.5, 0.1)


def test_handles_move_to_the_end_and_a_sheet_without_handles_is_refused() -> None:
    content = hanging_sheet(4)
    content["handles"][0] |= {"until": 1.0, "fade": 0.1}
    moved_handle = move_handles(content, [{"time": 0.0}])["handles"][0]
    assert moved_handle["motion"] == "stress"
    assert not {"until", "fade"} & moved_handle.keys()
    with pytest.raises(NotApplicable):
        move_handles(hanging_sheet(4) | {"handles": []}, [{"time": 0.0}])


# -- start shapes --------------------------------------------------------------------------------------


def flat(n: int = 40) -> np.ndarray:
    i, j = np.meshgrid(np.arange(n + 1) / n, np.arange(n + 1) / n)
    return np.column_stack([i.ravel(), j.ravel(), 0.0 * i.ravel()])


@pytest.mark.parametrize("name", ["crumpled", "folded", "directors-folded"])
def test_folds_do_not_stretch_the_sheet(name: str) -> None:
    [case] = selected([name], Scope.FULL)
    assert case.shape is not None
    x = flat()
    y = case.shape(x, 0.025)
    one, other = np.random.default_rng(0).integers(0, len(x), (2, 500))
    before, after = (np.linalg.norm(at[one] - at[other], axis=1) for at in (x, y))
    assert np.all(after <= before + 1e-12)
    assert after.max() < 0.9 * before.max()
    rows = np.linalg.norm(np.diff(y.reshape(41, 41, 3), axis=1), axis=2)
    assert np.median(rows) == pytest.approx(0.025, rel=1e-3)
