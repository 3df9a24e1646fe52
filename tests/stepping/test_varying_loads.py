"""Loads that change in time: exact motions, orders, works, steps that end at kinks, and the load factor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import end_on_one_rank, finished, grid, scene_of, shape, stepped

from lyra_petsc.scene.schema import INTEGRATORS

FREE: dict[str, Any] = {"mesh": grid(0.3, 0.2, 3, 2, "alternating")}

RAMPS = [[0.0, [0, 0, 0]], [0.05, [2, 0, -8]], [0.12, [2, 0, 4]]]
"""A gravity that is linear between three points, and held after the last."""


def time_of(integrator: str, end: float, steps: int) -> dict[str, Any]:
    return {"end": end, "step": end / steps, "integrator": integrator}


@pytest.mark.parallel
@pytest.mark.quick
def test_a_free_sheet_under_varying_gravity_falls_exactly(comm: MPI.Comm) -> None:
    with stepped(comm, FREE | {"gravity": RAMPS, "time": time_of("midpoint", 0.16, 16)}) as simulation:
        start = shape(simulation)
        while not simulation.finished:
            simulation.step()
        moved = shape(simulation) - start
        velocities = simulation.problem.points.gather(simulation.problem.equations.v)
        budget = simulation.budget
        mass = comm.allreduce(float(simulation.problem.equations.mass.sum()))
    at, g = np.array([0.0, 0.05, 0.12, 0.16]), np.array([[0, 0, 0], [2, 0, -8], [2, 0, 4], [2, 0, 4.0]])
    x, v = np.zeros(3), np.zeros(3)
    for h, before, after in zip(np.diff(at), g, g[1:], strict=False):
        x += h * v + h * h * (before / 3.0 + after / 6.0)
        v += 0.5 * h * (before + after)
        # the midpoint rule is exact for velocities, and off by ġ Δt³/12 in each step for positions
        x += h * 0.01**2 / 12.0 * (after - before) / h
    # but for waves by round-off in the plane of the stiff sheet
    assert np.abs(velocities - v).max() < 1e-9
    assert np.abs((velocities - v)[:, 2]).max() < 1e-11
    assert np.abs(moved - x).max() < 1e-10
    assert np.abs((moved - x)[:, 2]).max() < 1e-11
    # a field that changes in time has no potential: its work is external
    assert budget.potential == 0.0
    assert budget.external_work == pytest.approx(0.5 * mass * v @ v, rel=1e-8)
    assert budget.kinetic == pytest.approx(budget.external_work, rel=1e-8)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_work_of_a_ramp_on_a_free_sheet(comm: MPI.Comm, integrator: str) -> None:
    """Force F t/T on mass m: momentum F T/2, work (F T)²/(8 m); every integrator balances what it does."""
    end = 0.2
    load = {"box": [[-1, -1, -1], [1, 1, 1]], "force": [[0, [0, 0, 0]], [end, [0.3, 0, 0.4]]]}
    traction = {"traction": [[0, [0, 0, 0]], [end, [5.0, 0, 0]]]}
    for one in (load, traction):
        with finished(comm, FREE | {"loads": [one], "time": time_of(integrator, end, 40)}) as simulation:
            budget, guard = simulation.budget, simulation.guard
            mass = comm.allreduce(float(simulation.problem.equations.mass.sum()))
            assert guard is not None
            assert guard.gains.won <= 2e-3 * guard.gains.scale
            assert simulation.totals["rejected"] == 0
        # a total force is shared in equal parts by vertices of different masses
        if one is traction:
            exact = (5.0 * 0.06 * end) ** 2 / (8.0 * mass)
            first_order = integrator in ("beuler", "semi-implicit")
            # the energy of backward Euler is that of a force later by half a step
            assert budget.kinetic == pytest.approx(exact * (41 / 40 if first_order else 1.0) ** 2, rel=1e-3)
            assert budget.external_work == pytest.approx(budget.kinetic, rel=0.05 if first_order else 1e-3)
            if integrator == "midpoint":
                assert budget.external_work == pytest.approx(exact, rel=1e-8)
                assert budget.kinetic == pytest.approx(exact, rel=1e-8)


MOVING: dict[str, Any] = {
    "mesh": grid(0.5, 0.4, 4, 3, "alternating"),
    "material": {
        "density": 0.2,
        "membrane": {"c11": 60.0, "c22": 40.0, "c12": 15.0, "c33": 12.0},  # so soft that Δt resolves it
        "bending": 1e-3,
        "damping": 0.01,
    },
    "handles": [{"nodes": [0, 5, 10, 15]}],
}
END = 0.16


def sampled(function: Any, count: int = 20) -> list[list[Any]]:
    """Points of a smooth function of time, one for each of the coarsest steps."""
    return [[t, np.asarray(function(t)).tolist()] for t in (END * i / count for i in range(count + 1))]


VARYING: dict[str, Any] = {
    "gravity": sampled(lambda t: [2.0 * np.sin(40 * t), 0.0, -9.81 * np.cos(25 * t)], 40),
    "wind": {
        "velocity": sampled(lambda t: [1.0, 4.0 * np.sin(30 * t + 1), 3.0], 40),
        "density": 1.2,
        "drag": 0.3,
    },
    "loads": [
        {"pressure": sampled(lambda t: 2.0 * np.sin(35 * t), 40)},
        {"nodes": [19], "force": sampled(lambda t: [0.0, 0.05 * np.cos(30 * t), 0.1 * np.sin(50 * t)], 40)},
    ],
}


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_orders_under_sampled_loads(comm: MPI.Comm, integrator: str) -> None:
    shapes, first_order = [], integrator in ("beuler", "semi-implicit")
    for steps in (160, 320, 640) if first_order else (40, 80, 160):
        with finished(comm, MOVING | VARYING | {"time": time_of(integrator, END, steps)}) as simulation:
            assert simulation.step_number == steps
            shapes.append(shape(simulation))
    first, second = (float(np.abs(shapes[i + 1] - shapes[i]).max()) for i in range(2))
    assert np.log2(first / second) == pytest.approx(1.0 if first_order else 2.0, abs=0.15)


def ends_of_steps(comm: MPI.Comm, scene: dict[str, Any]) -> list[float]:
    with stepped(comm, FREE | scene) as simulation:
        ends = []
        while not simulation.finished:
            ends.append(simulation.step().time)
    return ends


@pytest.mark.quick
def test_steps_end_at_kinks() -> None:
    curve = [[0.0, 1], [0.02, 1], [0.1 / 3, 2], [0.05, 3], [3 * 0.02, 0], [0.1, 0], [7.0, 5]]
    scene = {"loads": [{"pressure": curve}], "output": {"every": 0.05}, "time": {"end": 0.1, "step": 0.01}}
    ends = ends_of_steps(MPI.COMM_SELF, scene)
    kinks = [0.02, 0.1 / 3, 0.05, 0.06, 0.1]
    assert [min(abs(t - kink) for t in ends) for kink in kinks] == [0.0] * len(kinks)
    assert np.diff([0.0, *ends]).min() > 1e-3  # none of the size of round-off
    scene["time"] |= {"step": "auto", "tolerance": 1e-2, "integrator": "bdf2"}
    ends = ends_of_steps(MPI.COMM_SELF, scene)
    assert [min(abs(t - kink) for t in ends) for kink in kinks] == [0.0] * len(kinks)


def test_a_window_cuts_a_curve() -> None:
    curve, window = [[0.0, [0, 0, 0]], [0.1, [0, 0, 1.0]]], {"from": 0.02, "until": 0.06}
    scene = FREE | {"loads": [{"traction": curve} | window], "time": time_of("midpoint", 0.1, 10)}
    with finished(MPI.COMM_SELF, scene) as simulation:
        impulse = float(simulation.problem.equations.mass @ simulation.problem.equations.v[:, 2])
    assert impulse == pytest.approx(0.06 * 0.5 * (0.2 + 0.6) * 0.04, rel=1e-12)


# -- equilibria ------------------------------------------------------------------------------------------

STATIC: dict[str, Any] = {
    "mesh": grid(0.4, 0.2, 4, 2, "alternating"),
    "material": {"young": 2e8, "poisson": 0.3, "thickness": 2e-3, "density": 1.0},
    "handles": [{"box": [[-1, -1, -1], [1e-9, 1, 1]], "clamp": True}],
    "time": {"analysis": "static"},
}

TIP = {"box": [[0.39, -1, -1], [1, 1, 1]], "force": [0, 0, -0.05]}


def curve_to(value: Any) -> list[list[Any]]:
    """A curve over the load factor that goes beyond a value, and returns to it."""
    return [[0.0, (0.0 * np.array(value)).tolist()], [0.4, (1.3 * np.array(value)).tolist()], [1.0, value]]


LOADS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "gravity": ({"gravity": [0, 0, -2.0]}, {"gravity": curve_to([0, 0, -2.0])}),
    "force": ({"loads": [TIP]}, {"loads": [TIP | {"force": curve_to(TIP["force"])}]}),
    "traction": (
        {"loads": [{"traction": [0.0, 0.3, -0.5]}]},
        {"loads": [{"traction": curve_to([0.0, 0.3, -0.5])}]},
    ),
    "pressure": ({"loads": [{"pressure": 0.8}]}, {"loads": [{"pressure": curve_to(0.8)}]}),
    "moment": (
        {"loads": [{"group": "right", "moment": 2e-3}]},
        {"loads": [{"group": "right", "moment": curve_to(2e-3)}]},
    ),
    "wind": (
        {"wind": {"velocity": [0, 0, 1.0], "density": 1.2}},
        {"wind": {"velocity": curve_to([0, 0, 1.0]), "density": 1.2}},
    ),
}


@pytest.mark.parallel(2)
@pytest.mark.parametrize("load", LOADS)
def test_an_equilibrium_is_that_of_the_curves_end(comm: MPI.Comm, load: str) -> None:
    plain, curve = LOADS[load]
    with finished(comm, STATIC | plain) as simulation:
        expected = shape(simulation)
    with stepped(comm, STATIC | curve) as simulation:
        start, peak = shape(simulation), 0.0
        while not simulation.finished:
            if simulation.step().time == 0.4:
                peak = float(np.abs(shape(simulation) - start).max())
        moved = float(np.abs(expected - start).max())
        assert peak > 1.1 * moved > 1e-3
        np.testing.assert_allclose(shape(simulation), expected, atol=1e-4 * moved)


@pytest.mark.parallel(2)
def test_a_load_that_returns_to_zero_leaves_the_start_shape(comm: MPI.Comm) -> None:
    for value in ([[0, 0], [0.5, 0.8], [1, 0]], [[0, 0.8], [1, 0]]):
        with stepped(comm, STATIC | {"loads": [{"pressure": value}]}) as simulation:
            start, heights = shape(simulation), {}
            while not simulation.finished:
                heights[simulation.step().time] = float(shape(simulation)[:, 2].max())
            assert max(heights.values()) > 5e-3
            assert np.abs(shape(simulation) - start).max() < 1e-7


@pytest.mark.parallel(2)
def test_loads_without_a_curve_grow_beside_those_with_one(comm: MPI.Comm) -> None:
    """At the load factor ½ gravity is a half of it, the force is the whole curve's value."""
    held = {"gravity": [0, 0, -1.0], "loads": [TIP | {"force": [[0, [0, 0, -0.02]], [1, [0, 0, -0.02]]]}]}
    half = {"gravity": [0, 0, -0.5], "loads": [TIP | {"force": [0, 0, -0.02]}]}
    with finished(comm, STATIC | half) as simulation:
        expected = shape(simulation)
    with stepped(comm, scene_of(STATIC | held | {"time": {"analysis": "static", "step": 0.5}})) as simulation:
        assert simulation.step().time == 0.5
        np.testing.assert_allclose(shape(simulation), expected, atol=1e-6)


@pytest.mark.parallel
def test_a_run_goes_on_within_a_ramp_on_another_number_of_ranks(comm: MPI.Comm, shared_tmp: Path) -> None:
    scene = scene_of(MOVING | VARYING | {"time": time_of("bdf2", END, 40)})
    with finished(comm, scene, pc_type="none", ksp_rtol="1e-12") as simulation:
        whole = shape(simulation)
    resumed = end_on_one_rank(comm, scene, shared_tmp / "half", 17)
    if resumed is not None:
        np.testing.assert_allclose(resumed, whole, atol=1e-8)
