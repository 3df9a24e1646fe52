"""Extrapolation of velocities from earlier steps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from mpi4py import MPI
from physics import Simulation, grid

from lyra_petsc.stepping.newton.extrapolation import Extrapolation


@pytest.mark.parallel(2)
def test_a_falling_sheet_takes_fewer_linear_iterations(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = {
        "mesh": grid(1.0, 1.0, 12, 12),
        "material": {"cloth": "gray-interlock", "damping": 0.03},
        "gravity": [0, 0, -9.81],
        "handles": [{"nodes": [156, 168]}],
        "time": {"end": 1.0, "step": 0.005, "integrator": "semi-implicit"},
    }

    def iterations() -> tuple[int, np.ndarray]:
        with Simulation(scene, comm, {"pc_type": "pbjacobi"}) as simulation:
            count = sum(simulation.step(0.005).linear_iterations for _ in range(40))
            return count, simulation.x

    fewer, x = iterations()
    monkeypatch.setattr(Extrapolation, "extrapolate", lambda self, t1, t0, v: v.copy())
    more, same = iterations()
    assert fewer < 0.95 * more  # 0.90
    np.testing.assert_allclose(x, same, rtol=0.0, atol=1e-6)


def test_a_resumed_run_extrapolates_the_same() -> None:
    times = [0.0, 0.1, 0.25, 0.3, 0.5]
    whole = Extrapolation(MPI.COMM_SELF)
    for before, after in pairwise(times):
        whole.extrapolate(after, before, curved(before))
    whole.record(0.5, curved(0.5))
    arrays, numbers = whole.saved_state()
    resumed = Extrapolation(MPI.COMM_SELF)
    resumed.restore(arrays, numbers, 0.5, curved(0.5))
    assert numbers["degree"] > 0
    for before, after in pairwise([0.5, 0.6, 0.75, 0.8]):
        guess = whole.extrapolate(after, before, curved(before))
        np.testing.assert_array_equal(resumed.extrapolate(after, before, curved(before)), guess)


def curved(t: float) -> np.ndarray:
    """Velocities (2, 3) [m/s] that no polynomial reproduces."""
    return np.array([[1.0, t, t * t], [np.sin(t), np.exp(t), t**3]])
