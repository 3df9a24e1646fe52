"""Geometric multigrid by PETSc's PCMG: our coarse meshes and coarse matrices, PETSc's cycle and smoothers.

Multigrid that looks at the matrix alone (GAMG) interpolates constants well; bending needs linear functions,
and those a mesh gives for free. Coarse matrices are Galerkin products in block storage.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.assembly.galerkin import Galerkin
from lyra_petsc.assembly.matrix import SystemMatrix
from lyra_petsc.assembly.pattern import BlockPattern
from lyra_petsc.partition.points import Points
from lyra_petsc.solvers.coarsening import coarsen
from lyra_petsc.solvers.options import is_set

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

COARSEST = 300
"""Vertices, over all ranks, at which a factorisation takes over."""

WORTH = 0.7
"""Fraction of the vertices left by a coarsening above which another brings nothing."""


@dataclass(frozen=True)
class Surface:
    """A rank's part of the mesh.

    Attributes
    ----------
    x : (n_local, 3)
        Positions [m] that interpolation is linear in.
    triangles : (F, 3)
        Local numbering.
    """

    x: Array
    triangles: NDArray[np.int32]


MOST_LEVELS = 20
"""Of them the fine one is one; ``-pc_mg_levels``."""


class Level:
    """A coarse matrix, how it comes from the finer one, and the interpolation from it.

    Attributes
    ----------
    matrix : SystemMatrix
    interpolation : PETSc.Mat
        (3 n fine, 3 n coarse).
    """

    def __init__(self, fine: Points, galerkin: Galerkin, parents: Ints, weights: Array, kind: str) -> None:
        self.galerkin, self._fine = galerkin, fine
        self.matrix = SystemMatrix(galerkin.points, galerkin.pattern, kind, given=False)
        n, coarse = fine.n_owned, galerkin.points
        self._there = np.repeat(parents >= 0, 3, axis=0)
        self._weights = weights
        counts = self._there.sum(axis=1)
        self._indptr = np.concatenate([[0], np.cumsum(counts)]).astype(PETSc.IntType)
        columns = 3 * (coarse.start + parents[:, None, :]) + np.arange(3)[:, None]
        self._columns = columns.reshape(3 * n, 3)[self._there].astype(PETSc.IntType)
        sizes = (3 * n, 3 * fine.n_global), (3 * coarse.n_owned, 3 * coarse.n_global)
        self.interpolation = PETSc.Mat().createAIJ(
            sizes, nnz=(3, 0) if fine.comm.size > 1 else 3, comm=fine.comm
        )
        self.free = np.ones((fine.n_local, 3))
        self.set_free(self.free)

    def set_free(self, free: Array) -> None:
        """Interpolate to these coordinates (n_local, 3) only: 1 for those, 0 for others; collective."""
        self.free = free
        entries = self._weights[:, None, :] * free[: self._fine.n_owned, :, None]
        values = entries.reshape(-1, 3)[self._there]
        self.interpolation.setValuesCSR(self._indptr, self._columns, values)
        self.interpolation.assemble()

    def set(self, values: Array) -> Array:
        """New fine block rows (n_blocks, 3, 3); returns the coarse ones; collective."""
        coarse = self.galerkin.project(values, self.free)
        self.matrix.set(coarse)
        return coarse

    def destroy(self) -> None:
        """Free the PETSc objects; collective."""
        self.matrix.destroy()
        self.interpolation.destroy()
        self.galerkin.points.destroy()


class Hierarchy:
    """The coarse levels of a mesh, finest first.

    Parameters
    ----------
    points : Points
    pattern : BlockPattern
    surface : Surface
    """

    def __init__(self, points: Points, pattern: BlockPattern, surface: Surface) -> None:
        self.levels: list[Level] = []
        n = points.n_owned
        most = max(2, PETSc.Options().getInt("pc_mg_levels", MOST_LEVELS))
        x = surface.x[:n]
        triangles = surface.triangles[(surface.triangles < n).all(axis=1)].astype(np.int64)
        while len(self.levels) + 1 < most and (points.n_global > COARSEST or not self.levels):
            coarse = coarsen(x, triangles)
            left = points.comm.allreduce(len(coarse.vertices))
            if left > WORTH * points.n_global:
                break
            last = left <= COARSEST or len(self.levels) + 2 == most
            galerkin = Galerkin(points, pattern, coarse.parents, coarse.weights, len(coarse.vertices))
            level = Level(points, galerkin, coarse.parents, coarse.weights, "aij" if last else "baij")
            self.levels.append(level)
            points, pattern = galerkin.points, galerkin.pattern
            x, triangles = x[coarse.vertices], coarse.triangles

    def attach(self, pc: PETSc.PC) -> None:
        """Give PCMG its levels; before its options are read; collective."""
        pc.setType(PETSc.PC.Type.MG)
        count = len(self.levels) + 1
        pc.setMGLevels(count)
        if is_set("pc_mg_levels"):
            # another number than there are levels would make PCMG throw them away
            PETSc.Options().setValue("pc_mg_levels", count)
        for below, level in enumerate(self.levels):
            number = count - 1 - below
            pc.setMGInterpolation(number, level.interpolation)
            solver = pc.getMGSmoother(number - 1) if number > 1 else pc.getMGCoarseSolve()
            solver.setOperators(level.matrix.mat)
            if number > 1:
                pc.getMGSmootherUp(number - 1).setOperators(level.matrix.mat)
            # of its own accord PCMG would ask the DM of SNES for them, which knows no vectors
            right, left = level.interpolation.createVecs()
            pc.setMGR(number, left)
            pc.setMGRhs(number - 1, right)
            pc.setMGX(number - 1, right.duplicate())

    def set(self, values: Array, held: Mask) -> None:
        """Coarse matrices of new block rows; held (n_local, 3) are the prescribed coordinates; collective."""
        if self.levels:
            free = np.where(held, 0.0, 1.0)
            first = self.levels[0]
            changed = not np.array_equal(free, first.free)
            if first.galerkin.points.comm.allreduce(int(changed)):
                first.set_free(free)
        for level in self.levels:
            values = level.set(values)

    @classmethod
    def where_asked_for(
        cls,
        ksp: PETSc.KSP,
        matrix: SystemMatrix,
        points: Points,
        pattern: BlockPattern,
        surface: Surface,
        held: Callable[[], Mask],
    ) -> Hierarchy | None:
        """Levels that follow ``matrix``, attached to the solver; None unless ``-pc_type mg``; collective."""
        if PETSc.Options().getString("pc_type", "") != PETSc.PC.Type.MG:
            return None
        made = cls(points, pattern, surface)
        made.attach(ksp.getPC())
        matrix.followers.append(lambda values: made.set(values, held()))
        return made

    def destroy(self) -> None:
        """Free the PETSc objects; collective."""
        for level in self.levels:
            level.destroy()
        self.levels = []
