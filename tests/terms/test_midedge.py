"""Bending with one unknown on every edge: convergence, frames, clamps, resumed runs."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from examples import BENDING, curved_sheet
from mpi4py import MPI
from numpy.typing import NDArray
from oracle import directors_along_normals, gradient
from physics import CLOTH, Simulation, gathered, grid, obj_file, rotation, scene_of

from lyra_petsc.errors import InputError
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.stepping.simulation import SteppedScene as Run
from lyra_petsc.stepping.simulation import StepReport
from lyra_petsc.terms.midedge import MidEdge

Array = NDArray[np.float64]

PLATE = {"d11": 1.0, "d22": 1.0, "d12": 0.3, "d33": 0.35}
STIFF = {"density": 1.0, "membrane": {"c11": 1e6, "c22": 1e6, "c12": 0.0, "c33": 5e5}, "bending": PLATE}
TIGHT = {"force_tolerance": 1e-10, "step_tolerance": 1e-10}
STEPS = {"end": 0.08, "step": 0.01}
SHEET: dict[str, Any] = {
    "mesh": grid(0.6, 0.4, 5, 4, "alternating"),
    "material": CLOTH | {"bending": 2e-2, "bending_model": "midedge", "damping": 0.005},
    "gravity": [0, 0, -9.81],
    "handles": [{"box": [[-1, -1, -1], [0.01, 1, 1]], "clamp": True}],
    "solver": TIGHT,
}


def midedge_of(simulation: Simulation | Run) -> MidEdge:
    term = simulation.problem.terms["midedge"]
    assert isinstance(term, MidEdge)
    return term


# -- the energy ----------------------------------------------------------------------------------------


def cylinder(pattern: str, n: int) -> float:
    """Energy over ½ B κ² A of a sheet rolled up to κ = 1 with directors along the exact normals."""
    with Simulation({"mesh": grid(1.0, 1.0, n, n, pattern), "material": STIFF}, MPI.COMM_SELF) as simulation:
        term, x = midedge_of(simulation), simulation.system.x.copy()
        rows = slice(0, simulation.problem.points.n_vertices)
        flat, edges = x[rows].copy(), term.of_edges
        x[rows] = np.column_stack([np.sin(flat[:, 0]), flat[:, 1], 1.0 - np.cos(flat[:, 0])])
        term.begin(x)
        tangent, across = term.frames
        middle = flat[edges.ends].mean(axis=1)[:, 0]
        normal = np.column_stack([-np.sin(middle), np.zeros(len(middle)), np.cos(middle)])
        sine = np.sum(np.cross(tangent, across) * normal, axis=1)
        x.ravel()[edges.places] = edges.length * np.arctan2(sine, np.sum(across * normal, axis=1))
        return float(term.energies(x, term.frames).sum()) / 0.5


@pytest.mark.parametrize("pattern", ["diagonal", "alternating", "criss-cross"])
def test_energy_of_a_cylinder(pattern: str) -> None:
    """A strip's ½ D11 κ² + terms of the mesh, of second order."""
    errors = [abs(cylinder(pattern, n) - 1.0) for n in (4, 8, 16)]
    assert errors[0] < 0.03
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders.min() > 1.8


def test_moments_and_forces_balance_under_rotation(tmp_path: Path) -> None:
    """Σ x × f + Σ m t = 0 where the frames are those of the shape: the energy is that of the shape alone."""
    content = {
        "mesh": curved_sheet(tmp_path / "sheet.obj"),
        "material": BENDING | {"bending_model": "midedge"},
    }
    with Simulation(content, MPI.COMM_SELF) as simulation:
        term, n = midedge_of(simulation), simulation.problem.points.n_vertices
        random = np.random.default_rng(2)
        x = simulation.system.x.copy()
        x[:n] = (x[:n] + random.uniform(-0.1, 0.1, (n, 3))) @ rotation([1.0, 2.0, 0.5], 0.9).T
        x.ravel()[term.of_edges.places] = directors_along_normals(term, x)
        before = term.energies(x, term.frames)
        term.accept(x, term.frames)
        np.testing.assert_allclose(term.energies(x, term.frames), before, rtol=1e-12)
        pull = gradient(term, x, term.frames)
        moments = pull.ravel()[term.of_edges.places] * term.of_edges.length
        torque = np.cross(x[:n], pull[:n]).sum(axis=0) + moments @ term.frames.tangent
        assert np.abs(torque).max() < 1e-13 * np.abs(pull).max()


