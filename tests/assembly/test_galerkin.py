"""Coarse block rows are interpolationᵀ · matrix · interpolation, as PETSc works it out."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import CLOTH, Simulation, grid

from lyra_petsc.assembly.matrix import SystemMatrix
from lyra_petsc.solvers.multigrid import Hierarchy


@pytest.mark.parallel
@pytest.mark.parametrize("held", [False, True], ids=["free", "some held"])
def test_coarse_matrices_are_galerkin_products(held: bool, comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 30, 24), "material": CLOTH}, comm) as simulation:
        model = simulation.model
        points, pattern = model.points, model.pattern
        mask = np.zeros((points.n_local, 3), dtype=bool)
        if held:
            mask[:, 0] = points.global_number % 7 == 0
            mask[points.global_number % 11 == 0] = True
        rng = np.random.default_rng(comm.rank)
        values = rng.standard_normal((pattern.n_blocks, 3, 3))
        model.system._blocks.constrain(values, mask, np.arange(points.n_owned))
        hierarchy = Hierarchy(points, pattern, model.surface)
        assert hierarchy.levels
        fine = SystemMatrix(points, pattern, "aij")
        fine.set(values)
        hierarchy.set(np.ones_like(values), ~mask)  # what is left from before must not show
        hierarchy.set(values, mask)
        level = hierarchy.levels[0]
        product = fine.mat.ptap(level.interpolation)
        x, _ = product.createVecs()
        x.setArray(rng.standard_normal(x.getLocalSize()))
        expected, found, held_part = x.duplicate(), x.duplicate(), x.duplicate()
        product.mult(x, expected)
        # coordinates that nothing is interpolated from have a one on the diagonal
        product.getDiagonal(held_part)
        dead = held_part.getArray() == 0.0
        expected.getArray()[dead] = x.getArray()[dead]
        level.matrix.mat.mult(x, found)
        np.testing.assert_allclose(found.getArray(), expected.getArray(), rtol=0.0, atol=1e-11)
        hierarchy.destroy()
        fine.destroy()
        product.destroy()


@pytest.mark.parallel
def test_nothing_is_interpolated_to_held_coordinates(comm: MPI.Comm) -> None:
    with Simulation({"mesh": grid(1, 1, 30, 24), "material": CLOTH}, comm) as simulation:
        points = simulation.model.points
        hierarchy = Hierarchy(points, simulation.model.pattern, simulation.model.surface)
        mask = np.zeros((points.n_local, 3), dtype=bool)
        mask[points.global_number % 3 == 0, 1] = True
        hierarchy.set(np.zeros((simulation.model.pattern.n_blocks, 3, 3)), mask)
        interpolation = hierarchy.levels[0].interpolation
        ones, out = interpolation.createVecs()
        ones.set(1.0)
        interpolation.mult(ones, out)
        expected = np.where(mask[: points.n_owned], 0.0, 1.0)
        np.testing.assert_allclose(out.getArray().reshape(-1, 3), expected, atol=1e-12)
        assert PETSc.Mat.Type.AIJ in interpolation.getType()
        hierarchy.destroy()
