"""PETSc's multigrid, PCMG (``-pc_type mg``), on our levels: any cycle and smoother, by its own options."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.assembly.matrix import SystemMatrix
from lyra_petsc.assembly.pattern import begins
from lyra_petsc.solvers.hierarchy import Hierarchy, Level
from lyra_petsc.solvers.options import is_set

Array = NDArray[np.float64]


class Interpolation:
    """The matrix (3 n fine, 3 n coarse) that interpolates to a level from the next coarser one."""

    def __init__(self, level: Level, coarser: Level) -> None:
        rows, fine, points = level.interpolation, level.points, coarser.points
        assert rows is not None
        self._comm, self._weights = fine.comm, rows.weights
        counts = np.diff(rows.start)
        row = np.repeat(np.arange(fine.n_owned), counts)
        order = np.argsort(np.concatenate([3 * row, 3 * row + 1, 3 * row + 2]), kind="stable")
        self._order, self._row = order, row
        parents = 3 * rows.parents
        self._columns = np.concatenate([parents, parents + 1, parents + 2])[order].astype(PETSc.IntType)
        self._indptr = begins(np.repeat(counts, 3)).astype(PETSc.IntType)
        sizes = (3 * fine.n_owned, 3 * fine.n_global), (3 * points.n_owned, 3 * points.n_global)
        own = (rows.parents >= points.start) & (rows.parents < points.start + points.n_owned)
        inside = np.bincount(row[own], minlength=fine.n_owned)
        nnz = [np.repeat(part, 3).astype(PETSc.IntType) for part in (inside, counts - inside)]
        self.mat = PETSc.Mat().createAIJ(sizes, nnz=nnz if fine.comm.size > 1 else nnz[0], comm=fine.comm)
        self._free: Array | None = None

    def set(self, free: Array) -> None:
        """Interpolate to coordinates only that are free (n_owned, 3); collective."""
        changed = self._free is None or not np.array_equal(free, self._free)
        if not self._comm.allreduce(int(changed)):
            return
        self._free = free.copy()
        values = np.concatenate([self._weights * free[self._row, axis] for axis in range(3)])
        self.mat.setValuesCSR(self._indptr, self._columns, values[self._order])
        self.mat.assemble()


class PetscCycle:
    """Gives PCMG its levels; before its options are read."""

    def __init__(self, pc: PETSc.PC, hierarchy: Hierarchy) -> None:
        levels = hierarchy.levels
        self._interpolations = [Interpolation(*pair) for pair in pairwise(levels)]
        kinds = ["baij"] * (len(levels) - 2) + ["aij"]
        self._matrices = [
            SystemMatrix(level.points, level.pattern, kind, given=False)
            for level, kind in zip(levels[1:], kinds, strict=False)
        ]
        pc.setType(PETSc.PC.Type.MG)
        pc.setMGLevels(len(levels))
        if is_set("pc_mg_levels"):
            # another number than there are levels would make PCMG throw them away
            PETSc.Options().setValue("pc_mg_levels", len(levels))
        for below, interpolation in enumerate(self._interpolations):
            number = len(levels) - 1 - below
            interpolation.set(np.ones((levels[below].points.n_owned, 3)))
            matrix = self._matrices[below].mat
            pc.setMGInterpolation(number, interpolation.mat)
            solver = pc.getMGSmoother(number - 1) if number > 1 else pc.getMGCoarseSolve()
            solver.setOperators(matrix)
            if number > 1:
                pc.getMGSmootherUp(number - 1).setOperators(matrix)
            # of its own accord PCMG would ask the DM of SNES for them, which knows no vectors
            right, left = interpolation.mat.createVecs()
            pc.setMGR(number, left)
            pc.setMGRhs(number - 1, right)
            pc.setMGX(number - 1, right.duplicate())

    def update(self, block_rows: Iterator[tuple[Array, Array]]) -> None:
        """Take the levels' new block rows; collective."""
        for number, (values, free) in enumerate(block_rows):
            if number > 0:
                self._matrices[number - 1].set(values)
            if number < len(self._interpolations):
                self._interpolations[number].set(free)

    def destroy(self) -> None:
        """Free the PETSc objects; collective."""
        for matrix in self._matrices:
            matrix.destroy()
        for interpolation in self._interpolations:
            interpolation.mat.destroy()
