"""Signs of the eigenvalues of a symmetric matrix, from the pivots of its factorisation, and its lowest mode.

By Sylvester's law of inertia a symmetric matrix has as many negative eigenvalues as its LDLᵀ factorisation
has negative pivots. MUMPS factors it, in a KSP with the options prefix ``stability_``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.linear.failed_factors import LARGEST, WORKSPACE_ERRORS
from lyra_petsc.linear.matrix import AssembledMatrix
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.mesh.points import Layout

PREFIX = "stability_"

NEUTRAL = 1e-10
"""Size of a pivot, relative to the largest diagonal entry, below which its sign is round-off."""

FIRST_SHIFT, MORE = 1e-8, 10.0
"""First shift that is tried to make the matrix positive definite, relative to the largest diagonal entry, and
the factor by which it grows."""

SOLVES, SAME = 100, 1e-3
"""Maximum number of inverse iterations, and the relative change of the eigenvalue at which they end."""


@dataclass(frozen=True)
class Pivots:
    """Numbers of pivots that are negative, and that are too small to have a sign."""

    negative: int
    neutral: int


class Inertia:
    """Factors a symmetric matrix of block rows; collective.

    Parameters
    ----------
    layout : Layout
    pattern : BlockPattern
    values : (n_stored, 3, 3)
        Block rows of the matrix, prescribed unknowns decoupled with a positive diagonal.
    """

    def __init__(self, layout: Layout, pattern: BlockPattern, values: Array) -> None:
        self._layout, self._values, pattern = layout, pattern.in_blocks(values), pattern.whole
        values = self._values
        self._diagonal = pattern.indptr[:-1]
        entries = np.abs(values[self._diagonal][:, range(3), range(3)])
        self._largest = float(layout.comm.allreduce(float(entries.max(initial=0.0)), MPI.MAX))
        self._matrix = AssembledMatrix(layout, pattern, "aij", prefix=PREFIX)
        self._ksp: PETSc.KSP | None = None
        self._margin = 50

    def pivots(self, shift: float = 0.0) -> Pivots | None:
        """Pivots of the matrix plus shift times the identity; None if its factors do not fit into memory.

        Unknowns that no energy depends on have neutral pivots.
        """
        values = self._values.copy()
        values[self._diagonal] += shift * np.eye(3)
        self._matrix.set(values)
        while True:
            factors = self._factor()
            error = factors.getMumpsInfog(1)
            if error >= 0:
                return Pivots(int(factors.getMumpsInfog(12)), int(factors.getMumpsInfog(28)))
            if error not in WORKSPACE_ERRORS or self._margin >= LARGEST:
                return None
            self._margin *= 4

    def _factor(self) -> PETSc.Mat:
        self._free_solver()
        self._ksp = ksp = self._matrix.cholesky()
        factors = ksp.getPC().getFactorMatrix()
        # no scaling; count all pivots, also those of the last dense block, and null pivots separately
        for number, value in {6: 0, 8: 0, 13: 1, 14: self._margin, 24: 1}.items():
            factors.setMumpsIcntl(number, value)
        factors.setMumpsCntl(1, 0.01)
        factors.setMumpsCntl(3, -NEUTRAL * self._largest)
        ksp.setUp()
        return factors

    def solve(self, right: Array) -> Array:
        """Solution (n_owned, 3) for a right-hand side, by the factors of the last ``pivots``; collective."""
        assert self._ksp is not None
        return self._matrix.solve(self._ksp, right)

    def lowest_mode(self, start: Array) -> tuple[float, Array] | None:
        """Lowest eigenvalue [N/m] and its unit eigenvector (n_owned, 3), by inverse iteration.

        ``start`` (n_owned, 3) is the initial vector, 0 in prescribed unknowns. None if a factorisation fails.
        """
        shift = FIRST_SHIFT * self._largest
        while (pivots := self.pivots(shift)) is not None and pivots.negative:
            shift *= MORE
        if pivots is None:
            return None
        mode, lowest = start / np.sqrt(self._dot(start, start)), np.inf
        for _ in range(SOLVES):
            found = self.solve(mode)
            before, lowest = lowest, 1.0 / self._dot(found, mode) - shift
            mode = found / np.sqrt(self._dot(found, found))
            if lowest < 0.0 and abs(lowest - before) <= SAME * abs(lowest):
                break
        return lowest, mode

    def _dot(self, one: Array, other: Array) -> float:
        return float(self._layout.global_sum(float(np.vdot(one, other)))[0])

    def _free_solver(self) -> None:
        if self._ksp is not None:
            self._ksp.destroy()
            self._ksp = None

    def destroy(self) -> None:
        """Free the factors and the matrix; collective."""
        self._free_solver()
        self._matrix.destroy()
