"""Remaining error of a step that counts as converged."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, gathered, grid, scene_of, shape

from lyra_petsc.stepping.simulation import SteppedScene

pytestmark = pytest.mark.parallel(2)


def sheet(stiffness: float, dt: float, tolerance: float) -> dict[str, Any]:
    """A level square that falls, held by two corners, in a side wind; 1/8 m between vertices."""
    membrane = {name: stiffness * value for name, value in CLOTH["membrane"].items()}
    return {
        "mesh": grid(1.0, 1.0, 8, 8, "alternating"),
        "material": CLOTH | {"membrane": membrane, "bending": 1e-4, "damping": 0.002},
        "gravity": [0.0, 0.0, -9.81],
        "wind": {"velocity": [2.0, 3.0, 0.0], "density": 1.2, "drag": 0.1},
        "handles": [{"nodes": [0, 8]}],
        "time": {"end": 12 * dt, "step": dt},
        "solver": {"force_tolerance": tolerance, "step_tolerance": tolerance},
    }


def state_of(simulation: SteppedScene) -> tuple[np.ndarray, np.ndarray]:
    return simulation.problem.equations.x, simulation.problem.equations.v


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
@pytest.mark.parametrize(("stiffness", "dt"), [(1.0, 0.01), (1.0, 0.04), (1000.0, 0.01)])
def test_errors_of_positions_are_within_the_tolerance(
    stiffness: float, dt: float, tolerance: float, comm: MPI.Comm
) -> None:
    asked = SteppedScene(comm, scene_of(sheet(stiffness, dt, tolerance)))
    exact = SteppedScene(comm, scene_of(sheet(stiffness, dt, 1e-11)))
    spacing = asked.problem.whole.spacing
    iterations = []
    while not asked.finished:
        for values, state in zip(state_of(exact), state_of(asked), strict=True):
            points = exact.problem.points
            values[: points.n_owned] = gathered(asked.problem.points, state)[points.mesh_vertices]
            points.update_ghosts(values)
        report, beside = asked.step(), exact.step()
        iterations.append((report.newton_iterations, beside.newton_iterations))
        x, true = (shape(one) for one in (asked, exact))
        assert np.abs(x - true).max() <= tolerance * spacing
        assert report.remaining <= tolerance * spacing
    assert any(fewer < more for fewer, more in iterations)
    asked.destroy()
    exact.destroy()
