"""Static equilibria: residual within the tolerance, the end of a damped motion, all loads."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, grid, shape, stepped

from lyra_petsc.errors import SolverError
from lyra_petsc.stepping.simulation import SteppedScene

pytestmark = pytest.mark.parallel(2)

SHEET: dict[str, Any] = {
    "mesh": grid(1.0, 0.8, 6, 5, "alternating"),
    "material": CLOTH | {"bending": 1e-3},
    "gravity": [0, 0, -9.81],
    "handles": [{"nodes": [0, 6, 35, 41]}],
    "solver": {"force_tolerance": 1e-9},
}


@contextmanager
def at_rest(comm: MPI.Comm, **content: Any) -> Iterator[SteppedScene]:
    """A scene after its static analysis."""
    with motion(comm, **(content | {"time": {"analysis": "static"} | content.get("time", {})})) as simulation:
        while not simulation.finished:
            simulation.step()
        assert simulation.time == 1.0
        yield simulation


def motion(comm: MPI.Comm, **content: Any) -> AbstractContextManager[SteppedScene]:
    return stepped(comm, SHEET | content)


def out_of_balance(simulation: SteppedScene) -> float:
    """Largest force [N] on a free coordinate."""
    equations = simulation.problem.equations
    return float(simulation.comm.allreduce(np.abs(equations.out_of_balance()).max(initial=0.0), MPI.MAX))


MOVED = {
    "handles": [
        {"nodes": [0, 7, 14, 21, 28, 35], "clamp": True},
        {"nodes": [6, 13, 20, 27, 34, 41], "motion": "in"},
    ],
    "motions": {"in": [{"time": 0}, {"time": 1, "translate": [-0.3, 0, 0.2]}]},
}

SCENES: dict[str, dict[str, Any]] = {
    "hung by corners": {},
    "membrane only": {"material": CLOTH},
    "hung by one corner": {
        "handles": [{"nodes": [0]}],
        "initial": {"noise": 1e-3},
        "material": CLOTH | {"bending": 0.1},
    },
    "handles that move": MOVED,
    "pressure": {
        "gravity": None,
        "loads": [{"pressure": 20.0}],
        "handles": [{"group": side} for side in ("left", "right", "top", "bottom")],
    },
    "wind": {"wind": {"velocity": [0, 1, 3], "density": 1.2, "drag": 0.1}},
    "springs": {"handles": [{"nodes": [0, 6, 35, 41], "stiffness": 50.0}]},
    "curved rest shape": {
        "gravity": None,
        "material": CLOTH | {"bending": 1e-3, "rest_curvature": [2.0, 0.0, 0.0]},
        "handles": [{"nodes": [0, 7, 14, 21, 28, 35], "clamp": True}],
    },
    "no load at all": {"gravity": None},
}


@pytest.mark.parametrize("name", SCENES)
def test_forces_balance(name: str, comm: MPI.Comm) -> None:
    content = {key: value for key, value in (SHEET | SCENES[name]).items() if value is not None}
    with at_rest(comm, **content) as simulation:
        weight = 0.2 * 0.8 * 9.81
        assert out_of_balance(simulation) < 1e-8 * weight
        assert simulation.budget.kinetic == 0.0
        assert simulation.budget.dissipation == 0.0


def test_equilibria_are_the_limits_of_damped_motions(comm: MPI.Comm) -> None:
    with at_rest(comm) as simulation:
        resting = shape(simulation)
    with motion(comm, time={"end": 400.0, "step": 2.0}, output={"every": None}) as simulation:
        while not simulation.finished:
            simulation.step()
        assert np.abs(shape(simulation) - resting).max() < 1e-6


def test_ranks_agree_on_the_equilibrium(comm: MPI.Comm) -> None:
    with at_rest(comm, **MOVED) as simulation:
        together = shape(simulation)
    with at_rest(MPI.COMM_SELF, **MOVED) as simulation:
        assert np.abs(shape(simulation) - together).max() < 1e-7


def test_work_of_moved_handles_is_the_energy_stored(comm: MPI.Comm) -> None:
    # small increments between equilibria: the work equals the energy
    time = {"step": 0.02}
    stretch = {"in": [{"time": 0}, {"time": 1, "translate": [0.1, 0, 0]}]}
    handles = [{"nodes": [0, 7, 14, 21, 28, 35]}, {"nodes": [6, 13, 20, 27, 34, 41], "motion": "in"}]
    content = {"gravity": [0, 0, 0], "handles": handles, "motions": stretch, "time": time}
    with motion(comm, **(content | {"time": {"analysis": "static", **time}})) as simulation:
        simulation.control.EASY = -1  # type: ignore[misc]
        while not simulation.finished:
            simulation.step()
        budget = simulation.budget
        assert simulation.step_number == 50
        assert budget.membrane > 1.0
        assert budget.external_work == pytest.approx(budget.membrane + budget.bending, rel=1e-3)


@pytest.mark.parametrize("model", [pytest.param("hinge", marks=pytest.mark.parallel(1)), "midedge"])
def test_work_of_clamps_that_turn_is_the_energy_stored(model: str, comm: MPI.Comm) -> None:
    turn = {"rotate": {"axis": [0, 1, 0], "degrees": -60}, "translate": [0.035, 0, 0.02]}
    content = {
        "mesh": grid(0.1, 0.02, 8, 2, "alternating"),
        "material": CLOTH | {"bending": 1e-3, "bending_model": model},
        "gravity": [0, 0, 0],
        "handles": [{"group": "left", "clamp": True}, {"group": "right", "clamp": True, "motion": "turn"}],
        "motions": {"turn": [{"time": 0}, {"time": 1, **turn}]},
    }
    off = []
    for steps in (10, 20):
        time, petsc = {"analysis": "static", "step": 1.0 / steps}, {"ts_adapt_dt_max": 1.0 / steps}
        with at_rest(comm, **content, time=time, petsc=petsc) as simulation:
            assert simulation.step_number == steps
            budget = simulation.budget
            off.append(budget.external_work / (budget.membrane + budget.bending) - 1.0)
    assert 0.0 < off[1] < 0.01
    assert off[0] / off[1] == pytest.approx(4.0, rel=0.1)  # of second order


def test_increments_grow_while_load_steps_are_easy(comm: MPI.Comm) -> None:
    with motion(comm, time={"analysis": "static", "step": 0.05}) as simulation:
        factors = []
        while not simulation.finished:
            factors.append(simulation.step().time)
    assert factors[0] == pytest.approx(0.05)
    increments = np.diff([0.0, *factors])
    assert increments.max() >= 2.0 * increments[0]
    assert len(factors) < 20


def test_ts_adapt_dt_max_limits_the_increment(comm: MPI.Comm) -> None:
    time, petsc = {"analysis": "static", "step": 0.05}, {"ts_adapt_dt_max": 0.2}
    with motion(comm, time=time, petsc=petsc) as simulation:
        factors = [0.0]
        while not simulation.finished:
            factors.append(simulation.step().time)
    np.testing.assert_allclose(np.diff(factors).max(), 0.2)


def test_the_tangent_includes_moving_handles(comm: MPI.Comm) -> None:
    """Compared with the difference of two equilibria of a strip under its weight that a clamp lifts."""
    x, rate = [], np.empty(0)
    for more in (1.0, 1.01):
        lifted = {"time": 1.0, "translate": [-0.1 * more, 0.0, 0.3 * more]}
        moving = {"group": "right", "clamp": True, "motion": "lift", "interpolation": "linear"}
        content = {
            "mesh": grid(1.0, 0.2, 20, 4, "alternating"),
            "material": {"young": 1e7, "poisson": 0.3, "thickness": 0.01, "density": 1.0},
            "gravity": [0.0, 0.0, -20.0 * more],
            "handles": [{"group": "left", "clamp": True}, moving],
            "motions": {"lift": [{"time": 0.0}, lifted]},
        }
        with at_rest(comm, **content) as simulation:
            x.append(shape(simulation))
            if more == 1.0:
                rate = simulation.problem.points.gather(simulation.equilibrium.saved_state(1.0)[0]["rate"])
    expected = (x[1] - x[0]) / 0.01
    assert np.abs(rate - expected).max() < 0.05 * np.abs(expected).max()


@pytest.mark.parallel(1)
def test_a_solve_ends_when_its_error_estimate_is_below_the_tolerance(comm: MPI.Comm, tmp_path: Path) -> None:
    """Second solves with the same matrix give the estimate."""
    found, iterations = [], []
    for tolerance in (1e-6, 1e-10):
        content = {
            "mesh": grid(1.0, 0.2, 20, 4, "alternating"),
            "material": {"young": 1e7, "poisson": 0.3, "thickness": 0.01, "density": 1.0},
            "gravity": [0.0, 0.0, 0.0],
            "handles": [{"group": "left", "clamp": True}],
            "loads": [{"nodes": [20, 104], "force": [0.0, 0.0, 0.5]}],
            "solver": {"force_tolerance": 1e-6, "step_tolerance": tolerance},
            "time": {"analysis": "static", "step": 0.1},
            "petsc": {"ts_adapt_dt_max": 0.1},
        }
        with at_rest(comm, **content) as simulation:
            found.append(simulation.problem.equations.x[: simulation.problem.points.n_vertices].copy())
            iterations.append(simulation.totals["newton_iterations"])
            spacing = simulation.problem.whole.spacing
    assert np.abs(found[0] - found[1]).max() <= 1e-6 * spacing
    assert iterations[0] <= 32  # 30; 35 without


NOWHERE: dict[str, tuple[dict[str, Any], str]] = {
    "nothing holds it": ({"handles": []}, "m of the start, as if nothing held the sheet"),
    "held along x": (
        {"handles": [{"nodes": [0, 1, 2], "axes": ["x"]}]},
        "m of the start, as if nothing held the sheet",
    ),
    "blown around a corner": (
        {"handles": [{"nodes": [0]}], "loads": [{"pressure": 10.0}]},
        # rounding decides which of its limits is reached first
        "proximal steps came no nearer|did not converge within its iterations",
    ),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.parallel(2 if name == "nothing holds it" else 1))
        for name in NOWHERE
    ],
)
def test_a_sheet_without_an_equilibrium_fails_soon(name: str, comm: MPI.Comm) -> None:
    content, words = NOWHERE[name]
    time = {"time": {"analysis": "static"}}
    with motion(comm, mesh=grid(1.0, 1.0, 2, 2, "diagonal"), **content, **time) as simulation:
        start = shape(simulation)
        with pytest.raises(SolverError, match=words):
            simulation.step()
        assert simulation.failure is not None
        tried = simulation.failure.attempts
        assert re.search(words, tried[-1].words)
        assert sum(each.newton_iterations for each in tried) < 2500  # it took 36,780
        assert np.array_equal(shape(simulation), start)


def test_static_analyses_end_at_their_tolerance(comm: MPI.Comm) -> None:
    """The last proximal step must not end far above a loose tolerance, nor far below it."""
    left, weight = [], 0.2 * 0.8 * 9.81
    for tolerance in (1e-2, 1e-3, 1e-4, 1e-5):
        content = {"handles": [{"nodes": [0, 6]}], "solver": {"force_tolerance": tolerance}}
        with at_rest(comm, **content) as simulation:
            force = simulation.problem.equations.out_of_balance()
            norm = np.sqrt(comm.allreduce(float(np.vdot(force, force))))
            # the largest part of the forces is hardly larger than the pull of the two handles
            left.append(norm / (tolerance * weight))
    assert max(left) < 5.0, left


def test_a_static_analysis_starts_in_equilibrium(comm: MPI.Comm) -> None:
    """Forces that hold the start shape decrease with the load factor."""
    still = {"gravity": [0, 0, 0], "initial": {"noise": 5e-3}, "handles": [{"nodes": [0, 6]}]}
    with motion(comm, **still, time={"analysis": "static"}) as simulation:
        equations, left = simulation.problem.equations, []
        for factor in (0.0, 0.5, 1.0):
            equations.begin_step(0.0, factor)
            left.append(comm.allreduce(np.abs(equations.out_of_balance()).max(initial=0.0), MPI.MAX))
        assert left[0] < 1e-12 * left[2]
        assert left[1] == pytest.approx(0.5 * left[2])
