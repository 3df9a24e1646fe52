"""Damping from the stiffness, and the stiffness back from it."""

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


@pytest.mark.parallel
def test_damping_plus_stiffness_is_one_multiple_where_there_is_one_factor(comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(0.5, 0.4, 4, 3), "material": MATERIAL}, comm) as simulation:
        system = simulation.model.system
        damping, blocks = system._damping, system._blocks
        x = system.x + 0.02 * np.sin(10.0 * system.x[:, ::-1])
        damping.freeze(x)
        expected, found = blocks.zeros(), blocks.zeros()
        damping.into(expected)
        for term in system.elastic:
            blocks.add_stiffness(term, x, 1.0, 0.3, expected)
        blocks.add_diagonal(diagonal := 1.0 + np.arange(len(system.mass)), expected)
        if damping.with_stiffness_into(x, 0.3, diagonal, found):
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
        else:
            assert comm.size > 1  # a rank without an element of a term takes the long way
        assert not damping.with_stiffness_into(x + 1e-9, 0.3, diagonal, found)


def test_two_factors_are_no_multiple() -> None:
    scene = {
        "mesh": grid(0.5, 0.4, 4, 3),
        "material": MATERIAL,
        "handles": [{"nodes": [0], "stiffness": 3.0}],
    }
    with Simulation(scene, MPI.COMM_SELF) as simulation:
        system = simulation.model.system
        system._damping.freeze(system.x)
        values = system._blocks.zeros()
        assert not system._damping.with_stiffness_into(system.x, 0.3, system.mass, values)


def test_forces_are_asked_for_at_new_velocities_and_geometry(comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(0.5, 0.4, 4, 3), "material": MATERIAL}, comm) as simulation:
        system = simulation.model.system
        v = np.cos(5.0 * system.x)
        system._damping.freeze(system.x)
        once = system._damping.product(v)
        np.testing.assert_array_equal(system._damping.product(v), once)
        assert not system._damping.product(0.0 * v).any()
        np.testing.assert_allclose(system._damping.product(2.0 * v), 2.0 * once, rtol=1e-12, atol=1e-15)
        system._damping.freeze(system.x + 0.05 * np.sin(9.0 * system.x[:, ::-1]))
        assert np.abs(system._damping.product(v) - once).max() > 1e-6 * np.abs(once).max()