def test_frames_survive_a_checkpoint(tmp_path: Path) -> None:
    content = {
        "mesh": curved_sheet(tmp_path / "sheet.obj"),
        "material": BENDING | {"bending_model": "midedge"},
    }
    with Simulation(content, MPI.COMM_SELF) as simulation:
        term, n = midedge_of(simulation), simulation.problem.points.n_vertices
        x = simulation.system.x.copy()
        x[:n] = x[:n] @ rotation([1.0, 2.0, 0.5], 0.9).T
        term.accept(x, term.frames)
        frames, state = term.frames, term.edge_state()
        term.frames = type(frames)(np.zeros_like(frames.tangent), np.zeros_like(frames.across))
        term.restore_edges(state, x)
        np.testing.assert_allclose(term.frames.across, frames.across, rtol=0.0, atol=1e-15)


def test_energy_is_infinite_beyond_a_right_angle() -> None:
    with Simulation({"mesh": grid(1.0, 1.0, 1, 1), "material": STIFF}, MPI.COMM_SELF) as simulation:
        term, x = midedge_of(simulation), simulation.system.x.copy()
        place, length = term.of_edges.places[0], term.of_edges.length[0]
        way = np.zeros_like(x)
        way.ravel()[place] = length
        for turn in (1.5, -1.5):
            assert np.isfinite(term.energies(x + turn * way, term.frames)).all()
        assert not np.isfinite(term.energies(x + 1.6 * way, term.frames)).all()
        assert term.largest_step(x, 0.4 * way, term.frames) == 1.0
        assert term.largest_step(x, 2.0 * way, term.frames) == 0.25
        near = x + 1.4 * way
        fraction = term.largest_step(near, 0.4 * way, term.frames)
        assert np.isfinite(term.energies(near + fraction * 0.4 * way, term.frames)).all()


@pytest.mark.parametrize("pattern", ["diagonal", "alternating", "criss-cross"])
@pytest.mark.parametrize("clamp", [True, False])
def test_plates_converge(pattern: str, clamp: bool) -> None:
    """Clamped and supported squares under uniform load: Timoshenko & Woinowsky-Krieger, tables 8 and 35."""
    errors = []
    for n in (8, 16):
        box = (
            [[-1, -1, -1], [0, 2, 1]],
            [[1, -1, -1], [2, 2, 1]],
            [[-1, -1, -1], [2, 0, 1]],
            [[-1, 1, -1], [2, 2, 1]],
        )
        content = {
            "mesh": grid(1.0, 1.0, n, n, pattern),
            "material": STIFF,
            "handles": [{"box": each, "clamp": clamp} for each in box],
            "loads": [{"traction": [0.0, 0.0, 1e-6]}],
            "time": {"analysis": "static", "end": 1.0, "step": 1.0},
            "solver": TIGHT,
        }
        simulation = Run(MPI.COMM_SELF, scene_of(content))
        simulation.step()
        middle = n // 2 * (n + 2)
        height = gathered(simulation.problem.points, simulation.problem.system.x)[middle, 2]
        errors.append(height / 1e-6 / (0.00126532 if clamp else 0.00406235) - 1.0)
        simulation.destroy()
    assert 0.0 < errors[1] < (0.1 if clamp else 0.02)
    assert np.log2(errors[0] / errors[1]) > 1.8


# -- steps ---------------------------------------------------------------------------------------------


def outcome(comm: MPI.Comm, scene: dict[str, Any]) -> tuple[Array, Array]:
    """Positions in mesh order, and energies and works, after a whole run."""
    simulation = Run(comm, scene_of(SHEET | scene))
    while not simulation.finished:
        simulation.step()
    budget = simulation.budget
    energies = np.array(
        [budget.kinetic, budget.membrane, budget.bending, budget.dissipation, budget.external_work]
    )
    x = gathered(simulation.problem.points, simulation.problem.system.x)
    simulation.destroy()
    return x, energies


