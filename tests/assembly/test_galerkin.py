"""Coarse block rows are interpolationᵀ · matrix · interpolation, as PETSc works it out."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import CLOTH, Simulation, grid

from lyra_petsc.assembly.matrix import SystemMatrix
from lyra_petsc.assembly.pattern import BlockPattern
from lyra_petsc.partition.points import Points
from lyra_petsc.solvers.hierarchy import Hierarchy
from lyra_petsc.solvers.pcmg import Interpolation


def symmetric(points: Points, pattern: BlockPattern) -> np.ndarray:
    """Block rows (n_blocks, 3, 3) of a matrix whose entries are a symmetric function of row and column."""
    row = np.repeat(points.global_number[: points.n_owned], np.diff(pattern.indptr))
    i = 3 * row[:, None, None] + np.arange(3)[:, None]
    j = 3 * points.global_number[pattern.columns][:, None, None] + np.arange(3)
    return ((7 * i * j + 3 * (i + j)) % 101) / 50.0 - 1.0


@pytest.mark.parallel
@pytest.mark.parametrize("held", [False, True], ids=["free", "some held"])
def test_coarse_matrices_are_galerkin_products(held: bool, comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 60, 48), "material": CLOTH}, comm) as simulation:
        model = simulation.model
        points, pattern = model.points, model.pattern
        mask = np.zeros((points.n_local, 3), dtype=bool)
        if held:
            mask[:, 0] = points.global_number % 7 == 0
            mask[points.global_number % 11 == 0] = True
        rng = np.random.default_rng(comm.rank)
        values = symmetric(points, pattern)
        model.system._blocks.constrain(values, mask, np.arange(points.n_owned))
        hierarchy = Hierarchy(points, pattern, model.surface, most=3)
        assert len(hierarchy.levels) == 3
        list(hierarchy.block_rows(np.ones_like(values), ~mask))  # what is left from before must not show
        rows = list(zip(hierarchy.levels, hierarchy.block_rows(values, mask), strict=True))
        for (level, (of_fine, free)), (coarser, (of_coarse, coarse_free)) in pairwise(rows):
            fine, coarse = (SystemMatrix(at.points, at.pattern, "aij") for at in (level, coarser))
            fine.set(of_fine)
            coarse.set(of_coarse)
            interpolation = Interpolation(level, coarser)
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
def test_nothing_is_interpolated_to_held_coordinates(comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 30, 24), "material": CLOTH}, comm) as simulation:
        points = simulation.model.points
        hierarchy = Hierarchy(points, simulation.model.pattern, simulation.model.surface, most=2)
        mask = np.zeros((points.n_local, 3), dtype=bool)
        mask[points.global_number % 3 == 0, 1] = True
        interpolation = Interpolation(*hierarchy.levels)
        for held in (~mask, mask):
            rows = np.zeros((simulation.model.pattern.n_blocks, 3, 3))
            _, free = next(hierarchy.block_rows(rows, held))
            interpolation.set(free)
            ones, out = interpolation.mat.createVecs()
            ones.set(1.0)
            interpolation.mat.mult(ones, out)
            expected = np.where(held[: points.n_owned], 0.0, 1.0)
            np.testing.assert_allclose(out.getArray().reshape(-1, 3), expected, atol=1e-12)
        assert PETSc.Mat.Type.AIJ in interpolation.mat.getType()
        interpolation.mat.destroy()
        hierarchy.destroy()
