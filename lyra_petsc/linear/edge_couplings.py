"""Matrix entries of edges' unknowns, stored as scalars behind the 3 × 3 blocks of a pattern.

In 3 × 3 blocks, with three edges in a row, 40 % of the entries that couple vertices with edges would always
be zero, and 70 % of those that couple edges with edges. So one half of the symmetric owned rows is stored as

- 3 × 3 blocks of vertices, in the pattern,
- *groups*: 3 × 4 blocks of a vertex and four of its edges, padded with zeros in a vertex' last group,
- *edge entries*: scalar entries of pairs of edges.

Couplings to ghosts are few, and stay 3 × 3 blocks of the pattern. One array of values holds blocks,
groups and edge entries in this order. The column of an edge's unknown is its index in a flattened array of
local rows.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, read_only
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.kernels.llvm import WIDTH
from lyra_petsc.kernels.vectors import AHEAD, gather, gather_edges, scatter, scatter_edges
from lyra_petsc.linear.pattern import MISSING, BlockPattern, block_of, index_type, row_pointers, union

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lyra_petsc.terms.term import MixedStencil, Offsets


AHEAD_EDGES = AHEAD // 2
"""Prefetch distance, in groups."""


class Groups(NamedTuple):
    """3 × 4 blocks of owned vertices with four owned edges, in compressed rows.

    Attributes
    ----------
    indptr : (n_vertices + 1,)
    columns : (n_groups, 4) int32
        Columns of the four edges.
    """

    indptr: Ints
    columns: NDArray[np.int32]


class EdgeEntries(NamedTuple):
    """Scalar couplings of owned edges, in compressed rows; the first entry of a row is the diagonal one.

    Attributes
    ----------
    indptr : (n_edges + 1,) int32, or int64 if needed
    columns : (n_edge_entries,) int32
    """

    indptr: NDArray[Any]
    columns: NDArray[np.int32]


class EdgeValues(NamedTuple):
    """Views of the values of a pattern with edge couplings.

    Attributes
    ----------
    blocks : (n_blocks, 9)
        Each block column by column.
    groups : (n_groups, 12)
        Each block row by row.
    entries : (n_edge_entries, 1)
    """

    blocks: NDArray[Any]
    groups: NDArray[Any]
    entries: NDArray[Any]


class EdgeCouplings:
    """Sparsity of the couplings of owned edges.

    Parameters
    ----------
    elements : sequence of MixedStencil
    n_owned : int
        Block rows that this rank owns.

    Attributes
    ----------
    n_vertices : int
        Owned rows of vertices; those of edges follow.
    groups : Groups
    entries : EdgeEntries
    """

    def __init__(self, elements: Sequence[MixedStencil], n_owned: int) -> None:
        self._n, beyond = n_owned, 3 * n_owned
        first_columns = (int(part.edges.min(initial=beyond)) for part in elements)
        self.n_vertices = first = min(beyond, *first_columns) // 3

        def keys(part: MixedStencil) -> tuple[list[Ints], list[Ints]]:
            """Keys of vertex-edge and edge-edge couplings: row · ``beyond`` + column."""
            mixed, edges = [], []
            columns = part.edges.astype(np.int64)
            for b, column in enumerate(columns.T):
                for vertex in part.vertices.T:
                    owned = (column < beyond) & (vertex < n_owned)
                    mixed.append(vertex[owned].astype(np.int64) * beyond + column[owned])
                for other in columns.T[:b]:
                    owned = (column < beyond) & (other < beyond)
                    lesser, greater = np.minimum(column, other)[owned], np.maximum(column, other)[owned]
                    edges.append(lesser * beyond + greater)
            return mixed, edges

        mixed, of_edges = (list(itertools.chain(*parts)) for parts in zip(*map(keys, elements), strict=True))
        vertex, column = np.divmod(union(*mixed), max(beyond, 1))
        count = np.bincount(vertex, minlength=first)
        groups = row_pointers(-(-count // WIDTH))
        at = WIDTH * groups[vertex] + np.arange(len(vertex)) - row_pointers(count)[vertex]
        columns = np.full(WIDTH * groups[-1], -1, dtype=np.int32)
        columns[at] = column
        # padding refers to an edge of the group, whose cache line is needed anyway
        columns = columns.reshape(-1, WIDTH)
        self.groups = Groups(groups, np.where(columns < 0, columns[:, :1], columns))

        diagonal = np.arange(3 * first, beyond, dtype=np.int64) * (beyond + 1)
        one, other = np.divmod(union(diagonal, *of_edges), max(beyond, 1))
        indptr = row_pointers(np.bincount(one - 3 * first, minlength=len(diagonal)))
        self.entries = EdgeEntries(indptr.astype(index_type(len(other))), other.astype(np.int32))

    # -- positions of values, as indices into the flattened array ------------------------------------

    @property
    def n_values(self) -> int:
        """Stored values of groups and edge entries."""
        return int(3 * self.groups.columns.size + len(self.entries.columns))

    @property
    def n_entries(self) -> int:
        """Entries of groups and pairs of edges in both halves of the matrix, including padding."""
        return 2 * self.n_values - len(self.entries.indptr) + 1

    def first_group(self, n_blocks: int) -> int:
        """Position of the first group, behind n_blocks blocks, at a multiple of four numbers."""
        return 9 * WIDTH * -(-n_blocks // WIDTH)

    def first_entry(self, n_blocks: int) -> int:
        """Position of the first number."""
        return self.first_group(n_blocks) + 3 * self.groups.columns.size

    def n_stored(self, n_blocks: int) -> int:
        """Number of 3 × 3 blocks that take as much memory as all values."""
        return -(-(self.first_group(n_blocks) + self.n_values) // 9)

    def diagonal(self, n_blocks: int) -> Ints:
        """Positions of the edges' diagonal entries, including padding."""
        own: Ints = self.entries.indptr[:-1].astype(np.int64)
        return own + self.first_entry(n_blocks)

    def parts(self, values: NDArray[Any], n_blocks: int) -> EdgeValues:
        """Views of values (n_stored, 3, 3)."""
        flat, first, last = values.reshape(-1), self.first_group(n_blocks), self.first_entry(n_blocks)
        blocks, groups = flat[: 9 * n_blocks].reshape(-1, 9), flat[first:last].reshape(-1, 3 * WIDTH)
        return EdgeValues(blocks, groups, flat[last : last + len(self.entries.columns)].reshape(-1, 1))

    def offsets_of(self, elements: MixedStencil, pattern: BlockPattern) -> Offsets:
        """Positions of the couplings (a, b), b ≥ a, of elements for edges b; edges come after vertices.

        For a vertex and an edge 4 · position of the first of three values + their stride − 1; for two edges
        the position of their value; −1 if other ranks own both.
        """
        stencil, m = elements.stencil, elements.edges.shape[1]
        n = stencil.shape[1] - m
        first = self.first_group(pattern.n_blocks)
        kind = index_type(4 * (first + self.n_values))
        out: Offsets = np.empty((len(stencil), n * m + m * (m + 1) // 2), dtype=kind)
        rows = pattern.indptr, pattern.columns, *self.groups, *self.entries
        _look_up(*rows, first, self.first_entry(pattern.n_blocks), stencil, elements.edges, out)
        return out

    # -- prescribed unknowns -------------------------------------------------------------------------

    def constrained_entries(self, mask: NDArray[np.bool_], n_blocks: int) -> tuple[Ints, Ints, Ints]:
        """Positions ``zeros``, ``edges`` and ``row_edges`` of `ConstrainedEntries`; mask (n_local, 3)."""
        held = mask.ravel()
        vertex = np.repeat(np.arange(self.n_vertices), np.diff(self.groups.indptr))
        coupled = mask[vertex][:, :, None] | held[self.groups.columns][:, None, :]
        of_groups = self.first_group(n_blocks) + np.flatnonzero(coupled)
        indptr, columns = self.entries
        edge = np.repeat(np.arange(3 * self.n_vertices, 3 * self._n), np.diff(indptr))
        own = self.diagonal(n_blocks)
        of_entries = held[edge] | held[columns]
        of_entries[indptr[:-1]] = False
        zeros = np.concatenate([of_groups, self.first_entry(n_blocks) + np.flatnonzero(of_entries)])
        edges: Ints = np.flatnonzero(held[3 * self.n_vertices : 3 * self._n])
        return zeros, own[edges], own.reshape(-1, 3)[edges // 3]

    # -- in blocks -----------------------------------------------------------------------------------

    def _coupled(self) -> tuple[Ints, Ints, Ints, Ints]:
        """Rows and columns of all groups' entries, then of all edge entries, as indices of unknowns."""
        vertex = np.repeat(np.arange(self.n_vertices), np.diff(self.groups.indptr))
        shape = (len(vertex), 3, WIDTH)
        row = np.broadcast_to((3 * vertex[:, None] + np.arange(3))[:, :, None], shape).ravel()
        column = np.broadcast_to(self.groups.columns[:, None, :], shape).ravel()
        edge = np.repeat(np.arange(3 * self.n_vertices, 3 * self._n), np.diff(self.entries.indptr))
        return row, column.astype(np.int64), edge, self.entries.columns.astype(np.int64)

    def whole(self, pattern: BlockPattern) -> BlockPattern:
        """The equivalent pattern of 3 × 3 blocks only, in which rows of owned edges hold three edges."""
        row, column, edge, other = (index // 3 for index in self._coupled())
        keys = union(
            pattern.keys(pattern.n_local), row * pattern.n_local + column, edge * pattern.n_local + other
        )
        return BlockPattern.of_keys(keys, pattern.n_owned, pattern.n_local)

    def in_blocks(self, pattern: BlockPattern, values: Array) -> Array:
        """Values (n_blocks, 3, 3) of the pattern ``whole`` from values (n_stored, 3, 3)."""
        blocks, groups, entries = self.parts(values, pattern.n_blocks)
        n_local = pattern.n_local
        keys = pattern.whole.keys(n_local)
        out = np.zeros((len(keys), 9))
        out[np.searchsorted(keys, pattern.keys(n_local))] = blocks
        flat = out.reshape(-1)

        def position(row: Ints, column: Ints) -> Ints:
            """Blocks are stored column by column."""
            block = np.searchsorted(keys, (row // 3) * n_local + column // 3)
            entry: Ints = 9 * block + 3 * (column % 3) + row % 3
            return entry

        row, column, edge, other = self._coupled()
        # added, as the padding of a group repeats an edge with value 0
        np.add.at(flat, position(row, column), groups.ravel())
        flat[position(edge, other)] = entries[:, 0]
        same_row = edge // 3 == other // 3
        flat[position(other[same_row], edge[same_row])] = entries[same_row, 0]
        return out.reshape(-1, 3, 3)


@cached()
def _look_up(  # type: ignore[no-untyped-def]
    indptr, columns, group_ptr, columns4, entry_ptr, columns1, first_group, first_entry, stencil, edges, out
):
    """Positions (`offsets_of`) of elements whose stencil (E, n + m) ends with the rows of edges (E, m).

    ``columns4`` and ``columns1`` are the columns of groups and of edge entries.
    """
    n_owned, n_vertices = len(indptr) - 1, len(group_ptr) - 1
    n = stencil.shape[1] - edges.shape[1]
    for e in range(len(stencil)):
        pair = 0
        for a in range(stencil.shape[1]):
            for b in range(max(a, n), stencil.shape[1]):
                position = -1
                one, other = stencil[e, a], stencil[e, b]
                row, column = min(one, other), max(one, other)
                if row < n_owned:
                    if column >= n_owned:
                        block = block_of(indptr, columns, row, column)
                        c_b = edges[e, b - n] % 3
                        if block < 0:
                            position = block
                        elif a < n:
                            position = 4 * (9 * block + 3 * c_b) if one == row else 4 * (9 * block + c_b) + 2
                        else:
                            c_a = edges[e, a - n] % 3
                            i, j = (c_a, c_b) if one == row else (c_b, c_a)
                            position = 9 * block + 3 * j + i
                    elif a < n:
                        position = MISSING
                        for k in range(4 * group_ptr[one], 4 * group_ptr[one + 1]):
                            if columns4[k // 4, k % 4] == edges[e, b - n]:
                                position = 4 * (first_group + 12 * (k // 4) + k % 4) + 3
                                break
                    else:
                        lesser, greater = edges[e, a - n], edges[e, b - n]
                        if lesser > greater:
                            lesser, greater = greater, lesser
                        position = MISSING
                        edge = lesser - 3 * n_vertices
                        for k in range(entry_ptr[edge], entry_ptr[edge + 1]):
                            if columns1[k] == greater:
                                position = first_entry + k
                                break
                out[e, pair] = position
                pair += 1


@cached(fastmath={"contract", "nsz"})
def multiply(  # type: ignore[no-untyped-def]
    ptr, ends, columns, group_ptr, columns4, entry_ptr, columns1, blocks, groups, entries, x, u, sums, out, v
):
    """out (n_owned, 3) = A x for x (n_local, 3); u and v are both flattened, sums (n_vertices, 4) scratch."""
    n, n_owned = Index(len(sums)), Index(len(ends))
    sums[:] = 0.0
    out[n:] = 0.0
    for row in range(n):
        lo, hi = Index(ptr[row]), Index(ptr[row + Index(1)])
        s0, s1, s2 = gather(blocks, columns, x, lo, hi, AHEAD)
        mine = x[row, 0], x[row, 1], x[row, 2]
        scatter(blocks, columns, sums, lo + Index(1), Index(ends[row]), mine)
        lo, hi = Index(group_ptr[row]), Index(group_ptr[row + Index(1)])
        t0, t1, t2 = gather_edges(groups, columns4, x, lo, hi, AHEAD_EDGES)
        scatter_edges(groups, columns4, out, lo, hi, mine)
        out[row, 0], out[row, 1] = s0 + t0 + sums[row, 0], s1 + t1 + sums[row, 1]
        out[row, 2] = s2 + t2 + sums[row, 2]
    first = Index(3) * n
    for edge in range(Index(len(entry_ptr) - 1)):
        lo, hi = Index(entry_ptr[edge]), Index(entry_ptr[edge + Index(1)])
        mine = u[first + edge]
        s0 = entries[lo, 0] * mine
        for k in range(lo + Index(1), hi):
            other = Index(columns1[k])
            s0 += entries[k, 0] * u[other]
            v[other] += entries[k, 0] * mine
        v[first + edge] += s0
    for row in range(n, n_owned):
        lo, hi = Index(ptr[row]), Index(ptr[row + Index(1)])
        if lo < hi:
            s0, s1, s2 = gather(blocks, columns, x, lo, hi, AHEAD)
            out[row, 0] += s0
            out[row, 1] += s1
            out[row, 2] += s2


class ProductWithEdges:
    """Products with symmetric block rows, of which one half is stored, and edge couplings.

    Parameters
    ----------
    pattern : BlockPattern
    values : (n_stored, 3, 3)
        The product keeps views of them.
    """

    def __init__(self, pattern: BlockPattern, values: Array) -> None:
        couplings = pattern.edge_couplings
        assert couplings is not None
        rows = pattern.indptr, pattern.ends, pattern.columns, *couplings.groups, *couplings.entries
        self._rows = *rows, *couplings.parts(values, pattern.n_blocks)
        self._n_vertices = couplings.n_vertices

    def __call__(self, x: Array, out: Array) -> None:
        """out (n_owned, 3) = A x for x (n_local, 3) with current ghost values."""
        x, sums = read_only(x), np.empty((self._n_vertices, 4))
        multiply(*self._rows, x, x.reshape(-1), sums, out, out.reshape(-1))
