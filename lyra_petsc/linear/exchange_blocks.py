"""Sums of blocks over ranks: contributions to rows of other ranks are sent to their owners."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import cached


@cached()
def _pack(blocks, source, straight, transposed, out):  # type: ignore[no-untyped-def]
    """Send buffer out (n, 9) from blocks (m, 9): each as it is, transposed, or the sum of both.

    The sum is for diagonal blocks, of which one half is stored.
    """
    for k in range(len(source)):
        for i in range(3):
            for j in range(3):
                entry = blocks[source[k], 3 * i + j] if straight[k] else 0.0
                if transposed[k]:
                    entry += blocks[source[k], 3 * j + i]
                out[k, 3 * i + j] = entry


@cached()
def _add(received, target, out):  # type: ignore[no-untyped-def]
    """out[target] += received (n, 9)."""
    for k in range(len(target)):
        for i in range(9):
            out[target[k], i] += received[k, i]


class SharedBlocks:
    """Sends blocks to the owners of their rows, also from each rank to itself; collective.

    Parameters
    ----------
    comm : MPI.Comm
    bounds : (ranks + 1,)
        First global row of each rank.
    pairs : (m, 2)
        Global row and column of each block of this rank outside its own rows.
    symmetric : (m,) bool
        Whether a block also represents its transpose, in the column's row; then row ≤ column if one rank
        owns both.

    Attributes
    ----------
    rows, columns : (n,)
        Global numbers of the blocks that are received; among owned points row ≤ column.
    """

    def __init__(self, comm: MPI.Comm, bounds: Ints, pairs: Ints, symmetric: NDArray[np.bool_]) -> None:
        self._comm = comm
        row, column = pairs.T
        owner, other = (np.searchsorted(bounds, side, side="right") - 1 for side in (row, column))
        number = np.arange(len(pairs))
        direct = symmetric | (owner != other) | (row <= column)  # another block provides the other half
        mirrored = symmetric & (owner != other)
        source = np.concatenate([number[direct], number[mirrored]])
        is_mirror = np.arange(len(source)) >= np.count_nonzero(direct)
        is_both = (symmetric & (row == column))[source] & ~is_mirror
        rows = np.concatenate([row[direct], column[mirrored]])
        columns = np.concatenate([column[direct], row[mirrored]])
        to = np.concatenate([owner[direct], other[mirrored]])
        order = np.argsort(to, kind="stable")
        self._source, self._straight = source[order], ~is_mirror[order]
        self._transposed = (is_mirror | is_both)[order]
        out = np.bincount(to, minlength=comm.size)
        ends = np.cumsum(out)[:-1]
        sent = zip(np.split(rows[order], ends), np.split(columns[order], ends), strict=True)
        received = comm.alltoall(list(sent)) if comm.size > 1 else list(sent)
        self.rows: Ints = np.concatenate([part[0] for part in received])
        self.columns: Ints = np.concatenate([part[1] for part in received])
        self._counts = 9 * out, 9 * np.array([len(part[0]) for part in received])
        self._target = np.zeros(0, dtype=np.int64)

    def set_targets(self, target: Ints) -> None:
        """Set the block that each received block is added to; frees ``rows`` and ``columns``."""
        self._target = target
        self.rows = self.columns = np.empty(0, dtype=np.int64)

    def add(self, blocks: Array, out: Array) -> None:
        """Add all ranks' blocks (m, 9) to ``out`` (n_blocks, 9) of their owners; collective."""
        if self._comm.size == 1:
            return
        send, received = np.empty((len(self._source), 9)), np.empty((len(self._target), 9))
        _pack(blocks, self._source, self._straight, self._transposed, send)
        out_counts, in_counts = self._counts
        self._comm.Alltoallv([send, out_counts], [received, in_counts])
        _add(received, self._target, out)
