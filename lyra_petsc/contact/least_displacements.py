"""The smoothest displacements of sheets that lift parts to given heights."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.contact.layer_pairs import Surfaces
from lyra_petsc.contact.part_heights import Heights
from lyra_petsc.mesh.seams import Ties
from lyra_petsc.mesh.topology import connected_components

SMOOTH = 6.0
"""Length L, in edges, over which displacements spread."""

PENALTY = 200.0
"""Stiffness of a constraint over that of an edge."""

RESIDUAL, MAX_ITERATIONS = 1e-5, 1000
"""Relative residual of the linear solves, and largest number of their iterations."""


class LeastDisplacements:
    """Displacements that minimise an energy of edges, ½ Σ |y_i − y_j|² + ½ Σ |y_i|² / L², with springs.

    Parameters
    ----------
    surfaces : Surfaces
    ties : list of Ties
        Of seams that are closed: their sides move together.
    free : (V, 3) bool
        Coordinates that may change.
    """

    def __init__(self, surfaces: Surfaces, ties: list[Ties], free: Mask) -> None:
        self._free, self._edges = free, surfaces.edges
        nothing = Ties(np.empty((0, 3), dtype=np.int64), np.empty(0), np.empty(0))
        self._tied, weight, _ = (np.concatenate(arrays) for arrays in zip(nothing, *ties, strict=True))
        links = surfaces.piece[np.concatenate([self._tied[:, :2], self._tied[:, 1:]])]
        self._piece = connected_components(int(surfaces.piece.max()) + 1, links)[surfaces.piece]
        self._ties = np.sqrt(PENALTY) * np.column_stack([np.ones_like(weight), weight - 1.0, -weight])

    def lifted(self, heights: Heights, least: Array, guess: Array) -> Array:
        """Displacements (V, 3) [m] with springs that lift parts by ``least`` (n,) [m], from a ``guess``.

        Pieces without any of the parts stay, unless they are sewn to such ones.
        """
        moved = np.zeros(len(self._piece), dtype=bool)
        moved[np.isin(self._piece, np.unique(self._piece[heights.points]))] = True
        free = self._free & moved[:, None]
        number = np.full(free.shape, -1)
        number[free] = np.arange(n := int(free.sum()))
        y = np.zeros(free.shape)
        if n:
            # the energy is half of the sum of the squares of B y − c
            m = len(least)
            sides = number[self._edges[free[self._edges].any(axis=(1, 2))]].transpose(0, 2, 1).reshape(-1, 2)
            tied = number[self._tied].transpose(0, 2, 1).reshape(-1, 3)
            springs = np.sqrt(PENALTY) * heights.weights[:, :, None] * heights.directions[:, None, :]
            blocks = [
                (sides, np.broadcast_to([1.0, -1.0], sides.shape)),
                (tied, np.repeat(self._ties, 3, axis=0)),
                (np.arange(n)[:, None], np.full((n, 1), 1.0 / SMOOTH)),
                (number[heights.points].reshape(m, 12), springs.reshape(m, 12)),
            ]
            right = np.concatenate([np.zeros(len(sides) + len(tied) + n), np.sqrt(PENALTY) * least])
            y[free] = _least_squares(blocks, right, guess[free])
        return y


def _least_squares(blocks: list[tuple[Ints, Array]], right: Array, guess: Array) -> Array:
    """Solution (n,) of the normal equations of a sparse matrix, from a ``guess``.

    Each of the ``blocks`` has the columns and values (k, p) of k rows; entries with a column −1 and zeros are
    left out.
    """
    known = [(columns >= 0) & (values != 0.0) for columns, values in blocks]
    begins = np.append(0, np.cumsum(np.concatenate([mask.sum(axis=1) for mask in known])))
    columns, values = (
        np.concatenate([block[k][mask] for block, mask in zip(blocks, known, strict=True)]) for k in (0, 1)
    )
    indices = [array.astype(PETSc.IntType) for array in (begins, columns)]
    rows = PETSc.Mat().createAIJ((len(right), len(guess)), csr=(*indices, values), comm=PETSc.COMM_SELF)
    matrix = rows.transposeMatMult(rows)
    solver = PETSc.KSP().create(PETSc.COMM_SELF)
    solver.setOptionsPrefix("untangle_")
    solver.setType("cg")
    solver.getPC().setType("sor")
    solver.setTolerances(rtol=RESIDUAL, max_it=MAX_ITERATIONS)
    solver.setInitialGuessNonzero(True)
    solver.setOperators(matrix)
    c, (b, y) = rows.createVecLeft(), matrix.createVecs()
    c.setArray(right)
    y.setArray(guess)
    rows.multTranspose(c, b)
    solver.solve(b, y)
    solution = y.getArray().copy()
    for one in (solver, matrix, rows, b, c, y):
        one.destroy()
    return solution
