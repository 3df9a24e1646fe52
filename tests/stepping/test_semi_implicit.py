"""``semi-implicit``: one linear solve per step, compared with the paper's formula in dense matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from oracle import blocks_of, gradient, summed
from physics import CLOTH, Simulation, grid

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.stage_equations import StageEquations

DT, GAMMA = 0.01, 0.03

SCENE: dict[str, Any] = {
    "mesh": grid(1.0, 0.7, 2, 2, "alternating"),
    "material": CLOTH | {"bending": 1e-2, "damping": GAMMA},
    "time": {"end": 1.0, "step": DT, "integrator": "semi-implicit"},
    "gravity": [0, 0, -9.81],
    "wind": {"velocity": [1, 2, 5], "density": 1.2, "drag": 0.3},
    "initial": {"velocity": [0, 0.5, 0], "angular_velocity": [1, 2, 0], "noise": 0.03},
}
SPRINGS = {"handles": [{"nodes": [0, 2], "stiffness": 1000.0}]}
HELD = {"handles": [{"nodes": [0, 2]}, {"nodes": [6], "axes": ["z"]}]}
AWAY = {"translate": [2.0, 1.0, -1.0], "rotate": {"axis": [1, 2, 3], "degrees": 100}}
MOVING = {"handles": [{"nodes": [0, 2], "motion": "away"}, HELD["handles"][1]]}
MOVING |= {"motions": {"away": [{"time": 0.0}, {"time": 1.0} | AWAY]}}  # type: ignore[dict-item]


def paper_step(equations: StageEquations, time: float, dt: float) -> Array:
    """Velocity (V, 3) after a step from ``time``: (M + Δt (Δt + γ) K⁺ + Δt² k) v = M v_n + Δt f(x_n, v_n)."""
    x, v_old = equations.x, equations.v
    equations.begin_step(time, time + dt)
    mass = np.repeat(equations.mass, 3)
    a, force = np.diag(mass), np.zeros_like(x)
    for term in equations.active.elastic:
        frozen = equations.step.frozen[term]
        force -= gradient(term, x, frozen)
        damping = GAMMA if term.name != "spring" else 0.0
        stiffness = summed(term.stencil, blocks_of(term, x, frozen, 1.0), len(x))
        a += dt * (dt + damping) * stiffness.reshape(len(a), len(a))
    for load in equations.active.loads:
        load.add_force(equations.targets_at(time + dt, x), force)
    for wind in equations.active.viscous:
        force -= gradient(wind, v_old, equations.step.frozen[wind])
    b = mass * v_old.ravel() + dt * force.ravel()
    free = ~equations.step.prescribed.mask.ravel()
    v = np.zeros(len(b))
    v[~free] = equations.step.prescribed.velocity
    v[free] = np.linalg.solve(a[np.ix_(free, free)], b[free] - a[np.ix_(free, ~free)] @ v[~free])
    return v.reshape(x.shape)


@pytest.mark.parametrize("handles", [{}, SPRINGS, HELD, MOVING], ids=["free", "springs", "held", "moving"])
def test_steps_follow_the_papers_formula(handles: dict[str, Any]) -> None:
    with Simulation(SCENE | handles, MPI.COMM_SELF) as simulation:
        equations = simulation.equations
        for _ in range(5):
            x, expected = equations.x.copy(), paper_step(equations, simulation.time, DT)
            attempt = simulation.step(DT)
            np.testing.assert_allclose(equations.v, expected, rtol=0.0, atol=1e-11)
            np.testing.assert_allclose(equations.x, x + DT * expected, rtol=0.0, atol=1e-13)
            assert attempt.newton_iterations <= 1


def test_one_step_differs_from_backward_euler_by_second_order_in_dt() -> None:
    gaps = []
    for dt in (4e-3, 2e-3, 1e-3):
        ends = []
        for integrator in ("semi-implicit", "beuler"):
            content = SCENE | {"time": {"end": 1.0, "step": dt, "integrator": integrator}, "wind": None}
            content = {key: value for key, value in content.items() if value is not None}
            with Simulation(content, MPI.COMM_SELF) as simulation:
                ends.append(simulation.run(dt, 1))
        gaps.append(np.abs(ends[0] - ends[1]).max())
    assert gaps[0] > 3.5 * gaps[1] > 12.0 * gaps[2] > 0.0


@pytest.mark.parallel(2)
def test_moving_handle_gets_its_exact_positions(comm: MPI.Comm) -> None:
    motion = {"m": [{"time": 0}, {"time": 0.1, "translate": [0.1, 0, 0]}]}
    handle = {"nodes": [0, 2], "motion": "m", "interpolation": "linear"}
    with Simulation(SCENE | {"handles": [handle], "motions": motion}, comm) as simulation:
        start = simulation.x
        end = simulation.run(DT, 5)
        np.testing.assert_allclose(end[[0, 2]] - start[[0, 2]], [[0.05, 0, 0]] * 2, atol=1e-15)
