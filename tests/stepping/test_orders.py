"""Observed orders in Δt of all integrators, on a nonlinear sheet with moving handles, wind and damping."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import Simulation, finished, gathered, grid, scene_of, shape

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.simulation import SteppedScene

END = 0.16

MOVING: dict[str, Any] = {
    "mesh": grid(0.5, 0.4, 4, 3, "alternating"),
    "material": {
        "density": 0.2,
        "membrane": {"c11": 60.0, "c22": 40.0, "c12": 15.0, "c33": 12.0},  # so soft that Δt resolves it
        "bending": 1e-3,
        "damping": 0.01,
    },
    "gravity": [0.0, 0.0, -9.81],
    "wind": {"velocity": [1.0, 2.0, 3.0], "density": 1.2, "drag": 0.3},
    "handles": [
        {"nodes": [0, 5, 10, 15], "clamp": True, "motion": "sway"},
        {"nodes": [19], "stiffness": 3.0, "motion": "sway"},
    ],
    "loads": [{"pressure": 1.0}],
    "motions": {
        "sway": [
            {"time": 0},
            {"time": 0.4, "rotate": {"axis": [0, 1, 0], "degrees": 60}, "translate": [0.1, 0, 0]},
        ]
    },
}

SHOWN = [pytest.mark.quick, pytest.mark.parallel(2)]

ORDERS = {"beuler": 1.0, "semi-implicit": 1.0, "midpoint": 2.0, "alpha2": 2.0, "bdf2": 2.0}


def at_end(integrator: str, steps: int, comm: MPI.Comm, **time: float) -> Array:
    """Positions of the moving sheet at the end."""
    content = MOVING | {"time": {"end": END, "step": END / steps, "integrator": integrator, **time}}
    with Simulation(content, comm, options={}) as simulation:
        return simulation.run(END / steps, steps)


@pytest.mark.parametrize(
    "integrator", [pytest.param(name, marks=SHOWN if name == "bdf2" else ()) for name in ORDERS]
)
def test_observed_order(integrator: str, comm: MPI.Comm) -> None:
    # with longer steps backward Euler does not show its order yet
    coarsest = 40 if integrator == "beuler" else 20
    shapes = [at_end(integrator, factor * coarsest, comm) for factor in (1, 2, 4)]
    first, second = (float(np.abs(shapes[i + 1] - shapes[i]).max()) for i in range(2))
    assert np.log2(first / second) == pytest.approx(ORDERS[integrator], abs=0.1)


SWITCHED = MOVING | {
    "handles": [
        MOVING["handles"][0] | {"until": 0.12},
        {"nodes": [19], "stiffness": 3.0, "motion": "sway", "from": 0.04, "until": 0.1},
        {"nodes": [15], "motion": "sway", "from": 0.12},
        {"nodes": [4], "axes": ["z"], "until": 0.06},
        {"nodes": [5], "motion": "kinks", "interpolation": "linear", "from": 0.04},
    ],
    "motions": MOVING["motions"]
    | {"kinks": [{"time": 0.044}, {"time": 0.08, "translate": [0.02, 0, 0.03]}, {"time": 0.12}]},
    "loads": [
        {"pressure": 1.0, "from": 0.02},
        {"nodes": [17], "force": [0, 0, 0.05], "from": 0.06, "until": 0.1},
    ],
}
"""Forces, handles and their velocities jump during the run."""


@pytest.mark.parametrize("integrator", ["midpoint", "alpha2", "bdf2"])
def test_second_order_across_jumps(integrator: str, comm: MPI.Comm) -> None:
    shapes = []
    for steps in (40, 80, 160):
        time = {"end": END, "step": END / steps, "integrator": integrator}
        with Simulation(SWITCHED | {"time": time}, comm, options={}) as simulation:
            shapes.append(simulation.run(END / steps, steps))
    first, second = (float(np.abs(shapes[i + 1] - shapes[i]).max()) for i in range(2))
    assert np.log2(first / second) == pytest.approx(2.0, abs=0.25)


LYING = MOVING | {
    "mesh": grid(0.4, 0.3, 4, 3, "alternating") | {"transform": {"translate": [0.0, 0.0, 0.042]}},
    "gravity": [2.0, 0.0, -9.81],
    "wind": None,
    "loads": [],
    "contact": {"gap": 0.05, "self": False},
    "obstacles": {"floor": {"plane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}}},
    "handles": [{"nodes": [0, 5, 10, 15], "axes": ["x", "y"], "motion": "sway"}],
    "motions": {"sway": [{"time": 0}, {"time": 0.4, "translate": [0.1, 0.05, 0.0]}]},
}
"""A sheet pulled over a plane, within a gap that Δt resolves."""


@pytest.mark.parametrize("integrator", ["midpoint", "alpha2", "bdf2"])
def test_second_order_during_contact(integrator: str, comm: MPI.Comm) -> None:
    shapes = []
    # longer ones damp bounces, and the first of bdf2 makes energy
    for steps in (80, 160, 320):
        time = {"end": END, "step": END / steps, "integrator": integrator}
        simulation = SteppedScene(comm, scene_of(LYING | {"time": time}))
        weight, support = 9.81 * comm.allreduce(float(simulation.problem.equations.mass.sum())), 0.0
        while not simulation.finished:
            assert simulation.step().rejected == 0
            support -= float(simulation.energy_balance.obstacle_forces(1)[0, 2]) / steps
        assert support == pytest.approx(weight, rel=0.2)
        equations = simulation.problem.equations
        shapes.append(gathered(equations.points, equations.x))
        simulation.destroy()
    first, second = (float(np.abs(shapes[i + 1] - shapes[i]).max()) for i in range(2))
    assert np.log2(first / second) == pytest.approx(2.0, abs=0.25)


def test_second_order_if_a_load_switches() -> None:
    """Generalised-α computes new accelerations after a jump of the load."""
    soft = {"c11": 60.0, "c22": 40.0, "c12": 15.0, "c33": 12.0}  # so that Δt resolves it
    content = {
        "gravity": [0, 0, 0],
        "mesh": grid(0.5, 0.4, 3, 2, "alternating"),
        "material": {"density": 0.2, "membrane": soft, "bending": 1e-3, "damping": 0.01},
        "handles": [{"group": "left"}],
        "loads": [{"group": "right", "force": [0, 0, 0.5], "from": 0.04}],
    }
    shapes = []
    for step in (0.004, 0.002, 0.0005):
        time = {"end": 0.12, "step": step, "integrator": "alpha2"}
        with finished(MPI.COMM_SELF, content | {"time": time}) as simulation:
            shapes.append(shape(simulation))
    coarse, fine = (np.abs(shape - shapes[-1]).max() for shape in shapes[:2])
    assert coarse / fine == pytest.approx(4.06, abs=0.3)  # 3.2 where it is not
