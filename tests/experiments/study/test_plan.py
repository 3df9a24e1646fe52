"""Plan of a study, made before anything runs: combinations, sample times, references."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.study.plan import Plan, Request, make_plan
from lyra_petsc.experiments.study.study_runner import (
    choose_references,
    make_chains,
    physical_overrides,
    refines_time,
)
from lyra_petsc.scene.schema import INTEGRATORS

pytest.importorskip("scipy")

SCENE = """\
mesh: {grid: {width: 1.0, height: 0.5, nx: 4, ny: 2}}
material: {density: 0.2, membrane: {c11: 800, c22: 800, c12: 160, c33: 240}}
gravity: [0, 0, -9.81]
"""
HELD = SCENE + "handles: [{group: left}]\nprobes: {tip: {group: right}}\n"
MOVING = "time: {end: 0.1, step: 0.01}\noutput: {every: 0.02}\n"


def plan_of(folder: Path, text: str, *vary: str, **more: Any) -> Plan:
    path = folder / "scene.yaml"
    path.write_text(text, encoding="utf-8")
    return make_plan(Request(str(path), vary=vary, **more))


def test_without_vary_every_integrator_and_halved_steps(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, HELD + MOVING)
    assert [axis.key for axis in plan.axes] == ["integrator", "dt"]
    assert plan.axes[0].values == INTEGRATORS
    assert plan.axes[1].values == (0.02, 0.01, 0.005)
    assert any("no --vary" in note for note in plan.notes)


def test_without_vary_tolerances_or_meshes(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, HELD + "time: {end: 0.1, step: auto, tolerance: 1.0e-3}\n")
    assert [axis.key for axis in plan.axes] == ["integrator", "tolerance"]
    assert plan.axes[1].values == pytest.approx((4e-3, 1e-3, 2.5e-4))
    plan = plan_of(tmp_path, HELD + "time: {analysis: static}\n")
    assert [axis.key for axis in plan.axes] == ["mesh"]
    assert plan.axes[0].values == (0.5, 0.25, 0.125)
    assert plan.sample_times() == [0.0, 1.0]


def test_sample_times(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, HELD + "time: {end: 0.05, step: 0.01}\noutput: {every: 0.02}\n", "dt=0.01")
    assert plan.sample_times() == pytest.approx([0.0, 0.02, 0.04, 0.05])
    plan = plan_of(tmp_path, HELD + "time: {end: 0.1, step: 0.01}\noutput: {every: null}\n", "dt=0.02,0.01")
    assert plan.interval == 0.02
    assert any("every 20 ms instead" in note for note in plan.notes)


def test_steps_that_do_not_divide_the_sample_interval_are_noted(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, HELD + MOVING, "dt=0.04,0.015,0.01")
    assert any("Δt 40 ms, 15 ms does not divide" in note for note in plan.notes)


def test_scenes_of_combinations(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, HELD + MOVING, "dt=0.01", "ksp_rtol=1e-4", "mesh=0.125", "integrator=bdf2")
    scene = plan.scene(plan.combinations[0])
    assert scene.time.step == 0.01
    assert scene.time.integrator == "bdf2"
    assert scene.petsc == {"ksp_rtol": 1e-4}
    assert scene.mesh[0].grid is not None
    assert (scene.mesh[0].grid.nx, scene.mesh[0].grid.ny) == (8, 4)
    plan = plan_of(tmp_path, HELD + "time: {end: 1, step: 0.1, integrator: alpha2, spectral_radius: 0.2}\n",
                   "integrator=alpha2,bdf2")  # fmt: skip
    assert [plan.scene(c).time.spectral_radius for c in plan.combinations] == [0.2, None]
    plan = plan_of(tmp_path, HELD + "time: {end: 1, step: auto, tolerance: 0.01}\n", "dt=0.1")
    assert plan.scene(plan.combinations[0]).time.tolerance is None
    plan = plan_of(tmp_path, HELD + MOVING, "tolerance=0.01")
    assert plan.scene(plan.combinations[0]).time.step == "auto"


def test_vertices_by_number_are_noted_when_meshes_vary(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, SCENE + MOVING + "handles: [{nodes: [0]}]\n", "mesh=0.25,0.125")
    assert any("handles[0]: vertices picked by number" in note for note in plan.notes)


@pytest.mark.parametrize(
    ("vary", "words"),
    [
        ("dt=-0.01", "must be > 0"),
        ("time.tolerence=1e-3", "did you mean 'tolerance'"),
        ("mesh=0.25,0.26", "give the same grid"),
        ("mesh=-1", "must be > 0"),
        ("max_iterations=0", "max_iterations"),
        ("output.every=0.1,0.2", "cannot vary"),
        ("time.end=0.1,0.2", "cannot vary"),
        ("handles[3].until=1", "handles"),
    ],
)
def test_invalid_values_are_refused(tmp_path: Path, vary: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        plan_of(tmp_path, HELD + MOVING, vary)


def test_element_sizes_of_mesh_files_cannot_vary(tmp_path: Path) -> None:
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    text = HELD.replace("{grid: {width: 1.0, height: 0.5, nx: 4, ny: 2}}", "{file: one.obj}")
    with pytest.raises(InputError, match=r"one\.obj comes with its elements"):
        plan_of(tmp_path, text.replace("handles: [{group: left}]\n", "") + MOVING, "mesh=0.1")


def test_the_reference_is_exact_if_an_exact_motion_applies(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, SCENE + MOVING, "dt=0.01")
    (chosen,) = choose_references(plan).values()
    assert chosen.kind == "exact"
    assert "free-fall" in chosen.description
    plan = plan_of(tmp_path, HELD + MOVING, "dt=0.01")
    (chosen,) = choose_references(plan).values()
    assert chosen.kind == "finer"


def test_every_physical_scene_has_a_reference_of_its_own(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, SCENE + MOVING, "gravity=[0,0,-9.81],[0,0,-1.62]", "dt=0.02,0.01")
    chosen = choose_references(plan)
    assert len(chosen) == 2
    assert {combination.physics for combination in plan.combinations} == set(chosen)
    motions = [one.motion for one in chosen.values()]
    assert all(motion is not None for motion in motions)
    assert len({motion.energies(0.1).potential for motion in motions if motion}) == 2
    assert "gravity=[0,0,-1.62]" in physical_overrides(plan, list(chosen)[1])
    with pytest.raises(InputError, match="one run cannot be the reference"):
        choose_references(
            plan_of(tmp_path, SCENE + MOVING, "gravity=[0,0,-9],[0,0,-1]", reference=f"run:{tmp_path}")
        )


@pytest.mark.parametrize("reference", ["exact", "exact:", "run:", "best", "auto:x", "finer:x", ""])
def test_invalid_references_are_refused(tmp_path: Path, reference: str) -> None:
    with pytest.raises(InputError, match="must be auto, finer, exact:NAME or run:DIR"):
        choose_references(plan_of(tmp_path, HELD + MOVING, "dt=0.01", reference=reference))


def test_the_finer_run_is_finer_in_the_varied_keys(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, HELD + MOVING, "dt=0.02,0.01")
    assert refines_time(plan)
    chains = make_chains(plan, [], 0.01, "bdf2")
    assert "time.step=0.0025" in chains[0].levels[0].overrides
    assert "time.integrator=bdf2" in chains[0].levels[0].overrides
    assert "solver.force_tolerance=1e-08" in chains[0].levels[0].overrides
    (chain,) = chains
    assert [level.name for level in chain.levels] == [
        "reference-bdf2-dt0.0025", "reference-bdf2-dt0.005", "reference-bdf2-dt0.01"
    ]  # fmt: skip
    # 30 ms would not divide the 20 ms between samples: its quarter is rounded to a divisor
    assert "time.step=0.005" in make_chains(plan, [], 0.03, "bdf2")[0].levels[0].overrides


def test_meshes_alone_are_compared_at_the_scenes_own_steps(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, HELD + MOVING, "mesh=0.25,0.125")
    assert not refines_time(plan)
    chains = make_chains(plan, [], None, "")
    assert "mesh[0].grid.nx=16" in chains[0].levels[0].overrides
    assert not any(text.startswith("time.") for text in chains[0].levels[0].overrides)
    assert [level.name for level in chains[0].levels] == [
        "reference-h0.0625", "reference-h0.125", "reference-h0.25"
    ]  # fmt: skip


def test_meshes_and_steps_are_refined_together(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, HELD + MOVING, "mesh=0.25,0.125", "dt=0.02,0.01", "ksp_rtol=1e-2,1e-4")
    chains = make_chains(plan, [], 0.01, "alpha2")
    assert chains[0].levels[0].name == "reference-alpha2-dt0.0025-h0.0625"
    assert len({level.name for chain in chains for level in chain.levels}) == 5
    assert "petsc.ksp_rtol=1e-06" in chains[0].levels[0].overrides
