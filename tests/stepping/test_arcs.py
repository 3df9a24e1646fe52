"""Newton steps of equilibria along arcs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import grid, rotation, scene_of

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.verification.cases.shells import open_cylinder_scene, slit_annulus_scene
from lyra_petsc.stepping.newton.arcs import MAX_TURN, Arcs
from lyra_petsc.stepping.simulation import SteppedScene

SHEET: dict[str, Any] = {
    "mesh": grid(1.0, 0.8, 6, 5, "alternating"),
    "material": {"young": 1e7, "poisson": 0.3, "thickness": 0.01, "density": 1.0},
    "gravity": [0, 0, 0],
    "time": {"analysis": "static"},
}
AXIS = np.array([0.6, 0.0, 0.8])


def turning(simulation: SteppedScene, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Zero velocities, and the increment that is tangential to a rotation about the origin."""
    equations, n = simulation.problem.equations, simulation.problem.points.n_vertices
    equations.begin_step(0.0, 1.0)
    increment = np.zeros_like(equations.step.v_h)
    increment[:n] = angle * np.cross(AXIS, equations.x[:n])
    for term in equations.active.with_edges:
        places = term.edge_indices
        own = places < increment.size
        increment.reshape(-1)[places[own]] = (
            angle * (term.of_edges.length * (term.frames.direction @ AXIS))[own]
        )
    return equations.stationary_velocity(), increment / equations.step.stage.c


@pytest.mark.parallel(2, 3)
def test_a_rotation_keeps_the_shape(comm: MPI.Comm) -> None:
    simulation = SteppedScene(comm, scene_of(SHEET))
    equations, n = simulation.problem.equations, simulation.problem.points.n_vertices
    staying, increment = turning(simulation, 0.9 * MAX_TURN)
    arcs = Arcs(equations)
    bent, straight = arcs.curve(staying, increment)
    np.testing.assert_array_equal(straight, increment)
    start, there = equations.x[:n].copy(), equations.displacement(staying, bent)
    moved = (there[0] + there[1])[:n]
    turned = start @ rotation(AXIS, 0.9 * MAX_TURN).T

    # nothing holds it: its centre may move
    def middle(x: np.ndarray) -> np.ndarray:
        total = np.zeros(3)
        comm.Allreduce(x.sum(axis=0), total)
        return total / comm.allreduce(len(x))

    np.testing.assert_allclose(moved - middle(moved), turned - middle(turned), atol=1e-7)
    straight_end = there[0] + equations.displacement(staying, increment)[1]
    energy = [sum(float(t.energies(x, equations.step.frozen[t]).sum()) for t in equations.active.elastic)
              for x in (there[0] + there[1], straight_end)]  # fmt: skip
    bending, tangent = (comm.allreduce(each) for each in energy)
    assert bending < 1e-9 * tangent
    arcs.destroy()
    simulation.destroy()


@pytest.mark.parallel(1)
@pytest.mark.parametrize(
    ("shell", "most"),
    [
        # without tangents 54, with one correction of a step 58, without arcs 66; the other 42, 53
        (lambda bench: slit_annulus_scene(bench, 12), 50),  # 46
        (lambda bench: open_cylinder_scene(bench, 16, "alternating"), 40),  # 36
    ],
)
def test_a_shell_with_large_rotations_takes_few_iterations(shell: Any, most: int) -> None:
    bench, step = Bench(MPI.COMM_SELF, direct=False), 1.0 / 15.0
    content = shell(bench)[0] | {
        "gravity": [0, 0, 0],
        "time": {"analysis": "static", "step": step},
        "solver": {"force_tolerance": 1e-6},
        "petsc": {"ts_adapt_dt_max": step},
    }
    with bench.simulation(content) as trial:
        newton = 0
        while not trial.simulation.finished:
            newton += trial.step().newton_iterations
    assert newton <= most
