"""Preconditioners that are reused in several steps."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, grid, shape, stepped


@pytest.mark.parallel(2)
@pytest.mark.parametrize("kind", ["", "pbjacobi", "gamg"])
def test_steps_equal_those_with_a_preconditioner_per_step(comm: MPI.Comm, kind: str) -> None:
    scene = {
        "mesh": grid(0.6, 0.4, 6, 5, "alternating"),
        "material": CLOTH | {"bending": 1e-4, "damping": 0.01},
        "gravity": [0, 0, -9.81],
        "handles": [{"nodes": [0]}, {"nodes": [6], "from": 0.05, "until": 0.15}],
        "time": {"end": 0.3, "step": 0.01, "integrator": "semi-implicit"},
    }
    ends = []
    for lag in (None, 1):
        given = ({"pc_type": kind} if kind else {}) | ({"snes_lag_preconditioner": lag} if lag else {})
        with stepped(comm, scene, **given) as simulation:
            reused = 0
            while not simulation.finished:
                simulation.step()
                reused += simulation.stepper.solver.linear.reuse.reused
            assert (reused > 10) == (lag is None)
            ends.append(shape(simulation))
    # the linear tolerance of a step is 1e-6 of its change of velocities
    np.testing.assert_allclose(*ends, atol=1e-6)
