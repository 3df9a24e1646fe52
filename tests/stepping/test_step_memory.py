"""What a step takes besides what is kept between steps."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from physics import grid, scene_of

from lyra_petsc.stepping.simulation import SteppedScene


def hanging(n: int) -> SteppedScene:
    content: dict[str, Any] = {
        "mesh": grid(1.0, 1.0, n, n, "alternating"),
        "material": {"cloth": "gray-interlock", "bending_model": "midedge", "damping": 0.03},
        "handles": [{"nodes": [0, n]}],
        "gravity": [0.0, 0.0, -9.81],
        "time": {"end": 1.0, "step": 0.005, "integrator": "semi-implicit"},
    }
    return SteppedScene(MPI.COMM_SELF, scene_of(content))


def end(simulation: SteppedScene) -> None:
    simulation.destroy()
    for name in simulation.stepper.our_options:
        PETSc.Options().delValue(name)


def test_parts_of_forces_come_one_after_the_other() -> None:
    simulation = hanging(4)
    simulation.step()
    parts = simulation.problem.system.forces_at_stage()
    seen: list[tuple[str, Any]] = []
    for name, part in parts:
        assert all(gone() is None for _, gone in seen)
        seen.append((name, weakref.ref(part)))
        del part
    assert [name for name, _ in seen] == ["inertia", "loads", "damping", "internal"]
    end(simulation)


def test_a_new_state_leaves_the_arrays_of_the_one_before() -> None:
    simulation = hanging(2)
    state = simulation.problem.system.state
    x, kept = state.x, state.x.copy()
    state.set(x + 1.0, state.v)
    np.testing.assert_array_equal(x, kept)
    np.testing.assert_array_equal(state.x, kept + 1.0)
    end(simulation)
