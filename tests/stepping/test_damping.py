"""Damping matrices from the stiffness, and the stiffness from them."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from physics import Simulation, grid

MATERIAL = {
    "density": 0.2,
    "membrane": {"c11": 60.0, "c22": 40.0, "c12": 15.0, "c33": 12.0},
    "bending": 1e-3,
    "damping": 0.01,
}


@pytest.mark.parallel(2)
def test_damping_plus_stiffness_is_a_multiple_if_all_factors_are_equal(comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(0.5, 0.4, 4, 3), "material": MATERIAL}, comm) as simulation:
        system = simulation.problem.system
        damping, blocks = system.damping, system.discretisation.rows
        x = system.x + 0.02 * np.sin(10.0 * system.x[:, ::-1])
        damping.freeze(x, system.step.frozen)
        expected, found = blocks.zeros(), blocks.zeros()
        damping.assemble(expected, diagonal := 1.0 + np.arange(len(system.mass)))
        for term in system.active.elastic:
            blocks.add_stiffness(term, x, system.step.frozen[term], 1.0, 0.3, expected)
        none = np.empty(0, dtype=np.int64)
        if damping.assemble_with_stiffness(0.3, diagonal, found, none):
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
        else:
            assert comm.size > 1  # a rank without an element of a term takes the long way


def test_damping_forces_follow_velocities_and_geometry(comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(0.5, 0.4, 4, 3), "material": MATERIAL}, comm) as simulation:
        system = simulation.problem.system
        v = np.cos(5.0 * system.x)
        system.damping.freeze(system.x, system.step.frozen)
        once = system.damping.product(v)
        assert not system.damping.product(0.0 * v).any()
        np.testing.assert_allclose(system.damping.product(2.0 * v), 2.0 * once, rtol=1e-12, atol=1e-15)
        system.damping.freeze(system.x + 0.05 * np.sin(9.0 * system.x[:, ::-1]), system.step.frozen)
        assert np.abs(system.damping.product(v) - once).max() > 1e-6 * np.abs(once).max()
