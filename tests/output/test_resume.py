"""A resumed run equals an uninterrupted one, with every integrator and kind of steps."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, grid
from resumed_runs import OF_THE_SOLVER, kept, simulate_until, summary, table

from lyra_petsc.errors import InputError
from lyra_petsc.output.read_run import StoredRun, stored_states
from lyra_petsc.scene.schema import INTEGRATORS
from lyra_petsc.show.obstacle_surfaces import run_obstacles

SCENE: dict[str, Any] = {
    "mesh": grid(0.6, 0.4, 5, 4, "alternating"),
    "material": CLOTH | {"bending": 1e-4, "damping": 0.01},
    "gravity": [0, 0, -9.81],
    "wind": {"velocity": [[0.0, [1, 2, 0]], [0.044, [2, 1, 0]], [0.2, [1, 2, 0]]], "density": 1.2},
    "handles": [
        {"nodes": [0, 5], "motion": "lift"},
        {"nodes": [24], "until": 0.055},
        {"nodes": [29], "from": 0.03, "stiffness": 20.0, "motion": "lift"},
    ],
    "loads": [
        {"nodes": [14], "force": [[0.0, [0, 0, 0]], [0.08, [0, 0.1, 0]]], "from": 0.03, "until": 0.055}
    ],
    "motions": {"lift": [{"time": 0}, {"time": 0.1, "translate": [0, 0, 0.05]}]},
    "output": {"every": 0.02, "reactions": True, "fields": ["velocity", "stress"]},
    "probes": {"corner": {"nodes": [24, 29]}},
}

CONTACT: dict[str, Any] = {
    "mesh": [SCENE["mesh"], grid(0.2, 0.2, 2, 2) | {"transform": {"translate": [0.2, 0.1, -0.012]}}],
    "contact": {"gap": 0.005, "friction": 0.3},
    "obstacles": {"floor": {"plane": {"point": [0, 0, -0.02], "normal": [0, 0, 1]}}},
}
"""Changes by which the sheet falls on a smaller one, and both on a floor."""

PLATE: dict[str, Any] = {
    "material": {"young": 1e6, "poisson": 0.3, "thickness": 2e-3, "density": 1.0},
    "handles": [{"box": [[-1, -1, -1], [1e-9, 1, 1]], "clamp": True}],
    "gravity": [1.0, 0.5, -9.0],
    "loads": [{"nodes": [29], "force": [[0.0, [0, 0, 0]], [0.35, [0, 0, 2.0]], [0.8, [0, 0, 0]]]}],
}
"""Changes to a cantilever; its load steps are also extrapolated along tangents."""

LANDING: dict[str, Any] = {
    "mesh": grid(0.4, 0.08, 12, 2, "alternating") | {"transform": {"translate": [0, 0, 0.05]}},
    "material": CLOTH | {"bending": 1e-3, "density": 1.0},
    "handles": [{"box": [[-1, -1, -1], [0.05, 1, 1]]}],
    "contact": {"friction": 0.3, "gap": 2e-3, "self": False},
    "obstacles": {"floor": {"plane": {"point": [0, 0, 0], "normal": [0, 0, 1]}}},
    "probes": {"corner": {"nodes": [24, 29]}},
}
"""Changes to a strip that lands on a floor with friction."""

LENGTHS: dict[str, dict[str, Any]] = {"fixed": {"step": 0.004}, "auto": {"step": "auto", "tolerance": 2e-2}}
"""Kinds of steps."""

KINDS = [
    *(
        ", ".join(kind)
        for kind in itertools.product(INTEGRATORS, ("hinge", "midedge"), ("free", "contact"), LENGTHS)
    ),
    "static",
    "static, directors",
    "static, friction",
]
"""All combinations of integrator, bending model, contact and kind of steps; and static analyses."""


def scene_with(kind: str, end: float = 0.1) -> dict[str, Any]:
    if "static" in kind:
        scene = SCENE | {"time": {"analysis": "static", "step": 0.1}}
        del scene["wind"]  # which turns with the sheet, and takes ten times as long to balance
        del scene["loads"]
        scene |= PLATE if "directors" in kind else {}
        return scene | (LANDING if "friction" in kind else {})
    integrator, bending, contact, length = kind.split(", ")
    scene = SCENE | {"time": {"end": end, "integrator": integrator} | LENGTHS[length]}
    scene["material"] = scene["material"] | {"bending_model": bending}
    return scene | (CONTACT if contact == "contact" else {})


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


OF_EACH_RUN = ("versions", "wall_seconds", "resumed", "steps_of_this_run", "ranks", "partitioner")
"""Entries of summary.json about the last part of a run only."""


def flat(numbers: dict[str, Any], above: str = "") -> dict[str, float]:
    """Numbers of nested mappings, by path."""
    found: dict[str, float] = {}
    for name, value in numbers.items():
        path = f"{above}/{name}"
        found |= flat(value, path) if isinstance(value, dict) else {path: value}
    return found


def same_files(resumed: Path, straight: Path, tolerance: float, *, exact: bool = True) -> None:
    """Check that both folders have the same end, rows and states, and equal numbers in every column.

    With ``exact``, every sum is computed in the same order, and the solver gives equal digits.
    """
    mine, other = kept(resumed), kept(straight)
    assert mine.keys() == other.keys()
    for name in mine:
        unit = max(1.0, float(np.abs(other[name]).max()))
        np.testing.assert_allclose(mine[name], other[name], rtol=0, atol=tolerance * unit, err_msg=name)
    for name in ("history.csv", "probes.csv", "reactions.csv"):
        columns, others = table(resumed, name), table(straight, name)
        assert columns.keys() == others.keys()
        np.testing.assert_array_equal(columns["step"], np.arange(len(others["step"])), err_msg=name)
        for column, values in others.items():
            if exact or column not in OF_THE_SOLVER:
                unit = float(np.abs(values).max())
                within = 0.0 if column in OF_THE_SOLVER else max(tolerance * unit, 1e-15)
                np.testing.assert_allclose(columns[column], values, rtol=0, atol=within, err_msg=column)
    resumed_summary, other_summary = summary(resumed), summary(straight)
    assert resumed_summary.keys() == other_summary.keys()
    for key in resumed_summary.keys() - set(OF_EACH_RUN):
        if key == "energy_balance":  # sums of differences, relative to the scale of the energies
            mine_of, of_others = flat(resumed_summary[key] or {}), flat(other_summary[key] or {})
            assert mine_of == pytest.approx(of_others, rel=tolerance, abs=max(tolerance, 1e-12)), key
        elif isinstance(resumed_summary[key], float):
            assert resumed_summary[key] == pytest.approx(other_summary[key], rel=tolerance), key
        elif exact or key not in (*OF_THE_SOLVER, "petsc_options"):
            assert resumed_summary[key] == other_summary[key], key
    states = [(state.number, state.step) for state in stored_states(straight)]
    assert [(state.number, state.step) for state in stored_states(resumed)] == states
    mine, other = StoredRun(resumed), StoredRun(straight)
    np.testing.assert_allclose(mine.times, other.times, rtol=1e-9, atol=0)
    assert mine.fields == other.fields == ("velocity", "stress")


INTERRUPTIONS = [0.02, 0.03, 0.04, 0.055, 0.07]
"""Times [s] before, at and after those at which handles and loads begin and end."""


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_resumed_again_and_again_equals_an_uninterrupted_one(kind: str, tmp_path: Path) -> None:
    """Up to round-off, on the same ranks with a direct solver."""
    scene, straight, halted = scene_with(kind), tmp_path / "straight", tmp_path / "halted"
    end = simulate_until(MPI.COMM_SELF, scene, straight, None)
    # also before there is a history of two steps, and while it begins
    stops = {1, 2, *np.searchsorted(table(straight, "history.csv")["time"], INTERRUPTIONS).tolist()}
    for stop in sorted(stop for stop in stops if stop < end[0]):
        assert simulate_until(MPI.COMM_SELF, scene, halted, stop, resume=stop > 1)[0] == stop
    assert simulate_until(MPI.COMM_SELF, scene, halted, None, resume=True) == end
    # frames of directors are made anew from the shape, and pairs that are near are searched anew, by which
    # round-off may decide on an iteration
    exact = kind == "static" or "hinge, free" in kind
    same_files(halted, straight, 1e-11 if exact else 1e-9, exact=exact)


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param("bdf2, midedge, contact, fixed", marks=pytest.mark.parallel(3, alone=False)),
        pytest.param("semi-implicit, hinge, contact, fixed", marks=pytest.mark.parallel(2, alone=False)),
        pytest.param("alpha2, hinge, free, auto", marks=pytest.mark.parallel(2, alone=False)),
        pytest.param("static", marks=pytest.mark.parallel(2, alone=False)),
        pytest.param("static, directors", marks=pytest.mark.parallel(2, alone=False)),
    ],
)
def test_resumed_runs_agree_on_other_numbers_of_ranks(comm: MPI.Comm, kind: str, shared_tmp: Path) -> None:
    scene = scene_with(kind, 0.06)
    straight, halted, alone = (shared_tmp / name for name in ("straight", "halted", "alone"))
    end = simulate_until(comm, scene, straight, None)
    simulate_until(comm, scene, halted, 2 if "static" in kind else 10)
    if comm.rank == 0:
        shutil.copytree(halted, alone)
    assert simulate_until(comm, scene, halted, None, resume=True) == end
    if comm.rank == 0:
        # MUMPS adds up in the order in which messages arrive; where that decides on a linear iteration more,
        # results differ by the solver's tolerance. Resuming is not the cause: two uninterrupted runs
        # differ as much (alpha2, adaptive, 12 pairs on 3 ranks: 5e-10 to 8e-9, resumed 1e-10 to 8e-9)
        simulate_until(MPI.COMM_SELF, scene, alone, None, resume=True)
        if kind == "static":
            # which of several equilibria of the slack sheet it passes at half the load, and so the work, is
            # decided by round-off, also in uninterrupted runs: only the ends agree
            for folder in (halted, alone):
                shapes = StoredRun(folder).positions[-1], StoredRun(straight).positions[-1]
                np.testing.assert_allclose(*shapes, rtol=0, atol=1e-5)
            return
        same_files(halted, straight, 1e-7, exact=False)
        same_files(alone, straight, 1e-5 if "auto" in kind else 1e-7, exact=False)


@pytest.mark.parallel
def test_displacement_is_relative_to_the_first_state_after_resuming(comm: MPI.Comm, shared_tmp: Path) -> None:
    """Even if the scene has another start by then."""
    scene = SCENE | {
        "time": {"end": 0.02, "step": 0.004},
        "output": {"every": 0.004, "fields": ["displacement"]},
        "initial": {"noise": 1e-3},
    }
    simulate_until(comm, scene, shared_tmp / "run", 2)
    simulate_until(comm, scene | {"initial": {"noise": 2e-3}}, shared_tmp / "run", None, resume=True)
    if comm.rank == 0:
        run = StoredRun(shared_tmp / "run")
        assert len(run) == 6
        moved = np.asarray(run.positions) - run.positions[0]
        np.testing.assert_array_equal(run.field("displacement"), moved)
        assert run.field_units("displacement") == "m"
    comm.Barrier()


@pytest.mark.parallel
@pytest.mark.parametrize("changed", ["motion", "self"])
def test_a_scene_changed_to_cross_its_sheets_is_refused(
    comm: MPI.Comm, shared_tmp: Path, changed: str
) -> None:
    """By a lid that is around the sheet now, or since sheets that have crossed may not any longer."""
    lid = {"box": {"min": [-1.0, -1.0, 0.1], "max": [1.0, 1.0, 0.5]}}
    upper = grid(0.3, 0.3, 4, 3) | {"transform": {"translate": [0.0, 0.0, 0.05]}}
    down = {"time": 0.01, "translate": [0.0, 0.0, -0.2]}
    scene = {
        "mesh": [grid(0.2, 0.2, 3, 3), upper],
        "material": CLOTH | {"bending": 1e-4},
        "time": {"end": 0.02, "step": 0.005},
    }
    if changed == "motion":
        before = scene | {"contact": {}, "obstacles": {"lid": lid | {"motion": [{"time": 0.0}]}}}
        after = before | {"obstacles": {"lid": lid | {"motion": [{"time": 0.0}, down]}}}
        words = r"obstacles\.lid: at t = 0\.01 s \d+ triangles of the sheet reach into it"
    else:
        before = scene | {"contact": {"self": False}, "handles": [{"nodes": [16, 17], "motion": "down"}]}
        before["motions"] = {"down": [{"time": 0.0}, down]}
        after = before | {"contact": {}}
        words = r"contact: at t = 0\.01 s \d+ pairs? of triangles cross"
    folder = shared_tmp / "run"
    assert simulate_until(comm, before, folder, 2)[0] == 2
    kept = files_of(folder)
    comm.Barrier()
    with pytest.raises(InputError, match=words):
        simulate_until(comm, after, folder, None, resume=True)
    comm.Barrier()
    assert files_of(folder) == kept


@pytest.mark.parallel
def test_obstacles_are_shown_where_they_were_before_their_motion_changed(
    comm: MPI.Comm, shared_tmp: Path
) -> None:
    """After two resumptions; one of the obstacles had no motion at first."""

    def scene(fast: float, slow: float) -> dict[str, Any]:
        ball = {"sphere": {"center": [0.0, 0.0, -1.0], "radius": 0.1}}
        motions = {"fast": [{"time": 0.0}, {"time": 0.1, "translate": [fast, 0.0, 0.0]}]}
        along = [{"time": -0.1, "translate": [1.0, 0.0, 0.0]}, {"time": 0.1, "translate": [slow, 0.0, 0.0]}]
        second = ball | ({"motion": along, "interpolation": "linear"} if slow else {})
        return {
            "mesh": grid(0.2, 0.2, 2, 2),
            "material": CLOTH | {"bending": 1e-4},
            "contact": {},
            "obstacles": {"first": ball | {"motion": "fast"}, "second": second, "third": ball},
            "motions": motions,
            "time": {"end": 0.05, "step": 0.01},
            "output": {"every": 0.01},
        }

    folder, scenes = shared_tmp / "run", (scene(1.0, 0.0), scene(2.0, 4.0), scene(3.0, 4.0))
    for stop, content in zip((1, 3, None), scenes, strict=True):
        simulate_until(comm, content, folder, stop, resume=stop != 1)
    run = StoredRun(folder)
    first, second, third = run_obstacles(run)
    for time, fast, slow in zip(
        run.times, [1.0, 1.0, 2.0, 2.0, 3.0, 3.0], [0.0, 0.0, 1.0, 1.0, 1.0, 1.0], strict=True
    ):
        s = 10.0 * time
        assert first.positions(time)[0, 0] == pytest.approx(fast * s * s * (3.0 - 2.0 * s))
        assert second.positions(time)[0, 0] == pytest.approx(slow * 1.5 * s)
        assert third.motion is None
    comm.Barrier()
