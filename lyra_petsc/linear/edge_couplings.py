"""Couplings of edges one by one, where block rows hold three edges in a row.

Of the 3 × 3 blocks of vertices and edges four tenths are zero in any matrix, of those of edges seven tenths:
products and sweeps work on a copy without them. Among owned rows it has, of two blocks or numbers that are
each other's transpose one:

- 3 × 3 blocks of vertices,
- of each vertex, 3 × 4 blocks with groups of four of its edges; what is too much in the last is zero,
- numbers of edges.

Couplings to ghosts, of which there are few, stay 3 × 3 blocks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.kernels.vectors import AHEAD, gather, gather_edges, scatter, scatter_edges
from lyra_petsc.linear.block_product import HalfStored
from lyra_petsc.linear.pattern import begins, index_type

if TYPE_CHECKING:
    from lyra_petsc.linear.pattern import BlockPattern

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

GROUP = 4
"""Edges of a vertex in one block."""

AHEAD_EDGES = 32
"""Blocks of four edges by which they are fetched before they are used."""


class Blocks(NamedTuple):
    """3 × 3 blocks as a pattern has them, but those with owned edges.

    Attributes
    ----------
    indptr : (n_owned + 1,)
    ends : (n_owned,)
        Where a row's blocks in columns of ghosts begin.
    columns : (n_blocks,)
    """

    indptr: Ints
    ends: Ints
    columns: NDArray[np.int32]


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
    indptr : (n + 1,)
        Of places from that of the first edge on; the first of a row is its diagonal.
    places : (n_numbers,) int32
    """

    indptr: Ints
    places: NDArray[np.int32]


