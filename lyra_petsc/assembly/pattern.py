"""Block sparsity from the stencils of the active terms, and where each element block goes.

The matrices are symmetric: of two blocks that are each other's transpose one is stored.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Offsets = NDArray[np.int32] | NDArray[np.int64]

LARGEST_INT32 = 2**31 - 1


class BlockPattern:
    """Compressed block rows of the owned points; columns in local numbering (owned, then ghosts).

    A row holds the columns from its own on: the upper triangle among owned points, and all ghosts. Values of
    a block stand column by column, as PETSc keeps them.

    Parameters
    ----------
    stencils : mapping of name → (E, n) int
        Local numbering; only these couplings get an entry, and the diagonal.
        Of pairs of points (E, 2) the coupling of the two alone.
    n_owned, n_local : int

    Attributes
    ----------
    n_owned : int
    indptr : (n_owned + 1,) int64
        The first block of a row is the diagonal one.
    columns : (n_blocks,) int32
        Local column of each block, ascending within a row.
    offsets : dict of name → (E, n (n + 1) / 2) int32, int64 where there are too many blocks
        Where the couplings (a, b), b ≥ a, of an element go, as (0, 0), (0, 1), …, (n − 1, n − 1): twice the
        index of the block, plus 1 where its values are those of (a, b) transposed; −1 where other ranks have
        both rows. Of pairs (E,).
    """

    def __init__(self, stencils: Mapping[str, NDArray[np.int32]], n_owned: int, n_local: int) -> None:
        keys = diagonal_keys(n_owned, n_local)
        for stencil in stencils.values():
            # one after the other: all couplings at once take much memory
            for _, pairs in groupby(couplings(stencil), key=itemgetter(0)):
                keys = union(keys, *_row_keys(stencil, pairs, n_owned, n_local))
        self._set(keys, n_owned, n_local)
        self.offsets: dict[str, Offsets] = {}
        for name, stencil in stencils.items():
            # terms on the same triangles are wont to have them in the same order
            alike = [other for other in self.offsets if np.array_equal(stencils[other], stencil)]
            self.offsets[name] = (
                self.offsets[alike[0]] if alike else _offsets(stencil, keys, n_owned, n_local)
            )

    @classmethod
    def of_keys(cls, keys: Ints, n_owned: int, n_local: int) -> BlockPattern:
        """The pattern with these blocks, ascending row · n_local + column, which no elements add to."""
        made = cls.__new__(cls)
        made._set(keys, n_owned, n_local)
        made.offsets = {}
        return made

    def _set(self, keys: Ints, n_owned: int, n_local: int) -> None:
        self.n_owned = n_owned
        rows, columns = np.divmod(keys, max(n_local, 1))
        self.columns: NDArray[np.int32] = columns.astype(np.int32)
        self.indptr: Ints = begins(np.bincount(rows, minlength=n_owned))

    @property
    def n_blocks(self) -> int:
        return len(self.columns)

    @cached_property
    def ends(self) -> Ints:
        """Where (n_owned,) the blocks of a row in columns of ghosts begin."""
        owned = self.columns < self.n_owned
        if owned.all():
            return self.indptr[1:]
        ends: Ints = self.indptr[:-1] + np.diff(begins(owned)[self.indptr])
        return ends

    @property
    def n_couplings(self) -> int:
        """Blocks of the whole rows, both of those that are each other's transpose."""
        return self.n_blocks + int(np.count_nonzero(self.columns < self.n_owned)) - self.n_owned


def begins(counts: NDArray[Any]) -> Ints:
    """Sums (n + 1,) of the first 0, 1, … of ``counts`` (n,): where rows of so many blocks begin and end."""
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])


def diagonal_keys(n_owned: int, n_local: int) -> Ints:
    """Keys of the diagonal blocks, ascending."""
    return np.arange(n_owned, dtype=np.int64) * (n_local + 1)


def index_type(largest: int) -> np.dtype[Any]:
    """The smaller kind of offsets that counts so far."""
    return np.dtype("int32" if largest <= LARGEST_INT32 else "int64")


def couplings(stencil: NDArray[np.int32]) -> list[tuple[int, int]]:
    """Which points (a, b), b ≥ a, of elements (E, n) are coupled."""
    n = stencil.shape[1]
    return [(0, 1)] if n == 2 else [(a, b) for a in range(n) for b in range(a, n)]


def _keys(one: NDArray[np.int32], other: NDArray[np.int32], n_local: int) -> Ints:
    key: Ints = np.minimum(one, other).astype(np.int64) * n_local + np.maximum(one, other)
    return key


def _row_keys(
    stencil: NDArray[np.int32], pairs: Iterable[tuple[int, int]], n_owned: int, n_local: int
) -> Iterator[Ints]:
    """Keys row · n_local + column of the couplings of each element's vertices (a, b)."""
    for a, b in pairs:
        keys = _keys(stencil[:, a], stencil[:, b], n_local)
        yield keys[keys < n_owned * n_local]


def union(*parts: Ints) -> Ints:
    """All numbers, ascending, each once; as ``np.unique``, with one copy less."""
    numbers = np.concatenate(parts)
    numbers.sort()
    return numbers[np.concatenate([[True], numbers[1:] != numbers[:-1]])] if len(numbers) else numbers


def _offsets(stencil: NDArray[np.int32], keys: Ints, n_owned: int, n_local: int) -> Offsets:
    pairs = couplings(stencil)
    out: Offsets = np.empty((len(stencil), len(pairs)), dtype=index_type(2 * len(keys)))
    for pair, (a, b) in enumerate(pairs):
        one, other = stencil[:, a], stencil[:, b]
        found = 2 * np.searchsorted(keys, _keys(one, other, n_local)) + (one < other)
        out[:, pair] = np.where(np.minimum(one, other) < n_owned, found, -1)
    return out[:, 0] if stencil.shape[1] == 2 else out