TURN = {
    "handles": [SHEET["handles"][0] | {"motion": "turn", "interpolation": "linear"}],
    "motions": {
        "turn": [
            {"time": 0.0},
            {"time": 1.0, "rotate": {"axis": [0, 1, 0], "degrees": 400}},
        ]
    },
}


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", ["beuler", "semi-implicit", "midpoint", "bdf2", "alpha2", "static"])
def test_runs_do_not_depend_on_ranks(comm: MPI.Comm, scheme: str) -> None:
    time = {"analysis": "static"} if scheme == "static" else STEPS | {"integrator": scheme}
    scene = TURN | {"time": time} if scheme != "static" else {"time": time}
    x, energies = outcome(comm, scene)
    alone = outcome(MPI.COMM_SELF, scene) if comm.rank == 0 else (x, energies)
    tolerance = 1e-5 if scheme == "semi-implicit" else 1e-8  # one linear solve, to 1e-6
    np.testing.assert_allclose(x, alone[0], rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(
        energies, alone[1], rtol=1e-3 if scheme == "semi-implicit" else 1e-6, atol=1e-9
    )


@pytest.mark.parametrize("scheme", ["midpoint", "bdf2", "alpha2"])
def test_order_with_a_turning_clamp(scheme: str) -> None:
    """Against half the step."""
    smoothly = {
        "handles": [SHEET["handles"][0] | {"motion": "turn"}],
        "motions": {"turn": [{"time": 0.0}, {"time": 0.1, "rotate": {"axis": [0, 1, 0], "degrees": 60}}]},
        "output": {"every": 0.04},
        "material": SHEET["material"] | {"damping": 0.0},
    }
    ends = [
        outcome(MPI.COMM_SELF, smoothly | {"time": {"end": 0.04, "step": step, "integrator": scheme}})
        for step in (0.004, 0.002, 0.001)
    ]
    moved = [np.abs(a[0] - b[0]).max() for a, b in pairwise(ends)]
    assert np.log2(moved[0] / moved[1]) > 1.8


@pytest.mark.parametrize("scheme", ["midpoint", "bdf2", "alpha2"])
def test_order_with_damping(scheme: str) -> None:
    """Against half the step; it acts on directors, which have no mass."""
    ends = [
        outcome(MPI.COMM_SELF, {"time": {"end": 0.04, "step": step, "integrator": scheme}})
        for step in (0.004, 0.002, 0.001)
    ]
    moved = [np.abs(a[0] - b[0]).max() for a, b in pairwise(ends)]
    assert np.log2(moved[0] / moved[1]) > 1.8


def test_a_clamp_turns_the_sheet_with_it() -> None:
    """Without weight and slowly turned about its own edge, a sheet follows as a rigid body does."""
    degrees = 400.0
    keyframes = [{"time": 0.0}, {"time": 200.0, "rotate": {"axis": [0, 1, 0], "degrees": degrees}}]
    scene = TURN | {
        "mesh": grid(0.4, 0.1, 4, 1),
        "material": SHEET["material"] | {"damping": 0.0},  # of rates that are chords, 10° at a time
        "gravity": [0, 0, 0],
        "motions": {"turn": keyframes},
        "time": {"end": 200.0, "step": 5.0},
        "output": {"every": 5.0},
    }
    x, energies = outcome(MPI.COMM_SELF, scene)
    expected = np.array([[0.1 * i, 0.1 * j, 0.0] for j in range(2) for i in range(5)])
    np.testing.assert_allclose(x, expected @ rotation([0, 1, 0], np.radians(degrees)).T, atol=1e-5)
    assert energies[2] < 1e-9


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", ["beuler", "alpha2"])
def test_a_run_goes_on_with_other_ranks(comm: MPI.Comm, scheme: str, shared_tmp: Path) -> None:
    scene = TURN | {"time": STEPS | {"integrator": scheme}}
    whole = outcome(comm, scene)[0]
    folder = shared_tmp / "run"
    simulation = Run(comm, scene_of(SHEET | scene))
    recorder = Recorder(simulation)
    if comm.rank == 0:
        folder.mkdir()
    comm.Barrier()
    recorder.begin(folder)
    for _ in range(4):
        recorder.record(simulation.step())
    recorder.write_checkpoint()
    recorder.settle()
    recorder.close()
    simulation.destroy()
    few = comm.Split(0 if comm.rank == 0 else 1)
    if comm.rank == 0:
        resumed = Run(few, scene_of(SHEET | scene))
        again = Recorder(resumed)
        again.resume(folder)
        assert resumed.step_number == 4
        reports: list[StepReport] = []
        while not resumed.finished:
            reports.append(resumed.step())
            again.record(reports[-1])
        again.settle()
        again.close()
        x = gathered(resumed.problem.points, resumed.problem.system.x)
        np.testing.assert_allclose(x, whole, rtol=0.0, atol=1e-8)
        resumed.destroy()
    few.Free()
    comm.Barrier()


# -- rest shapes and refusals --------------------------------------------------------------------------


def test_a_curved_sheet_at_rest_stays(tmp_path: Path) -> None:
    content = {
        "mesh": curved_sheet(tmp_path / "sheet.obj"),
        "material": BENDING | {"bending_model": "midedge"},
    }
    with Simulation(content, MPI.COMM_SELF) as simulation:
        before = simulation.x
        np.testing.assert_allclose(simulation.run(0.05, 3), before, atol=1e-13)


@pytest.mark.parametrize("pattern", ["diagonal", "criss-cross"])
def test_rest_curvature_rolls_a_strip_up(pattern: str) -> None:
    """A free strip of rest curvature κ11 is at rest as a cylinder towards its normal."""
    material = STIFF | {"bending": PLATE | {"d12": 0.0}, "rest_curvature": [0.5, 0.0, 0.0]}
    content = {
        "mesh": grid(1.0, 0.25, 16, 4, pattern),
        "material": material,
        "handles": [{"box": [[-1, -1, -1], [0, 1, 1]], "clamp": True}],
        "time": {"analysis": "static", "step": 1.0},
        "solver": {},
    }
    x, energies = outcome(MPI.COMM_SELF, content | {"gravity": [0, 0, 0]})
    tip = x[np.argmax(x[:, 0])]
    np.testing.assert_allclose([tip[0], tip[2]], [np.sin(0.5) / 0.5, (1.0 - np.cos(0.5)) / 0.5], rtol=5e-3)
    assert energies[2] < 1e-3 * 0.5 * 0.25 * 0.25


def folded(path: Path, degrees: float) -> dict[str, Any]:
    """Two triangles, folded by so many degrees at the edge of vertices 0 and 1."""
    angle = np.radians(180.0 - degrees)
    corners: Sequence[Sequence[float]] = [
        (0, 0, 0), (0, 1, 0), (1, 0.5, 0), (np.cos(angle), 0.5, np.sin(angle)),
    ]  # fmt: skip
    return obj_file(path, corners, [(0, 2, 1), (0, 1, 3)])


def test_a_fold_of_nearly_180_degrees_is_refused(tmp_path: Path) -> None:
    material = STIFF | {"bending_model": "midedge"}
    with Simulation({"mesh": folded(tmp_path / "a.obj", 170.0), "material": material}, MPI.COMM_SELF):
        pass
    content = scene_of({"mesh": folded(tmp_path / "b.obj", 179.0), "material": material})
    with pytest.raises(InputError, match=r"folded by 178° or more at the edge of vertices 0 and 1"):
        Run(MPI.COMM_SELF, content)


def test_one_sheet_bends_by_one_model() -> None:
    hinge = STIFF | {"bending": 1.0}
    two = {"mesh": [grid(1, 1, 2, 2) | {"name": "a"}, grid(1, 1, 2, 2) | {"name": "b"}]}
    sheets = two | {"material": [STIFF | {"group": "a"}, hinge | {"group": "b"}]}
    simulation = Run(MPI.COMM_SELF, scene_of(sheets))
    assert {"bending", "midedge"} <= set(simulation.problem.terms)
    simulation.destroy()