class EdgeCouplings:
    """Which couplings there are, and where a pattern has them.

    Parameters
    ----------
    pattern : BlockPattern
        With elements that couple edges.

    Attributes
    ----------
    n_vertices : int
        Owned rows before the first one of edges.
    blocks, groups, numbers
    """

    def __init__(self, pattern: BlockPattern) -> None:
        n, n_local = pattern.n_owned, pattern.n_local
        vertices = np.concatenate([part.vertices for part in pattern.edges])
        edges = np.concatenate([part.edges for part in pattern.edges])
        owned = edges < 3 * n
        self.n_vertices = first = int(edges.min(initial=3 * n, where=owned) // 3)
        rows = np.repeat(np.arange(n, dtype=np.int64), np.diff(pattern.indptr))
        keys = rows * n_local + pattern.columns
        kept = (pattern.columns >= n) | (pattern.columns < first)
        self._block = np.flatnonzero(kept).astype(index_type(pattern.n_blocks))
        sums = begins(kept)
        ends = sums[pattern.ends]
        self.blocks = Blocks(sums[pattern.indptr], ends, pattern.columns[kept])

        def number(row: Ints, place: Ints) -> Ints:
            """Where the pattern's flat form has the first coupling of a row with a place."""
            block = np.searchsorted(keys, row * n_local + place // 3)
            return 9 * block + 3 * (place % 3)

        pairs = [
            vertices[:, a].astype(np.int64) * (3 * n) + edges[:, b]
            for a in range(vertices.shape[1])
            for b in range(edges.shape[1])
        ]
        inside = [
            owned[:, b] & (vertices[:, a] < n)
            for a in range(vertices.shape[1])
            for b in range(edges.shape[1])
        ]
        vertex, place = np.divmod(_once(pairs, inside), 3 * n)
        count = np.bincount(vertex, minlength=first)
        groups = begins(-(-count // GROUP))
        at = GROUP * groups[vertex] + np.arange(len(vertex)) - begins(count)[vertex]
        places = np.zeros(GROUP * groups[-1], dtype=np.int32)
        self._triple = np.full(GROUP * groups[-1], -1, dtype=index_type(9 * pattern.n_blocks))
        places[at], self._triple[at] = place, number(vertex, place)
        # in place of edges that are not there, one that is near
        places = places.reshape(-1, GROUP)
        places = np.where(self._triple.reshape(-1, GROUP) < 0, places[:, :1], places)
        self.groups = Groups(groups, places)

        pairs = [
            np.minimum(edges[:, a], edges[:, b]).astype(np.int64) * (3 * n)
            + np.maximum(edges[:, a], edges[:, b])
            for a in range(edges.shape[1])
            for b in range(a)
        ]
        inside = [owned[:, a] & owned[:, b] for a in range(edges.shape[1]) for b in range(a)]
        diagonal = np.arange(3 * first, 3 * n, dtype=np.int64) * (3 * n + 1)
        one, other = np.divmod(_once([*pairs, diagonal], [*inside, np.ones(len(diagonal), bool)]), 3 * n)
        indptr = begins(np.bincount(one - 3 * first, minlength=len(diagonal)))
        self._number = (number(one // 3, other) + one % 3).astype(self._triple.dtype)
        self.numbers = Numbers(indptr, other.astype(np.int32))

    @property
    def n_numbers(self) -> int:
        """Of the whole rows, zeros in the groups among them."""
        inside = 9 * int(np.count_nonzero(self.blocks.columns < self.n_vertices)) + len(self.numbers.places)
        inside += 3 * self.groups.places.size
        beyond = len(self.blocks.columns) - int(np.count_nonzero(self.blocks.columns < self.n_vertices))
        return 2 * inside + 9 * beyond - 9 * self.n_vertices - len(self.numbers.indptr) + 1

    @property
    def n_values(self) -> int:
        """How many values there are."""
        return int(9 * len(self._block) + 3 * self.groups.places.size + len(self._number))

    def within(self, memory: NDArray[Any]) -> EdgeValues:
        """Room for values in ``memory`` (at least n_values,)."""
        first = 3 * self.groups.places.size
        last = first + 9 * len(self._block)
        groups, blocks = memory[:first].reshape(-1, 3 * GROUP), memory[first:last].reshape(-1, 9)
        return EdgeValues(blocks, groups, memory[last : self.n_values].reshape(-1, 1))

    def take(self, values: Array, least: float, out: EdgeValues, wide: EdgeValues | None = None) -> None:
        """Copy block rows (n_blocks, 9); entries up to ``least`` become 0, but in ``wide``."""
        whole = wide or EdgeValues(np.empty((0, 9)), np.empty((0, 3 * GROUP)), np.empty((0, 1)))
        where = self._block, self._triple, self._number
        _take(*where, values, values.reshape(-1), least, wide is not None, *out, *whole)


class EdgeValues(NamedTuple):
    """Values of the couplings.

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


def _once(keys: list[Ints], chosen: list[NDArray[np.bool_]]) -> Ints:
    """Of keys (n,) those chosen, ascending."""
    found: Ints = np.unique(np.concatenate([key[there] for key, there in zip(keys, chosen, strict=True)]))
    return found


@cached()
def _take(  # type: ignore[no-untyped-def]
    block, triple, number, values, flat, least, both, blocks, groups, numbers, wide, wide_groups, wide_numbers
):
    for k in range(Index(len(block))):
        b = Index(block[k])
        for i in range(Index(9)):
            value = values[b, i]
            blocks[k, i] = value if abs(value) > least else 0.0
            if both:
                wide[k, i] = value
    for k in range(Index(len(groups))):
        for lane in range(Index(4)):
            at = triple[Index(4) * k + lane]
            for i in range(Index(3)):
                value = flat[Index(at) + i] if at >= 0 else 0.0
                groups[k, Index(4) * i + lane] = value if abs(value) > least else 0.0
                if both:
                    wide_groups[k, Index(4) * i + lane] = value
    for k in range(Index(len(number))):
        value = flat[Index(number[k])]
        numbers[k, 0] = value if abs(value) > least else 0.0
        if both:
            wide_numbers[k, 0] = value


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
    """Products with symmetric block rows of which one half is stored, some of them of edges.

    For a copy some ten products must follow; it is made along with that of the sweeps.

    Parameters
    ----------
    couplings : EdgeCouplings
    pattern : BlockPattern
    values : (n_blocks, 3, 3)
        ``changed`` says that they are others.
    """

    def __init__(self, couplings: EdgeCouplings, pattern: BlockPattern, values: Array) -> None:
        self.couplings, self._whole = couplings, HalfStored(pattern, values)
        self._rows = *couplings.blocks, *couplings.groups, *couplings.numbers
        self._values: EdgeValues | None = None
        self._current = False

    def changed(self) -> None:
        """The values are others."""
        self._current = False

    def copied(self, values: EdgeValues) -> EdgeValues:
        """Where the caller copies the values as they are now."""
        self._values, self._current = values, True
        return values

    def __call__(self, x: Array, out: Array) -> None:
        """Put into out (n_owned, 3) the product with x (n_local, 3), ghosts up to date."""
        if self._current and self._values is not None:
            sums = np.empty((self.couplings.n_vertices, 4))
            multiply(*self._rows, *self._values, x, sums, out)
        else:
            self._whole(x, out)
