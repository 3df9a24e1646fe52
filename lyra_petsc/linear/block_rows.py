"""Values of the block rows a rank owns: sums of element blocks, products, constraints.

Of a symmetric matrix, in the half storage of ``pattern``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.kernels.cache import cached
from lyra_petsc.linear.block_product import HalfStored
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.terms.term import Elastic

Array = NDArray[np.float64]


@cached()
def _scale(indptr, source, factor, diagonal, values):  # type: ignore[no-untyped-def]
    """values = factor · source, plus the diagonal (n_owned,) times the identity."""
    for row in range(len(indptr) - 1):
        first = indptr[row]
        for k in range(first, indptr[row + 1]):
            for i in range(3):
                for j in range(3):
                    values[k, i, j] = factor * source[k, i, j]
        for i in range(3):
            values[first, i, i] += diagonal[row]


@cached()
def _set_diagonal(indptr, diagonal, values):  # type: ignore[no-untyped-def]
    """Set the diagonal (n_owned,) times the identity in values that are 0."""
    for row in range(len(indptr) - 1):
        for i in range(3):
            values[indptr[row], i, i] = diagonal[row]


@cached()
def _add_at(source, place, values):  # type: ignore[no-untyped-def]
    for k in range(len(place)):
        at = place[k]
        for i in range(3):
            for j in range(3):
                values[at, i, j] += source[k, i, j]


@cached()
def _constrain(indptr, columns, touched, mask, values):  # type: ignore[no-untyped-def]
    """Zero the rows and columns of prescribed coordinates; their diagonal gets its block's largest size."""
    for t in range(len(touched)):
        row = touched[t]
        for k in range(indptr[row], indptr[row + 1]):
            c = columns[k]
            # an exact Hessian may be negative here, which would make the whole matrix indefinite
            size = max(abs(values[k, 0, 0]), abs(values[k, 1, 1]), abs(values[k, 2, 2]))
            for i in range(3):
                for j in range(3):
                    if mask[c, i] or mask[row, j]:
                        values[k, i, j] = size if row == c and i == j else 0.0


class BlockRows:
    """Adds element Hessians into block rows, and works on these rows.

    Attributes
    ----------
    values : (n_blocks, 3, 3) float64
        In the order of ``pattern``, column by column. All methods that take ``values`` work on such an array.
    """

    def __init__(self, pattern: BlockPattern) -> None:
        self.pattern = pattern

    def zeros(self) -> Array:
        """A new array of values (n_blocks, 3, 3), all zero."""
        return np.zeros((self.pattern.n_blocks, 3, 3))

    def add_stiffness(
        self,
        term: Elastic,
        x: Array,
        frozen: Any,
        blend: float,
        weight: Array | float,
        values: Array,
        predicted: tuple[Array, Array] | None = None,
    ) -> None:
        """Add weight × Hessians of an elastic term at positions x (n_local, 3)."""
        weights = np.full(term.n_elements, weight) if isinstance(weight, float) else weight
        weights = np.ascontiguousarray(weights)  # as kernels are compiled for
        term.add_hessian(x, frozen, blend, weights, self.pattern.offsets, values, predicted)

    def set_diagonal(self, diagonal: Array, values: Array) -> None:
        """Let ``values`` be ``diagonal`` (n_owned,) times the identity."""
        values.fill(0.0)
        _set_diagonal(self.pattern.indptr, diagonal, values)

    def scale(self, source: Array, factor: float, diagonal: Array, values: Array) -> None:
        """Let ``values`` be factor × source + ``diagonal`` (n_owned,) times the identity."""
        _scale(self.pattern.indptr, source, factor, diagonal, values)

    def add_at(self, source: Array, place: NDArray[np.int64], values: Array) -> None:
        """Add blocks (n, 3, 3) to those of ``values`` at ``place`` (n,), none of them twice."""
        _add_at(source, place, values)

    def product(self, values: Array, x: Array) -> Array:
        """Rows (n_owned, 3) of the product with x (n_local, 3), ghosts up to date."""
        out = np.empty((self.pattern.n_owned, 3))
        HalfStored(self.pattern, values)(x, out)
        return out

    def beside(self, mask: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Blocks whose row or column has a prescribed coordinate, and before them their rows.

        Numbers, ascending; mask (n_local, 3).
        """
        held = mask.any(axis=1)
        rows = np.repeat(np.arange(self.pattern.n_owned), np.diff(self.pattern.indptr))
        blocks = np.flatnonzero(held[self.pattern.columns] | held[rows])
        return np.unique(rows[blocks]), blocks

    def constrain(self, values: Array, mask: NDArray[np.bool_], rows: NDArray[np.int64]) -> None:
        """Decouple prescribed coordinates, with a positive diagonal of the size of their neighbours.

        That size is what multigrid and incomplete factors need.
        """
        _constrain(self.pattern.indptr, self.pattern.columns, rows, mask, values)
