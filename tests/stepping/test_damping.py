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
        equations = simulation.problem.equations
        damping, blocks = equations.damping, equations.discretisation.rows
        x = equations.x + 0.02 * np.sin(10.0 * equations.x[:, ::-1])
        damping.freeze(x, equations.step.frozen, equations.step.frozen)
        expected, found = blocks.zeros(), blocks.zeros()
        damping.assemble(expected, diagonal := 1.0 + np.arange(len(equations.mass)))
        for term in equations.active.elastic:
            blocks.add_stiffness(term, x, equations.step.frozen[term], 1.0, 0.3, expected)
        none = np.empty(0, dtype=np.int64)
        if damping.assemble_with_stiffness(0.3, diagonal, found, none):
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
        else:
            assert comm.size > 1  # a rank without an element of a term takes the long way


def test_damping_forces_follow_velocities_and_geometry(comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(0.5, 0.4, 4, 3), "material": MATERIAL}, comm) as simulation:
        equations = simulation.problem.equations
        frozen, v = equations.step.frozen, np.cos(5.0 * equations.x)
        equations.damping.freeze(equations.x, frozen, frozen)
        once = equations.damping.product(v)
        assert not equations.damping.product(0.0 * v).any()
        np.testing.assert_allclose(equations.damping.product(2.0 * v), 2.0 * once, rtol=1e-12, atol=1e-15)
        equations.damping.freeze(equations.x + 0.05 * np.sin(9.0 * equations.x[:, ::-1]), frozen, frozen)
        assert np.abs(equations.damping.product(v) - once).max() > 1e-6 * np.abs(once).max()
