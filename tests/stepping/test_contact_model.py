"""Newton's method with contact: the linear model includes pairs that would touch within the increment."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from physics import direct_solver, gathered, grid, scene_of

from lyra_petsc.stepping.simulation import SteppedScene

Array = NDArray[np.float64]

pytestmark = pytest.mark.parallel(2)

CELLS, GAP, STEPS = 24, 1e-5, 3


def thrown_at_a_ball() -> dict[str, Any]:
    """A sheet whose edges are far longer than the contact region on the ball: few of its triangles touch."""
    place = {"translate": [-0.5, -0.48, 0.0]}
    return {
        "mesh": grid(1.0, 1.0, CELLS, CELLS, "alternating") | {"transform": place},
        "material": {"cloth": "gray-interlock", "damping": 0.0},
        "initial": {"velocity": [0.0, 0.0, -1.0]},
        "gravity": [0.0, 0.0, -9.81],
        "contact": {"gap": GAP},
        "obstacles": {"ball": {"sphere": {"center": [0.0, 0.0, -0.31], "radius": 0.3}}},
        "time": {"end": 1.0, "step": 0.01, "integrator": "beuler"},
    }


def steps(comm: MPI.Comm) -> tuple[Array, list[int]]:
    """Positions (V, 3) after the steps, in mesh order, and Newton iterations of each."""
    options = direct_solver(comm) | {"ksp_rtol": "1e-10"}  # which triangles are tried hangs on round-off
    for name, value in options.items():
        PETSc.Options().setValue(name, value)
    simulation = SteppedScene(comm, scene_of(thrown_at_a_ball()))
    newton = [simulation.step().newton_iterations for _ in range(STEPS)]
    for name in [*options, *simulation.stepper.our_options]:
        PETSc.Options().delValue(name)
    system = simulation.problem.system
    return gathered(system.points, system.x), newton


@pytest.mark.parametrize(("gap", "most"), [(1e-5, 10), (1e-4, 7)])
def test_small_gaps_take_few_iterations(gap: float, most: int, comm: MPI.Comm) -> None:
    place = {"translate": [-0.5, -0.48, 0.0]}
    scene = thrown_at_a_ball() | {"contact": {"gap": gap}}
    scene["mesh"] = grid(1.0, 1.0, 16, 16, "alternating") | {"transform": place}
    simulation = SteppedScene(comm, scene_of(scene))
    newton = [simulation.step().newton_iterations for _ in range(16)]
    for name in simulation.stepper.our_options:
        PETSc.Options().delValue(name)
    assert np.median(newton[4:]) <= most, newton
