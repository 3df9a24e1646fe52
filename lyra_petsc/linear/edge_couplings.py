"""Couplings of edges one by one, behind the blocks of a pattern.

In blocks of 3 × 3, with edges in rows of three, four tenths of the numbers of vertices and edges would be
zero in any matrix, of those of edges seven tenths. So owned rows have, of two numbers that are each other's
transpose one:

- 3 × 3 blocks of vertices, which are the pattern's,
- of each vertex, 3 × 4 blocks with groups of four of its edges; what is too much in the last is zero,
- numbers of edges.

Couplings to ghosts, of which there are few, are 3 × 3 blocks of the pattern. Values are one array: blocks,
groups, numbers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.kernels.vectors import AHEAD, gather, gather_edges, scatter, scatter_edges
from lyra_petsc.linear.pattern import MISSING, BlockPattern, block_of, index_type, row_pointers, union

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lyra_petsc.terms.term import Offsets, WithEdges


GROUP = 4
"""Edges of a vertex in one block."""

ALIGNED = 4
"""Groups begin where the number of blocks before them would be a multiple of this: at 16 bytes."""

AHEAD_EDGES = 32
"""Blocks of four edges by which they are fetched before they are used."""


class Groups(NamedTuple):
    """3 × 4 blocks of owned vertices with four owned edges.

    Attributes
    ----------
    indptr : (n_vertices + 1,)
    places : (n_groups, 4) int32
        Of the edges' unknowns in the flat form of arrays over local rows.
    """

    indptr: Ints
    places: NDArray[np.int32]


class Numbers(NamedTuple):
    """Couplings of owned edges.

    Attributes
    ----------
    indptr : (n + 1,) int32, int64 where there are too many
        Of places from that of the first edge on; the first of a row is its diagonal.
    places : (n_numbers,) int32
    """

    indptr: NDArray[Any]
    places: NDArray[np.int32]


class EdgeValues(NamedTuple):
    """Values of a pattern's couplings.

    Attributes
    ----------
    blocks : (n_blocks, 9)
        Column by column.
    groups : (n_groups, 12)
        Row by row.
    numbers : (n_numbers, 1)
    """

    blocks: NDArray[Any]
    groups: NDArray[Any]
    numbers: NDArray[Any]


class EdgeCouplings:
    """Which couplings of owned edges there are.

    Parameters
    ----------
    elements : sequence of WithEdges
    n_owned : int
        Block rows that this rank owns.

    Attributes
    ----------
    n_vertices : int
        Owned rows before the first one of edges.
    groups, numbers
    """

    def __init__(self, elements: Sequence[WithEdges], n_owned: int) -> None:
        self._n, beyond = n_owned, 3 * n_owned
        least = (int(part.edges.min(initial=beyond)) for part in elements)
        self.n_vertices = first = min(beyond, *least) // 3

        def keys(part: WithEdges) -> tuple[list[Ints], list[Ints]]:
            """Of vertices and edges, and of two edges: one times ``beyond`` plus the place of the other."""
            mixed, edges = [], []
            places = part.edges.astype(np.int64)
            for b, place in enumerate(places.T):
                for vertex in part.vertices.T:
                    there = (place < beyond) & (vertex < n_owned)
                    mixed.append(vertex[there].astype(np.int64) * beyond + place[there])
                for other in places.T[:b]:
                    there = (place < beyond) & (other < beyond)
                    lesser, greater = np.minimum(place, other)[there], np.maximum(place, other)[there]
                    edges.append(lesser * beyond + greater)
            return mixed, edges

        found = [keys(part) for part in elements]
        vertex, place = np.divmod(union(*(key for mixed, _ in found for key in mixed)), max(beyond, 1))
        count = np.bincount(vertex, minlength=first)
        groups = row_pointers(-(-count // GROUP))
        at = GROUP * groups[vertex] + np.arange(len(vertex)) - row_pointers(count)[vertex]
        places = np.full(GROUP * groups[-1], -1, dtype=np.int32)
        places[at] = place
        # in place of edges that are not there, one that is near
        places = places.reshape(-1, GROUP)
        self.groups = Groups(groups, np.where(places < 0, places[:, :1], places))

        diagonal = np.arange(3 * first, beyond, dtype=np.int64) * (beyond + 1)
        one, other = np.divmod(union(diagonal, *(key for _, edges in found for key in edges)), max(beyond, 1))
        indptr = row_pointers(np.bincount(one - 3 * first, minlength=len(diagonal)))
        self.numbers = Numbers(indptr.astype(index_type(len(other))), other.astype(np.int32))

    # -- where values stand --------------------------------------------------------------------------

    @property
    def n_values(self) -> int:
        """Of groups and numbers."""
        return int(3 * self.groups.places.size + len(self.numbers.places))

    @property
    def n_numbers(self) -> int:
        """In whole rows, both of those that are each other's transpose, and zeros in groups."""
        return 2 * self.n_values - len(self.numbers.indptr) + 1

    def first_group(self, n_blocks: int) -> int:
        """Where groups begin behind so many blocks, in the flat form of values."""
        return 9 * ALIGNED * -(-n_blocks // ALIGNED)

    def first_number(self, n_blocks: int) -> int:
        """Where numbers begin."""
        return self.first_group(n_blocks) + 3 * self.groups.places.size

    def room(self, n_blocks: int) -> int:
        """Blocks (3 × 3) that all values have the size of."""
        return -(-(self.first_group(n_blocks) + self.n_values) // 9)

    def diagonal(self, n_blocks: int) -> Ints:
        """Where the edges' own numbers stand, those of padding too."""
        own: Ints = self.numbers.indptr[:-1].astype(np.int64)
        return own + self.first_number(n_blocks)

    def parts(self, values: NDArray[Any], n_blocks: int) -> EdgeValues:
        """Views of values (n_stored, 3, 3)."""
        flat, first, last = values.reshape(-1), self.first_group(n_blocks), self.first_number(n_blocks)
        blocks, groups = flat[: 9 * n_blocks].reshape(-1, 9), flat[first:last].reshape(-1, 3 * GROUP)
        return EdgeValues(blocks, groups, flat[last : last + len(self.numbers.places)].reshape(-1, 1))

    def offsets_of(self, elements: WithEdges, pattern: BlockPattern) -> Offsets:
        """Where the couplings (a, b), b ≥ a, of elements go in which b is an edge; edges come after vertices.

        Of a vertex and an edge four times the place of the first of three numbers in the flat form of values,
        plus how far apart they are, less one; of two edges the place of their number. −1 where other ranks
        have both.
        """
        stencil, m = elements.stencil, elements.edges.shape[1]
        n = stencil.shape[1] - m
        first = self.first_group(pattern.n_blocks)
        kind = index_type(4 * (first + self.n_values))
        out: Offsets = np.empty((len(stencil), n * m + m * (m + 1) // 2), dtype=kind)
        rows = pattern.indptr, pattern.columns, *self.groups, *self.numbers
        _look_up(*rows, first, self.first_number(pattern.n_blocks), stencil, elements.edges, out)
        return out

    # -- prescribed unknowns -------------------------------------------------------------------------

    def beside(self, mask: NDArray[np.bool_], n_blocks: int) -> tuple[Ints, Ints, Ints]:
        """Of prescribed unknowns, mask (n_local, 3), in the flat form of values: couplings with them (m,),
        edges' own numbers (k,), and the own numbers (k, 3) of edges in the same rows.
        """
        held = mask.ravel()
        vertex = np.repeat(np.arange(self.n_vertices), np.diff(self.groups.indptr))
        coupled = mask[vertex][:, :, None] | held[self.groups.places][:, None, :]
        of_groups = self.first_group(n_blocks) + np.flatnonzero(coupled)
        indptr, places = self.numbers
        edge = np.repeat(np.arange(3 * self.n_vertices, 3 * self._n), np.diff(indptr))
        own = self.diagonal(n_blocks)
        of_numbers = held[edge] | held[places]
        of_numbers[indptr[:-1]] = False
        zeros = np.concatenate([of_groups, self.first_number(n_blocks) + np.flatnonzero(of_numbers)])
        edges: Ints = np.flatnonzero(held[3 * self.n_vertices : 3 * self._n])
        return zeros, own[edges], own.reshape(-1, 3)[edges // 3]

    # -- in blocks -----------------------------------------------------------------------------------

    def _coupled(self) -> tuple[Ints, Ints, Ints, Ints]:
        """Of all numbers of groups and of edges their rows and columns, places in the flat form."""
        vertex = np.repeat(np.arange(self.n_vertices), np.diff(self.groups.indptr))
        shape = (len(vertex), 3, GROUP)
        row = np.broadcast_to((3 * vertex[:, None] + np.arange(3))[:, :, None], shape).ravel()
        column = np.broadcast_to(self.groups.places[:, None, :], shape).ravel()
        edge = np.repeat(np.arange(3 * self.n_vertices, 3 * self._n), np.diff(self.numbers.indptr))
        return row, column.astype(np.int64), edge, self.numbers.places.astype(np.int64)

    def whole(self, pattern: BlockPattern) -> BlockPattern:
        """A pattern of blocks alone, in which owned edges are in rows of three."""
        row, column, edge, other = (place // 3 for place in self._coupled())
        keys = union(
            pattern.keys(pattern.n_local), row * pattern.n_local + column, edge * pattern.n_local + other
        )
        return BlockPattern.of_keys(keys, pattern.n_owned, pattern.n_local)

    def in_blocks(self, pattern: BlockPattern, values: Array) -> Array:
        """Values (n_stored, 3, 3) as that pattern has them, (n_blocks, 3, 3)."""
        blocks, groups, numbers = self.parts(values, pattern.n_blocks)
        n_local = pattern.n_local
        keys = pattern.whole.keys(n_local)
        out = np.zeros((len(keys), 9))
        out[np.searchsorted(keys, pattern.keys(n_local))] = blocks
        flat = out.reshape(-1)

        def place(row: Ints, column: Ints) -> Ints:
            """Values of a block stand column by column."""
            block = np.searchsorted(keys, (row // 3) * n_local + column // 3)
            found: Ints = 9 * block + 3 * (column % 3) + row % 3
            return found

        row, column, edge, other = self._coupled()
        # of an edge that fills up a group the coupling is 0 there
        np.add.at(flat, place(row, column), groups.ravel())
        flat[place(edge, other)] = numbers[:, 0]
        together = edge // 3 == other // 3
        flat[place(other[together], edge[together])] = numbers[together, 0]
        return out.reshape(-1, 3, 3)


@cached()
def _look_up(  # type: ignore[no-untyped-def]
    indptr, columns, group_ptr, places, number_ptr, others, first_group, first_number, stencil, edges, out
):
    """Offsets of elements whose stencil (E, n + m) ends with the rows of edges (E, m)."""
    n_owned, n_vertices = len(indptr) - 1, len(group_ptr) - 1
    n = stencil.shape[1] - edges.shape[1]
    for e in range(len(stencil)):
        pair = 0
        for a in range(stencil.shape[1]):
            for b in range(max(a, n), stencil.shape[1]):
                found = -1
                one, other = stencil[e, a], stencil[e, b]
                row, column = min(one, other), max(one, other)
                if row < n_owned:
                    if column >= n_owned:
                        found = block_of(indptr, columns, row, column)
                        if found >= 0:
                            place = edges[e, b - n] % 3
                            if a < n:
                                found = (
                                    4 * (9 * found + 3 * place) if one == row else 4 * (9 * found + place) + 2
                                )
                            else:
                                before = edges[e, a - n] % 3
                                i, j = (before, place) if one == row else (place, before)
                                found = 9 * found + 3 * j + i
                    elif a < n:
                        found = MISSING
                        for k in range(4 * group_ptr[one], 4 * group_ptr[one + 1]):
                            if places[k // 4, k % 4] == edges[e, b - n]:
                                found = 4 * (first_group + 12 * (k // 4) + k % 4) + 3
                                break
                    else:
                        lesser, greater = edges[e, a - n], edges[e, b - n]
                        if lesser > greater:
                            lesser, greater = greater, lesser
                        found = MISSING
                        edge = lesser - 3 * n_vertices
                        for k in range(number_ptr[edge], number_ptr[edge + 1]):
                            if others[k] == greater:
                                found = first_number + k
                                break
                out[e, pair] = found
                pair += 1


@cached(fastmath={"contract", "nsz"})
def multiply(  # type: ignore[no-untyped-def]
    indptr, ends, columns, group_ptr, places, number_ptr, others, blocks, groups, numbers, x, sums, out
):
    """out (n_owned, 3) = the matrix · x (n_local, 3); sums (n_vertices, 4) is scratch."""
    n, n_owned = Index(len(sums)), Index(len(ends))
    sums[:] = 0.0
    out[n:] = 0.0
    for row in range(n):
        lo, hi = Index(indptr[row]), Index(indptr[row + Index(1)])
        s0, s1, s2 = gather(blocks, columns, x, lo, hi, AHEAD)
        mine = x[row, 0], x[row, 1], x[row, 2]
        scatter(blocks, columns, sums, lo + Index(1), Index(ends[row]), mine)
        lo, hi = Index(group_ptr[row]), Index(group_ptr[row + Index(1)])
        t0, t1, t2 = gather_edges(groups, places, x, lo, hi, AHEAD_EDGES)
        scatter_edges(groups, places, out, lo, hi, mine)
        out[row, 0], out[row, 1] = s0 + t0 + sums[row, 0], s1 + t1 + sums[row, 1]
        out[row, 2] = s2 + t2 + sums[row, 2]
    first, flat, to = Index(3) * n, x.reshape(-1), out.reshape(-1)
    for edge in range(Index(len(number_ptr) - 1)):
        lo, hi = Index(number_ptr[edge]), Index(number_ptr[edge + Index(1)])
        mine = flat[first + edge]
        s0 = numbers[lo, 0] * mine
        for k in range(lo + Index(1), hi):
            other = Index(others[k])
            s0 += numbers[k, 0] * flat[other]
            to[other] += numbers[k, 0] * mine
        to[first + edge] += s0
    for row in range(n, n_owned):
        lo, hi = Index(indptr[row]), Index(indptr[row + Index(1)])
        if lo < hi:
            s0, s1, s2 = gather(blocks, columns, x, lo, hi, AHEAD)
            out[row, 0] += s0
            out[row, 1] += s1
            out[row, 2] += s2


class ProductWithEdges:
    """Products with symmetric values of which one half is stored, some of them of edges.

    Parameters
    ----------
    pattern : BlockPattern
    values : (n_stored, 3, 3)
        They are read where they stand.
    """

    def __init__(self, pattern: BlockPattern, values: Array) -> None:
        couplings = pattern.edge_couplings
        assert couplings is not None
        rows = pattern.indptr, pattern.ends, pattern.columns, *couplings.groups, *couplings.numbers
        self._rows = *rows, *couplings.parts(values, pattern.n_blocks)
        self._n_vertices = couplings.n_vertices

    def __call__(self, x: Array, out: Array) -> None:
        """Put into out (n_owned, 3) the product with x (n_local, 3), ghosts up to date."""
        multiply(*self._rows, x, np.empty((self._n_vertices, 4)), out)
