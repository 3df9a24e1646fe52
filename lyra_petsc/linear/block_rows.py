"""Values of the block rows a rank owns: sums of element blocks, products, constraints.

Of a symmetric matrix, in the half storage of ``pattern``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.linear.block_product import make_product
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.terms.term import Elastic


@cached()
def _add_diagonal(indptr, diagonal, values):  # type: ignore[no-untyped-def]
    """Add the diagonal times the identity to the first blocks of rows."""
    for row in range(len(indptr) - 1):
        for i in range(3):
            values[indptr[row], i, i] += diagonal[row]


@cached()
def _add_to_edges(indptr, first, diagonal, flat):  # type: ignore[no-untyped-def]
    """Add the diagonal of their rows to the edges' own numbers, of which ``first`` is the first."""
    for edge in range(len(indptr) - 1):
        flat[first + indptr[edge]] += diagonal[edge // 3]


@cached()
def _add_blocks(source, place, values):  # type: ignore[no-untyped-def]
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


@cached(fastmath={"reassoc", "contract", "nsz"})
def squared_norm_without(vector, left_out):  # type: ignore[no-untyped-def]
    """Sum of the squares of ``vector`` (n,) without those of its entries ``left_out`` (m,), which ascend."""
    total, begin = 0.0, 0
    for nth in range(len(left_out) + 1):
        end = left_out[nth] if nth < len(left_out) else len(vector)
        for i in range(Index(begin), Index(end)):
            total += vector[i] * vector[i]
        begin = end + 1
    return total


class Beside(NamedTuple):
    """What couples to prescribed unknowns, and these themselves, in the flat form of values.

    Attributes
    ----------
    rows : (n,)
        Of blocks, ascending.
    zeros : (m,)
        Couplings of edges.
    edges, sizes : (k,), (k, 3)
        Prescribed edges' own, and those of the three edges in their rows.
    changing : (l,)
        All, those of blocks too.
    """

    rows: Ints
    zeros: Ints
    edges: Ints
    sizes: Ints
    changing: Ints


class BlockRows:
    """Adds element Hessians into block rows, and works on these rows.

    Attributes
    ----------
    values : (n_stored, 3, 3) float64
        In the order of ``pattern``, column by column. All methods that take ``values`` work on such an array.
    """

    def __init__(self, pattern: BlockPattern) -> None:
        self.pattern = pattern

    def zeros(self) -> Array:
        """A new array of values (n_stored, 3, 3), all zero."""
        return np.zeros((self.pattern.n_stored, 3, 3))

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
        if not term.n_elements:
            return
        weights = np.full(term.n_elements, weight) if isinstance(weight, float) else weight
        if not weights.flags.carray:  # as kernels are compiled for
            weights = weights.copy()
        term.add_hessian(x, frozen, blend, weights, self.pattern.offsets, values, predicted)

    def set_diagonal(self, diagonal: Array, values: Array) -> None:
        """Let ``values`` be ``diagonal`` (n_owned,) times the identity."""
        values.fill(0.0)
        self.add_diagonal(diagonal, values)

    def add_diagonal(self, diagonal: Array, values: Array) -> None:
        """Add ``diagonal`` (n_owned,) times the identity."""
        pattern = self.pattern
        _add_diagonal(pattern.indptr[: pattern.n_diagonal + 1], diagonal, values)
        if pattern.edge_couplings is not None:
            first = pattern.edge_couplings.first_number(pattern.n_blocks)
            indptr, own = pattern.edge_couplings.numbers.indptr, diagonal[pattern.n_diagonal :]
            _add_to_edges(indptr, first, own, values.reshape(-1))

    def scale_diagonal(self, values: Array, factor: float) -> None:
        """Multiply the diagonal blocks, and of edges their own entries, by a factor."""
        pattern = self.pattern
        values[pattern.indptr[: pattern.n_diagonal]] *= factor
        if pattern.edge_couplings is not None:
            values.reshape(-1)[pattern.edge_couplings.diagonal(pattern.n_blocks)] *= factor

    def scale(self, source: Array, factor: float, diagonal: Array, values: Array) -> None:
        """Let ``values`` be factor × source + ``diagonal`` (n_owned,) times the identity."""
        np.multiply(source, factor, out=values)
        self.add_diagonal(diagonal, values)

    def add_blocks(self, source: Array, place: NDArray[np.int64], values: Array) -> None:
        """Add blocks (n, 3, 3) to those of ``values`` at ``place`` (n,), none of them twice, and couplings of
        edges to these.
        """
        _add_blocks(source, place, values)
        edges = self.pattern.edge_couplings
        if edges is not None:
            begin, end = (edges.first_group(n) for n in (self.pattern.n_blocks, len(place)))
            values.reshape(-1)[begin : begin + edges.n_values] += source.reshape(-1)[
                end : end + edges.n_values
            ]

    def product(self, values: Array, x: Array) -> Array:
        """Rows (n_owned, 3) of the product with x (n_local, 3), ghosts up to date."""
        out = np.empty((self.pattern.n_owned, 3))
        make_product(self.pattern, values)(x, out)
        return out

    def beside(self, mask: NDArray[np.bool_]) -> Beside:
        """What has a prescribed coordinate in its row or column; mask (n_local, 3)."""
        pattern, held = self.pattern, mask.any(axis=1)
        zeros = edges = np.empty(0, dtype=np.int64)
        sizes = np.empty((0, 3), dtype=np.int64)
        if not held.any():
            return Beside(zeros, zeros, edges, sizes, zeros)
        rows = np.repeat(np.arange(pattern.n_owned), np.diff(pattern.indptr))
        blocks = np.flatnonzero(held[pattern.columns] | held[rows])
        changing = (9 * blocks[:, None] + np.arange(9)).ravel()
        if pattern.edge_couplings is not None:
            zeros, edges, sizes = pattern.edge_couplings.beside(mask, pattern.n_blocks)
            changing = np.concatenate([changing, zeros, edges])
        return Beside(np.unique(rows[blocks]), zeros, edges, sizes, changing)

    def constrain(self, values: Array, mask: NDArray[np.bool_], beside: Beside) -> None:
        """Decouple prescribed coordinates, with a positive diagonal of the size of their neighbours.

        That size is what multigrid and incomplete factors need.
        """
        _constrain(self.pattern.indptr, self.pattern.columns, beside.rows, mask, values)
        flat = values.reshape(-1)
        sizes = np.abs(flat[beside.sizes]).max(axis=1, initial=0.0)
        flat[beside.zeros] = 0.0
        flat[beside.edges] = sizes
