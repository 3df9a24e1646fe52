"""Values written into PETSc's arrays are those that MatSetValues would put there."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import CLOTH, Simulation, grid

from lyra_petsc.assembly.matrix import SystemMatrix
from lyra_petsc.assembly.pattern import BlockPattern
from lyra_petsc.partition.points import Points


def symmetric(points: Points, pattern: BlockPattern, shift: float) -> np.ndarray:
    """Block rows of a symmetric matrix, the same on any number of ranks."""
    rows = points.start + np.repeat(np.arange(points.n_owned), np.diff(pattern.indptr))
    columns = points.global_number[pattern.columns]
    i, j = (3 * number[:, None] + np.arange(1, 4) for number in (rows, columns))
    return np.sin(shift + i[:, :, None] * j[:, None, :])


@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["aij", "baij", "sbaij"])
def test_new_values_replace_old_ones(kind: str, comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, comm) as simulation:
        points, pattern = simulation.model.points, simulation.model.pattern
        first, second = symmetric(points, pattern, 0.0), symmetric(points, pattern, 1.0)
        once, twice = (SystemMatrix(points, pattern, kind, given=False) for _ in range(2))
        assert once.kind == kind
        once.set(second)  # the first time through MatSetValues
        twice.set(first)
        state = twice.mat.stateGet()
        twice.set(second)
        assert twice.mat.stateGet() > state  # or preconditioners would not be set up again
        assert twice.mat.equal(once.mat)
        x = PETSc.Vec().createMPI((3 * points.n_owned, 3 * points.n_global), bsize=3, comm=points.comm)
        x.setArray(np.random.default_rng(comm.rank).standard_normal(3 * points.n_owned))
        y = x.duplicate()
        twice.mat.mult(x, y)
        local = np.empty((points.n_local, 3))
        local[: points.n_owned] = x.getArray().reshape(-1, 3)
        points.update_ghosts(local)
        expected = simulation.model.system._blocks.product(second, local)
        np.testing.assert_allclose(y.getArray().reshape(-1, 3), expected, rtol=0.0, atol=1e-12)
        for matrix in (once, twice):
            matrix.destroy()


@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["baij", "sbaij"])
def test_copies_of_a_matrix_multiply_by_their_own_values(kind: str, comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, comm) as simulation:
        points, pattern = simulation.model.points, simulation.model.pattern
        matrix = SystemMatrix(points, pattern, kind, given=False)
        matrix.set(symmetric(points, pattern, 0.5))
        copy = matrix.mat.duplicate(copy=True)
        copy.scale(3.0)
        x, y = matrix.mat.createVecs()
        z = y.duplicate()
        x.setArray(np.random.default_rng(comm.rank).standard_normal(3 * points.n_owned))
        matrix.mat.mult(x, y)
        copy.mult(x, z)
        np.testing.assert_allclose(z.getArray(), 3.0 * y.getArray(), rtol=0.0, atol=1e-11)
        for item in (matrix, copy):
            item.destroy()


def test_rows_are_put_together_where_petsc_keeps_them() -> None:
    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, MPI.COMM_SELF) as simulation:
        points, pattern = simulation.model.points, simulation.model.pattern
        half, whole = (SystemMatrix(points, pattern, kind, given=False) for kind in ("sbaij", "baij"))
        beside = SystemMatrix(points, pattern, "aij", given=False, beside=whole)
        assert beside.rows is whole.rows
        for matrix in (half, whole, beside):
            matrix.rows[:] = symmetric(points, pattern, 0.5)
            matrix.set(matrix.rows)
        x, y, z = (half.mat.createVecs()[0] for _ in range(3))
        x.setArray(np.random.default_rng(1).standard_normal(3 * points.n_owned))
        half.mat.mult(x, y)
        for matrix in (whole, beside):
            matrix.mat.mult(x, z)
            np.testing.assert_allclose(z.getArray(), y.getArray(), rtol=0.0, atol=1e-12)
        half.rows[0] += np.eye(3)
        half.mat.mult(x, z)
        np.testing.assert_allclose((z - y).getArray()[:3], x.getArray()[:3], rtol=0.0, atol=1e-12)
        for matrix in (half, whole, beside):
            matrix.destroy()


@pytest.mark.parallel
def test_a_larger_diagonal_lasts_as_long_as_it_is_used(comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, comm) as simulation:
        points, pattern = simulation.model.points, simulation.model.pattern
        values = symmetric(points, pattern, 0.5)
        matrix, larger = (SystemMatrix(points, pattern, "baij", given=False) for _ in range(2))
        assert matrix.can_be_larger
        assert not SystemMatrix(points, pattern, "aij", given=False).can_be_larger
        matrix.set(values)
        larger.set(values, 0.3)
        before, state = matrix.mat.duplicate(copy=True), matrix.mat.stateGet()
        with matrix.larger_diagonal(0.3):
            assert matrix.mat.equal(larger.mat)
        assert matrix.mat.equal(before)
        assert matrix.mat.stateGet() == state  # what was made of it stays


@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["baij", "aij"])
def test_of_a_diagonal_matrix_other_blocks_are_left_out(kind: str, comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, comm) as simulation:
        points, pattern = simulation.model.points, simulation.model.pattern
        values = symmetric(points, pattern, 0.5)
        whole = SystemMatrix(points, pattern, kind, given=False)
        part = SystemMatrix(points, pattern, "baij", given=False, beside=whole, diagonal=True)
        assert part.rows is whole.rows
        for _ in range(2):  # through MatSetValues, and straight into the arrays
            part.set(values)
        found = part.mat.getDiagonalBlock().getValuesCSR()[2]
        np.testing.assert_array_equal(found.reshape(-1, 3, 3), values[pattern.indptr[:-1]].transpose(0, 2, 1))
        assert part.mat.getInfo()["nz_used"] == 9 * points.n_global


@pytest.mark.parallel
def test_entries_that_nobody_reads_are_not_written(comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 6, 5), "material": CLOTH}, comm) as simulation:
        points, pattern = simulation.model.points, simulation.model.pattern
        read, unread = (SystemMatrix(points, pattern, "sbaij", given=False) for _ in range(2))
        unread.unread()
        x, y = read.mat.createVecs()
        z = y.duplicate()
        x.setArray(np.random.default_rng(comm.rank).standard_normal(3 * points.n_owned))
        for shift in (0.5, 1.5):
            state = unread.mat.stateGet()
            for matrix in (read, unread):
                matrix.rows[:] = symmetric(points, pattern, shift)
                matrix.set(matrix.rows)
            assert unread.mat.stateGet() > state
            read.mat.mult(x, y)
            unread.mat.mult(x, z)
            np.testing.assert_array_equal(y.getArray(), z.getArray())
        entries = unread.mat.norm(PETSc.NormType.FROBENIUS)
        assert entries == (0.0 if comm.size > 1 else read.mat.norm(PETSc.NormType.FROBENIUS))
