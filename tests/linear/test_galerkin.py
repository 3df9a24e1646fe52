"""Coarse block rows are interpolationᵀ · matrix · interpolation, compared with PETSc's product."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import CLOTH, Simulation, gathered, grid

from lyra_petsc.linear.hierarchy import Hierarchy, InterpolationRows, Level, interpolations
from lyra_petsc.linear.matrix import AssembledMatrix
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.mesh import distribute
from lyra_petsc.mesh.points import Points


def symmetric(points: Points, pattern: BlockPattern) -> np.ndarray:
    """Block rows (n_blocks, 3, 3) of a matrix whose entries are a symmetric function of row and column."""
    row = np.repeat(points.global_number[: points.n_owned], np.diff(pattern.indptr))
    i = 3 * row[:, None, None] + np.arange(3)[:, None]
    j = 3 * points.global_number[pattern.columns][:, None, None] + np.arange(3)
    return ((7 * i * j + 3 * (i + j)) % 101) / 50.0 - 1.0


class Interpolation:
    """The PETSc matrix (3 n fine, 3 n coarse) that interpolates to a level from the next coarser one."""

    def __init__(self, rows: InterpolationRows, level: Level, coarser: Level) -> None:
        fine, points = level.points, coarser.points
        row = np.repeat(fine.start + np.arange(fine.n_owned), np.diff(rows.start))
        self._entries, self._first = (row, rows.parents, rows.weights), fine.start
        sizes = (3 * fine.n_owned, 3 * fine.n_global), (3 * points.n_owned, 3 * points.n_global)
        width = int(np.diff(rows.start).max(initial=0))
        self.mat = PETSc.Mat().createAIJ(sizes, nnz=(width, width), comm=fine.comm)

    def set(self, free: np.ndarray) -> None:
        """Set the free coordinates (n_owned, 3), to which alone values are interpolated; collective."""
        for row, parent, weight in zip(*self._entries, strict=True):
            for axis in range(3):
                value = weight * free[row - self._first, axis]
                self.mat.setValue(3 * row + axis, 3 * parent + axis, value)
        self.mat.assemble()


@pytest.mark.parallel
@pytest.mark.parametrize("held", [False, True], ids=["free", "some held"])
def test_coarse_matrices_are_galerkin_products(held: bool, comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 60, 48), "material": CLOTH}, comm) as simulation:
        problem = simulation.problem
        points, pattern = problem.points, problem.pattern
        mask = np.zeros((points.n_local, 3), dtype=bool)
        if held:
            mask[:, 0] = points.global_number % 7 == 0
            mask[points.global_number % 11 == 0] = True
        rng = np.random.default_rng(comm.rank)
        values = symmetric(points, pattern)
        assembled = problem.discretisation.rows
        assembled.constrain(values, mask, assembled.constrained_entries(mask))
        between = interpolations(points, problem.surface, 3)
        hierarchy = Hierarchy(points, pattern, between)
        assert len(hierarchy.levels) == 3
        list(hierarchy.block_rows(np.ones_like(values), ~mask))  # earlier values must have no effect
        rows = list(zip(hierarchy.levels, hierarchy.block_rows(values, mask), strict=True))
        for one, another, share in zip(rows, rows[1:], between, strict=False):
            (level, (of_fine, free)), (coarser, (of_coarse, coarse_free)) = one, another
            fine, coarse = (AssembledMatrix(at.points, at.pattern, "aij") for at in (level, coarser))
            fine.set(of_fine)
            coarse.set(of_coarse)
            interpolation = Interpolation(share, level, coarser)
            interpolation.set(free)
            product = fine.mat.ptap(interpolation.mat)
            x, _ = product.createVecs()
            x.setArray(rng.standard_normal(x.getLocalSize()))
            expected, found, diagonal_part = x.duplicate(), x.duplicate(), x.duplicate()
            product.mult(x, expected)
            # coordinates that nothing is interpolated from have a one on the diagonal
            product.getDiagonal(diagonal_part)
            dead = diagonal_part.getArray() == 0.0
            assert np.array_equal(dead.reshape(-1, 3), coarse_free == 0.0)
            expected.getArray()[dead] = x.getArray()[dead]
            coarse.mat.mult(x, found)
            np.testing.assert_allclose(found.getArray(), expected.getArray(), rtol=0.0, atol=1e-11)
            for item in (fine, coarse, interpolation.mat, product):
                item.destroy()
        hierarchy.destroy()


@pytest.mark.parallel
def test_coarse_meshes_do_not_depend_on_the_partition(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch
) -> None:
    def at_random(ranks: MPI.Comm, graph: object, n_vertices: int, places: object) -> tuple[np.ndarray, str]:
        return np.random.default_rng(1).integers(ranks.size, size=n_vertices), "at random"

    monkeypatch.setattr(distribute, "partition", at_random)
    there_and_back = []
    for ranks in (comm, MPI.COMM_SELF):
        with Simulation({"mesh": grid(1, 1, 60, 48), "material": CLOTH}, ranks) as simulation:
            problem = simulation.problem
            between = interpolations(problem.points, problem.surface, 4)
            hierarchy = Hierarchy(problem.points, problem.pattern, between)
            down = []
            for share, *levels in zip(between, hierarchy.levels, hierarchy.levels[1:], strict=False):
                down.append(Interpolation(share, *levels))
                down[-1].set(np.ones((levels[0].points.n_owned, 3)))
            x = down[0].mat.createVecLeft()
            x.setArray(problem.equations.x[: problem.points.n_owned].ravel())
            for each in down:
                coarse = each.mat.createVecRight()
                each.mat.multTranspose(x, coarse)
                x = coarse
            for each in reversed(down):
                fine = each.mat.createVecLeft()
                each.mat.mult(x, fine)
                x = fine
            there_and_back.append(gathered(problem.points, x.getArray().reshape(-1, 3)))
            for each in down:
                each.mat.destroy()
            hierarchy.destroy()
    np.testing.assert_allclose(*there_and_back, rtol=0.0, atol=1e-10 * np.abs(there_and_back[0]).max())
