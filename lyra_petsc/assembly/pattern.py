"""Block sparsity from the stencils of the active terms, and where each element block goes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Offsets = NDArray[np.int32]


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
    offsets : dict of name → (E, n, n) int32
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
        keys = np.unique(
            np.concatenate(
                [diagonal_keys, *(_keys(s, n_owned, n_local, position) for s in stencils.values())]
            )
        )
        rows, places = np.divmod(keys, max(n_local, 1))
        self.columns: Ints = order[places]
        self.indptr: Ints = np.zeros(n_owned + 1, dtype=np.int64)
        np.cumsum(np.bincount(rows, minlength=n_owned), out=self.indptr[1:])
        self.diagonal: Ints = np.searchsorted(keys, diagonal_keys)
        self.offsets: dict[str, Offsets] = {
            name: _offsets(s, keys, n_owned, n_local, position) for name, s in stencils.items()
        }

    @property
    def n_blocks(self) -> int:
        return len(self.columns)


def _pair_keys(stencil: NDArray[np.int32], a: int, b: int, n_local: int, position: Ints) -> Ints:
    key: Ints = stencil[:, a].astype(np.int64) * n_local + position[stencil[:, b]]
    return key


def _keys(stencil: NDArray[np.int32], n_owned: int, n_local: int, position: Ints) -> Ints:
    """Sorted keys row · n_local + column place of the couplings in owned rows, each once."""
    n = stencil.shape[1]
    parts = []
    for a in range(n):
        mine = stencil[stencil[:, a] < n_owned]
        parts += [_pair_keys(mine, a, b, n_local, position) for b in range(n)]
    return np.unique(np.concatenate(parts))


def _offsets(stencil: NDArray[np.int32], keys: Ints, n_owned: int, n_local: int, position: Ints) -> Offsets:
    n = stencil.shape[1]
    out = np.empty((len(stencil), n, n), dtype=np.int32)
    for a in range(n):
        mine = stencil[:, a] < n_owned
        for b in range(n):
            found = np.searchsorted(keys, _pair_keys(stencil, a, b, n_local, position))
            out[:, a, b] = np.where(mine, found, -1)
    return out
