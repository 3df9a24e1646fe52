"""Block sparsity from the stencils of the active terms, and where each element block goes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Offsets = NDArray[np.int32] | NDArray[np.int64]

LARGEST_INT32 = 2**31 - 1


class BlockPattern:
    """Compressed block rows of the owned points; columns in local numbering (owned and ghost).

    Parameters
    ----------
    stencils : mapping of name → (E, n) int
        Local numbering; only these couplings get an entry, and the diagonal.
    n_owned, n_local : int
    global_number : (n_local,) int64
        Columns of a row are in ascending global order.

    Attributes
    ----------
    indptr : (n_owned + 1,) int64
    columns : (n_blocks,) int64
        Local column of each block.
    diagonal : (n_owned,) int64
        Index of each row's diagonal block.
    offsets : dict of name → (E, n, n) int32, int64 where there are too many blocks
        Index of the block that element e's coupling (a, b) adds to; −1 for rows of other ranks.
    """

    def __init__(
        self, stencils: Mapping[str, NDArray[np.int32]], n_owned: int, n_local: int, global_number: Ints
    ) -> None:
        position = places(global_number)
        keys = diagonal_keys(n_owned, position)
        for stencil in stencils.values():
            for a in range(stencil.shape[1]):  # one after the other: all couplings at once take much memory
                keys = union(keys, *_row_keys(stencil, a, n_owned, n_local, position))
        self._set(keys, n_owned, position)
        self.offsets: dict[str, Offsets] = {
            name: _offsets(s, keys, n_owned, n_local, position) for name, s in stencils.items()
        }

    @classmethod
    def of_keys(cls, keys: Ints, n_owned: int, position: Ints) -> BlockPattern:
        """The pattern with these blocks, which no elements add to.

        ``keys`` are ascending, row · n_local + ``position`` (n_local,) of the column.
        """
        made = cls.__new__(cls)
        made._set(keys, n_owned, position)
        made.offsets = {}
        return made

    def _set(self, keys: Ints, n_owned: int, position: Ints) -> None:
        rows, at = np.divmod(keys, max(len(position), 1))
        self.columns: Ints = np.argsort(position)[at]
        self.indptr: Ints = np.zeros(n_owned + 1, dtype=np.int64)
        np.cumsum(np.bincount(rows, minlength=n_owned), out=self.indptr[1:])
        self.diagonal: Ints = np.searchsorted(keys, diagonal_keys(n_owned, position))

    @property
    def n_blocks(self) -> int:
        return len(self.columns)


def places(global_number: Ints) -> Ints:
    """Place of each local point in ascending global order, (n_local,)."""
    position = np.empty(len(global_number), dtype=np.int64)
    position[np.argsort(global_number)] = np.arange(len(global_number))
    return position


def diagonal_keys(n_owned: int, position: Ints) -> Ints:
    """Keys of the diagonal blocks, ascending."""
    return np.arange(n_owned, dtype=np.int64) * len(position) + position[:n_owned]


def index_type(largest: int) -> np.dtype[Any]:
    """The smaller kind of offsets that counts so far."""
    return np.dtype("int32" if largest <= LARGEST_INT32 else "int64")


def _pair_keys(stencil: NDArray[np.int32], a: int, b: int, n_local: int, position: Ints) -> Ints:
    key: Ints = stencil[:, a].astype(np.int64) * n_local + position[stencil[:, b]]
    return key


def _row_keys(stencil: NDArray[np.int32], a: int, n_owned: int, n_local: int, position: Ints) -> list[Ints]:
    """Keys row · n_local + column place of the couplings of each element's vertex a, where that is owned."""
    mine = stencil[stencil[:, a] < n_owned]
    return [_pair_keys(mine, a, b, n_local, position) for b in range(stencil.shape[1])]


def union(*parts: Ints) -> Ints:
    """All numbers, ascending, each once; as ``np.unique``, with one copy less."""
    numbers = np.concatenate(parts)
    numbers.sort()
    return numbers[np.concatenate([[True], numbers[1:] != numbers[:-1]])] if len(numbers) else numbers


def _offsets(stencil: NDArray[np.int32], keys: Ints, n_owned: int, n_local: int, position: Ints) -> Offsets:
    n = stencil.shape[1]
    out: Offsets = np.empty((len(stencil), n, n), dtype=index_type(len(keys)))
    for a in range(n):
        mine = stencil[:, a] < n_owned
        for b in range(n):
            found = np.searchsorted(keys, _pair_keys(stencil, a, b, n_local, position))
            out[:, a, b] = np.where(mine, found, -1)
    return out
