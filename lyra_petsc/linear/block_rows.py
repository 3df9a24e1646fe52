"""Values of the block rows that a rank owns: assembly of element blocks, products, constraints.

The matrix is symmetric; one half of it is stored, as described in ``pattern``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.linear.block_product import make_product
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.terms.term import Assembly, Elastic


@cached()
def _add_diagonal(indptr, diagonal, values):  # type: ignore[no-untyped-def]
    """Add diagonal (n,) times the identity to the diagonal (first) blocks of the rows."""
    for row in range(len(indptr) - 1):
        for i in range(3):
            values[indptr[row], i, i] += diagonal[row]


@cached()
def _add_edge_diagonal(indptr, first, diagonal, flat):  # type: ignore[no-untyped-def]
    """Add to each edge's diagonal entry the value of its row; ``first`` is the index of the first entry."""
    for edge in range(len(indptr) - 1):
        flat[first + indptr[edge]] += diagonal[edge // 3]


@cached()
def _add_blocks(source, positions, values):  # type: ignore[no-untyped-def]
    for k in range(len(positions)):
        for i in range(3):
            for j in range(3):
                values[positions[k], i, j] += source[k, i, j]


@cached()
def _constrain(indptr, columns, touched, mask, values):  # type: ignore[no-untyped-def]
    """Zero rows and columns of prescribed coordinates; their diagonal gets the largest of its block's."""
    for t in range(len(touched)):
        row = touched[t]
        for k in range(indptr[row], indptr[row + 1]):
            c = columns[k]
            # absolute values: the exact Hessian may be negative here, and the matrix would be indefinite
            size = max(abs(values[k, 0, 0]), abs(values[k, 1, 1]), abs(values[k, 2, 2]))
            for i in range(3):
                for j in range(3):
                    if mask[c, i] or mask[row, j]:
                        values[k, i, j] = size if row == c and i == j else 0.0


@cached(fastmath={"reassoc", "contract", "nsz"})
def squared_norm_without(vector, excluded):  # type: ignore[no-untyped-def]
    """Sum of the squares of ``vector`` (n,) but for the entries ``excluded`` (m,), in ascending order."""
    total, begin = 0.0, 0
    for nth in range(len(excluded) + 1):
        end = excluded[nth] if nth < len(excluded) else len(vector)
        for i in range(Index(begin), Index(end)):
            total += vector[i] * vector[i]
        begin = end + 1
    return total


class ConstrainedEntries(NamedTuple):
    """Entries that constraints change, as indices into the flattened values.

    Attributes
    ----------
    rows : (n,)
        Block rows with prescribed coordinates in the row or in a column, ascending.
    zeros : (m,)
        Couplings of edges that become zero.
    edges, row_edges : (k,), (k, 3)
        Diagonal entries of the prescribed edges, and of the three edges in the row of each.
    changed : (l,)
        All entries that change, including those of blocks.
    """

    rows: Ints
    zeros: Ints
    edges: Ints
    row_edges: Ints
    changed: Ints


class BlockRows:
    """Assembles element Hessians into block rows, and operates on such rows.

    Attributes
    ----------
    pattern : BlockPattern
        All methods take ``values`` (n_stored, 3, 3) in its order, each block column by column.
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
        convexity: float,
        weight: Array | float,
        values: Array,
        predicted: tuple[Array, Array] | None = None,
    ) -> None:
        """Add weight × Hessians of an elastic term at positions x (n_local, 3)."""
        if not term.n_elements:
            return
        weights = np.full(term.n_elements, weight) if isinstance(weight, float) else weight
        if not weights.flags.carray:  # kernels are compiled for contiguous arrays
            weights = weights.copy()
        term.add_hessian(x, frozen, Assembly(weights, self.pattern.offsets, values, convexity, predicted))

    def set_diagonal(self, diagonal: Array, values: Array) -> None:
        """Set ``values`` to ``diagonal`` (n_owned,) times the identity."""
        values.fill(0.0)
        self.add_diagonal(diagonal, values)

    def add_diagonal(self, diagonal: Array, values: Array) -> None:
        """Add ``diagonal`` (n_owned,) times the identity."""
        pattern = self.pattern
        _add_diagonal(pattern.indptr[: pattern.n_diagonal + 1], diagonal, values)
        if pattern.edge_couplings is not None:
            first = pattern.edge_couplings.first_entry(pattern.n_blocks)
            indptr, own = pattern.edge_couplings.entries.indptr, diagonal[pattern.n_diagonal :]
            _add_edge_diagonal(indptr, first, own, values.reshape(-1))

    def scale_diagonal(self, values: Array, factor: float) -> None:
        """Multiply the diagonal blocks, and the diagonal entries of edges, by a factor."""
        pattern = self.pattern
        values[pattern.indptr[: pattern.n_diagonal]] *= factor
        if pattern.edge_couplings is not None:
            values.reshape(-1)[pattern.edge_couplings.diagonal(pattern.n_blocks)] *= factor

    def scale(self, source: Array, factor: float, diagonal: Array, values: Array) -> None:
        """Set ``values`` to factor × source + ``diagonal`` (n_owned,) times the identity."""
        np.multiply(source, factor, out=values)
        self.add_diagonal(diagonal, values)

    def add_blocks(self, source: Array, positions: NDArray[np.int64], values: Array) -> None:
        """Add the blocks of ``source`` at distinct ``positions`` (n,), and its couplings of edges.

        ``source`` holds n blocks (n, 3, 3), then the couplings of edges.
        """
        _add_blocks(source, positions, values)
        edges = self.pattern.edge_couplings
        if edges is not None:
            to, first = (edges.first_group(n) for n in (self.pattern.n_blocks, len(positions)))
            values.reshape(-1)[to : to + edges.n_values] += source.reshape(-1)[first : first + edges.n_values]

    def product(self, values: Array, x: Array) -> Array:
        """The product (n_owned, 3) with x (n_local, 3), which has current ghost values."""
        out = np.empty((self.pattern.n_owned, 3))
        make_product(self.pattern, values)(x, out)
        return out

    def constrained_entries(self, mask: NDArray[np.bool_]) -> ConstrainedEntries:
        """Entries in rows and columns of prescribed coordinates, mask (n_local, 3)."""
        pattern, held = self.pattern, mask.any(axis=1)
        none = np.empty(0, dtype=np.int64)
        if not held.any():
            return ConstrainedEntries(none, none, none, none.reshape(0, 3), none)
        rows = np.repeat(np.arange(pattern.n_owned), np.diff(pattern.indptr))
        blocks = np.flatnonzero(held[pattern.columns] | held[rows])
        changed = (9 * blocks[:, None] + np.arange(9)).ravel()
        zeros, edges, row_edges = none, none, none.reshape(0, 3)
        if pattern.edge_couplings is not None:
            zeros, edges, row_edges = pattern.edge_couplings.constrained_entries(mask, pattern.n_blocks)
            changed = np.concatenate([changed, zeros, edges])
        return ConstrainedEntries(np.unique(rows[blocks]), zeros, edges, row_edges, changed)

    def constrain(self, values: Array, mask: NDArray[np.bool_], entries: ConstrainedEntries) -> None:
        """Decouple prescribed coordinates, with a positive diagonal of the magnitude of their neighbours.

        Multigrid and incomplete factors need a diagonal of that magnitude.
        """
        _constrain(self.pattern.indptr, self.pattern.columns, entries.rows, mask, values)
        flat = values.reshape(-1)
        sizes = np.abs(flat[entries.row_edges]).max(axis=1, initial=0.0)
        flat[entries.zeros] = 0.0
        flat[entries.edges] = sizes
