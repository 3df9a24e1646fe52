"""Block sparsity from the stencils of the active terms, and where each element block goes."""

from __future__ import annotations

from collections.abc import Mapping

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
        position = np.empty(n_local, dtype=np.int64)
        order = np.argsort(global_number)
        position[order] = np.arange(n_local)
        own = np.arange(n_owned, dtype=np.int64)
        diagonal_keys = own * n_local + position[own]
        keys = np.sort(diagonal_keys)
        for stencil in stencils.values():
            for a in range(stencil.shape[1]):  # one after the other: all couplings at once take much memory
                keys = _union(keys, *_row_keys(stencil, a, n_owned, n_local, position))
        rows, places = np.divmod(keys, max(n_local, 1))
        self._set(rows, order[places], n_owned)
        self.diagonal: Ints = np.searchsorted(keys, diagonal_keys)
        self.offsets: dict[str, Offsets] = {
            name: _offsets(s, keys, n_owned, n_local, position) for name, s in stencils.items()
        }

    @classmethod
    def of_rows(cls, rows: Ints, columns: Ints, diagonal: Ints, n_owned: int) -> BlockPattern:
        """The pattern with blocks (rows, columns), in their order, which no elements add to."""
        made = cls.__new__(cls)
        made._set(rows, columns, n_owned)
        made.diagonal, made.offsets = diagonal, {}
        return made

    def _set(self, rows: Ints, columns: Ints, n_owned: int) -> None:
        self.columns: Ints = columns
        self.indptr: Ints = np.zeros(n_owned + 1, dtype=np.int64)
        np.cumsum(np.bincount(rows, minlength=n_owned), out=self.indptr[1:])

    @property
    def n_blocks(self) -> int:
        return len(self.columns)


def _pair_keys(stencil: NDArray[np.int32], a: int, b: int, n_local: int, position: Ints) -> Ints:
    key: Ints = stencil[:, a].astype(np.int64) * n_local + position[stencil[:, b]]
    return key


def _row_keys(stencil: NDArray[np.int32], a: int, n_owned: int, n_local: int, position: Ints) -> list[Ints]:
    """Keys row · n_local + column place of the couplings of each element's vertex a, where that is owned."""
    mine = stencil[stencil[:, a] < n_owned]
    return [_pair_keys(mine, a, b, n_local, position) for b in range(stencil.shape[1])]


def _union(*parts: Ints) -> Ints:
    """All numbers, ascending, each once; as ``np.unique``, with one copy less."""
    numbers = np.concatenate(parts)
    numbers.sort()
    return numbers[np.concatenate([[True], numbers[1:] != numbers[:-1]])] if len(numbers) else numbers


def _offsets(stencil: NDArray[np.int32], keys: Ints, n_owned: int, n_local: int, position: Ints) -> Offsets:
    n = stencil.shape[1]
    kind = np.dtype("int32" if len(keys) <= LARGEST_INT32 else "int64")
    out: Offsets = np.empty((len(stencil), n, n), dtype=kind)
    for a in range(n):
        mine = stencil[:, a] < n_owned
        for b in range(n):
            found = np.searchsorted(keys, _pair_keys(stencil, a, b, n_local, position))
            out[:, a, b] = np.where(mine, found, -1)
    return out
