"""Block sparsity from the stencils of the active terms, and the position of each element block in it.

The matrices are symmetric, and only one of each two transposed blocks is stored. If edges carry unknowns,
entries of owned edges are stored as scalars behind the blocks (``edge_couplings``), as half of each block
would be zeros.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Ints
from lyra_petsc.kernels.cache import cached
from lyra_petsc.terms.term import Coupling, Couplings, MixedStencil, OffDiagonal

if TYPE_CHECKING:
    from lyra_petsc.linear.edge_couplings import EdgeCouplings

Offsets = NDArray[np.int32] | NDArray[np.int64]

LARGEST_INT32 = np.iinfo(np.int32).max

MISSING = -2
"""Offset of a coupling that has no block."""


@cached(inline="always")
def block_of(indptr, columns, row, column):  # type: ignore[no-untyped-def]
    """The index of a block, or `MISSING`."""
    lo, hi = indptr[row], indptr[row + 1]
    if row == column:  # the diagonal block is the first one, if the row has one
        hi = min(hi, lo + 1)
    while hi - lo > 1:
        middle = (lo + hi) // 2
        if columns[middle] <= column:
            lo = middle
        else:
            hi = middle
    return lo if lo < hi and columns[lo] == column else MISSING


@cached()
def _look_up(indptr, columns, stencil, out):  # type: ignore[no-untyped-def]
    """Offsets (E, n (n + 1) / 2) of all couplings of elements (E, n)."""
    for e in range(len(stencil)):
        pair = 0
        for a in range(stencil.shape[1]):
            for b in range(a, stencil.shape[1]):
                row, column = min(stencil[e, a], stencil[e, b]), max(stencil[e, a], stencil[e, b])
                offset = -1
                if row < len(indptr) - 1:
                    offset = block_of(indptr, columns, row, column)
                    if offset >= 0:
                        offset = 2 * offset + (1 if stencil[e, a] < stencil[e, b] else 0)
                out[e, pair] = offset
                pair += 1


@cached()
def _misses_block(offsets, acting):  # type: ignore[no-untyped-def]
    for e in range(len(offsets)):
        if acting[e]:
            for pair in range(offsets.shape[1]):
                if offsets[e, pair] == MISSING:
                    return True
    return False


class BlockPattern:
    """Compressed block rows of the owned points; columns in local numbering (owned, then ghosts).

    A row holds the columns from the diagonal on: the upper triangle among owned points, and all ghosts. A
    block is stored column by column, as in PETSc. Rows of owned edges only have blocks with ghosts.

    Parameters
    ----------
    couplings : mapping of name → (E, n) int, OffDiagonal or MixedStencil
        Local rows that elements couple; the pattern has their blocks and the diagonal.
    n_owned, n_local : int
    n_diagonal : int, optional
        Number of rows, the first ones, that have a diagonal block; default n_owned.

    Attributes
    ----------
    n_owned, n_local : int
    n_diagonal : int
        Number of rows, the first ones, with a diagonal block: all rows but those of edges.
    indptr : (n_owned + 1,) int64
        The first block of a row with a diagonal block is that one.
    columns : (n_blocks,) int32
        Local column of each block, ascending within a row.
    offsets : dict of name → (E, n (n + 1) / 2) int32, or int64 if needed
        Block of each coupling (a, b), b ≥ a, of an element, ordered as (0, 0), (0, 1), …, (n − 1, n − 1):
        2 · index of the block, + 1 if the block holds the transpose of (a, b); −1 if other ranks own both
        rows. (E,) for `OffDiagonal`; for `MixedStencil` see ``EdgeCouplings.offsets_of``.
    edges : dict of name → MixedStencil
        Elements that couple edges.
    edge_couplings : EdgeCouplings or None
        Couplings of owned edges, if there are any.
    """

    def __init__(
        self, couplings: Couplings, n_owned: int, n_local: int, n_diagonal: int | None = None
    ) -> None:
        self.edges = {name: part for name, part in couplings.items() if isinstance(part, MixedStencil)}
        self.edge_couplings: EdgeCouplings | None = None
        self.n_diagonal = n_owned if n_diagonal is None else n_diagonal
        if self.edges:
            from lyra_petsc.linear.edge_couplings import EdgeCouplings  # only needed here

            self.edge_couplings = EdgeCouplings(list(self.edges.values()), n_owned)
            self.n_diagonal = self.edge_couplings.n_vertices
        keys = _all_keys(couplings, self.n_diagonal, n_owned, n_local)
        self._set(keys, n_owned, n_local)
        self.offsets: dict[str, Offsets] = {}
        for name, coupling in couplings.items():
            # terms on the same triangles usually share one table
            alike = [other for other in self.offsets if _same(couplings.get(other), coupling)]
            self.offsets[name] = self.offsets[alike[0]] if alike else self.offsets_of(coupling)

    def missing(self, stencils: Iterable[NDArray[np.int32]], n_local: int) -> Ints:
        """Keys row · n_local + column, ascending, of blocks that further elements need and this lacks."""
        keys = [np.empty(0, dtype=np.int64)]
        for stencil in stencils:
            one, other = (stencil[:, side] for side in np.array(_pairs(stencil)).T.reshape(2, -1))
            at = np.flatnonzero(self.offsets_of(stencil).ravel() == MISSING)
            keys.append(_keys(one.ravel()[at], other.ravel()[at], n_local))
        return union(*keys)

    def locate(self, stencils: Mapping[str, NDArray[np.int32]]) -> None:
        """Look up the offsets of further elements; `MISSING` for couplings without a block."""
        for name, stencil in stencils.items():
            self.offsets[name] = self.offsets_of(stencil)

    def misses_block(self, name: str, acting: NDArray[np.bool_]) -> bool:
        """Whether a coupling of an element of `locate` that acts, ``acting`` (E,), has no block."""
        return bool(_misses_block(self.offsets[name], acting))

    def offsets_of(self, coupling: Coupling) -> Offsets:
        """Offsets of elements; `MISSING` for couplings without a block."""
        if isinstance(coupling, MixedStencil):
            assert self.edge_couplings is not None
            return self.edge_couplings.offsets_of(coupling, self)
        stencil = np.ascontiguousarray(_stencil(coupling))
        n = stencil.shape[1]
        out: Offsets = np.empty((len(stencil), n * (n + 1) // 2), dtype=index_type(2 * self.n_blocks))
        _look_up(self.indptr, self.columns, stencil, out)
        return out[:, 1].copy() if isinstance(coupling, OffDiagonal) else out

    def extended(self, more: Ints, n_local: int) -> tuple[BlockPattern, Ints]:
        """The pattern with further blocks ``more``, keys of `missing`, for an n_local with further ghosts.

        Returns
        -------
        pattern : BlockPattern
        positions : (n_blocks,) int64
            Index in the new pattern of each block of this one.
        """
        own = self.keys(n_local)
        positions: Ints = np.arange(len(own)) + np.searchsorted(more, own)
        keys = np.empty(len(own) + len(more), dtype=np.int64)
        keys[positions], keys[np.arange(len(more)) + np.searchsorted(own, more)] = own, more
        made = BlockPattern.of_keys(keys, self.n_owned, n_local)
        made.edges, made.edge_couplings, made.n_diagonal = self.edges, self.edge_couplings, self.n_diagonal
        kind = index_type(2 * len(keys))
        for name, offsets in self.offsets.items():
            if name in self.edges:
                made.offsets[name] = made.offsets_of(self.edges[name])
                continue
            alike = [other for other in made.offsets if self.offsets[other] is offsets]
            if alike:
                made.offsets[name] = made.offsets[alike[0]]
                continue
            moved = 2 * positions[offsets >> 1] + (offsets & 1)
            made.offsets[name] = np.where(offsets < 0, -1, moved).astype(kind)
        return made, positions

    @classmethod
    def of_keys(cls, keys: Ints, n_owned: int, n_local: int) -> BlockPattern:
        """The pattern without elements that has the blocks of ascending keys row · n_local + column."""
        made = cls.__new__(cls)
        made._set(keys, n_owned, n_local)
        made.offsets, made.edges, made.edge_couplings, made.n_diagonal = {}, {}, None, n_owned
        return made

    def _set(self, keys: Ints, n_owned: int, n_local: int) -> None:
        self.n_owned, self.n_local = n_owned, n_local
        rows, columns = np.divmod(keys, max(n_local, 1))
        self.columns: NDArray[np.int32] = columns.astype(np.int32)
        self.indptr: Ints = row_pointers(np.bincount(rows, minlength=n_owned))

    def keys(self, n_local: int) -> Ints:
        """Keys row · n_local + column of all blocks, ascending."""
        rows = np.repeat(np.arange(self.n_owned, dtype=np.int64), np.diff(self.indptr))
        return rows * n_local + self.columns

    @property
    def n_blocks(self) -> int:
        return len(self.columns)

    @cached_property
    def ends(self) -> Ints:
        """Index (n_owned,) of each row's first block in a ghost column."""
        owned = self.columns < self.n_owned
        if owned.all():
            return self.indptr[1:]
        ends: Ints = self.indptr[:-1] + np.diff(row_pointers(owned)[self.indptr])
        return ends

    @property
    def n_stored(self) -> int:
        """Number of 3 × 3 blocks that take as much memory as all values, including those of edges."""
        return self.n_blocks if self.edge_couplings is None else self.edge_couplings.n_stored(self.n_blocks)

    @property
    def n_couplings(self) -> int:
        """Blocks in both halves of the owned rows; nine entries of edges count as a block."""
        blocks = self.n_blocks + int(np.count_nonzero(self.columns < self.n_owned)) - self.n_diagonal
        return blocks if self.edge_couplings is None else blocks + self.edge_couplings.n_entries // 9

    @cached_property
    def whole(self) -> BlockPattern:
        """The equivalent pattern of 3 × 3 blocks only, in which rows of owned edges hold three edges."""
        return self if self.edge_couplings is None else self.edge_couplings.whole(self)

    def in_blocks(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values (n_blocks, 3, 3) of the pattern ``whole`` from values (n_stored, 3, 3)."""
        return values if self.edge_couplings is None else self.edge_couplings.in_blocks(self, values)


def row_pointers(counts: NDArray[Any]) -> Ints:
    """Compressed-row pointers (n + 1,) of rows with ``counts`` (n,) entries."""
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])


def diagonal_keys(n_owned: int, n_local: int) -> Ints:
    """Keys of the diagonal blocks, ascending."""
    return np.arange(n_owned, dtype=np.int64) * (n_local + 1)


def index_type(largest: int) -> np.dtype[Any]:
    """The smaller integer type that can hold ``largest``."""
    return np.dtype("int32" if largest <= LARGEST_INT32 else "int64")


def _pairs(coupling: Coupling) -> list[tuple[int, int]]:
    """Pairs (a, b), b ≥ a, of an element's rows that are coupled."""
    if isinstance(coupling, OffDiagonal):
        return [(0, 1)]
    n = _stencil(coupling).shape[1]
    return [(a, b) for a in range(n) for b in range(a, n)]


def _stencil(coupling: Coupling) -> NDArray[np.int32]:
    return coupling.stencil if isinstance(coupling, OffDiagonal | MixedStencil) else coupling


def _same(one: Coupling | None, other: Coupling) -> bool:
    if one is None or type(one) is not type(other) or not np.array_equal(_stencil(one), _stencil(other)):
        return False
    return not (isinstance(one, MixedStencil) and isinstance(other, MixedStencil)) or np.array_equal(
        one.edges, other.edges
    )


def _keys(one: NDArray[np.int32], other: NDArray[np.int32], n_local: int) -> Ints:
    key: Ints = np.minimum(one, other).astype(np.int64) * n_local + np.maximum(one, other)
    return key


def _all_keys(couplings: Couplings, n_diagonal: int, n_owned: int, n_local: int) -> Ints:
    """Keys of the diagonal blocks and of all couplings stored on this rank, ascending."""
    keys = diagonal_keys(n_diagonal, n_local)

    def stored(part: Ints) -> Ints:
        part = part[part < n_owned * n_local]
        if not any(isinstance(coupling, MixedStencil) for coupling in couplings.values()):
            return part
        column = part % n_local
        return part[(column < n_diagonal) | (column >= n_owned)]

    for coupling in couplings.values():
        stencil = _stencil(coupling)
        # row by row of the elements, as all pairs at once take much memory
        for _, pairs in groupby(_pairs(coupling), key=itemgetter(0)):
            of_pairs = (_keys(stencil[:, a], stencil[:, b], n_local) for a, b in pairs)
            keys = union(keys, *map(stored, of_pairs))
    return keys


def union(*parts: Ints) -> Ints:
    """The sorted unique numbers of all parts, as ``np.unique`` with one copy less."""
    numbers = np.concatenate(parts)
    numbers.sort()
    return numbers[np.concatenate([[True], numbers[1:] != numbers[:-1]])] if len(numbers) else numbers
