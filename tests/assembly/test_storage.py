"""Values written into PETSc's arrays are those that MatSetValues would put there."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import CLOTH, Simulation, grid

from lyra_petsc.assembly.matrix import SystemMatrix


@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["aij", "baij", "sbaij"])
def test_new_values_replace_old_ones(kind: str, comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, comm) as simulation:
        points, pattern = simulation.model.points, simulation.model.pattern
        rng = np.random.default_rng(comm.rank)
        first, second = rng.standard_normal((2, pattern.n_blocks, 3, 3))
        once, twice = SystemMatrix(points, pattern, kind), SystemMatrix(points, pattern, kind)
        once.set(second)  # the first time through MatSetValues
        twice.set(first)
        state = twice.mat.stateGet()
        twice.set(second)
        assert twice.mat.stateGet() > state  # or preconditioners would not be set up again
        assert twice.mat.equal(once.mat)
        if kind != "sbaij":
            x = PETSc.Vec().createMPI((3 * points.n_owned, 3 * points.n_global), bsize=3, comm=points.comm)
            x.setArray(rng.standard_normal(3 * points.n_owned))
            y = x.duplicate()
            twice.mat.mult(x, y)
            local = np.empty((points.n_local, 3))
            local[: points.n_owned] = x.getArray().reshape(-1, 3)
            points.update_ghosts(local)
            expected = simulation.model.system._blocks.product(second, local)
            np.testing.assert_allclose(y.getArray().reshape(-1, 3), expected, rtol=0.0, atol=1e-12)
        for matrix in (once, twice):
            matrix.destroy()
