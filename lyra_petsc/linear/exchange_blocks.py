"""Sums of blocks that several ranks add to: what a rank has for rows of others goes to their owners."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import cached

STRAIGHT, TURNED, BOTH = 0, 1, 2
"""How a block goes out: as it is, transposed, or their sum (half of a diagonal block)."""


@cached()
def _pack(blocks, source, how, out):  # type: ignore[no-untyped-def]
    """out (n, 9) = the blocks (m, 9) that go out."""
    for k in range(len(source)):
        for i in range(3):
            for j in range(3):
                straight, turned = blocks[source[k], 3 * i + j], blocks[source[k], 3 * j + i]
                if how[k] == STRAIGHT:
                    out[k, 3 * i + j] = straight
                elif how[k] == TURNED:
                    out[k, 3 * i + j] = turned
                else:
                    out[k, 3 * i + j] = straight + turned


@cached()
def _add(received, target, out):  # type: ignore[no-untyped-def]
    """out[target] += received (n, 9)."""
    for k in range(len(target)):
        for i in range(9):
            out[target[k], i] += received[k, i]


class SharedBlocks:
    """The exchange of blocks of rows with their owners, each rank with itself too; collective.

    Parameters
    ----------
    comm : MPI.Comm
    bounds : (ranks + 1,)
        First global row of each rank.
    pairs : (m, 2)
        Global row and column of each block that this rank has beside its own rows.
    symmetric : (m,) bool
        Whether a block stands for its transpose in the column's row as well; row ≤ column then where one
        rank owns both.

    Attributes
    ----------
    rows, columns : (n,)
        Global numbers of the blocks that come in; among owned points row ≤ column.
    """

    def __init__(self, comm: MPI.Comm, bounds: Ints, pairs: Ints, symmetric: NDArray[np.bool_]) -> None:
        self._comm = comm
        row, column = pairs.T
        owner, other = (np.searchsorted(bounds, side, side="right") - 1 for side in (row, column))
        number = np.arange(len(pairs))
        goes = symmetric | (owner != other) | (row <= column)  # the other half comes from elsewhere
        back = symmetric & (owner != other)
        source = np.concatenate([number[goes], number[back]])
        there = np.where(symmetric & (row == column), BOTH, STRAIGHT)[goes]
        how = np.concatenate([there, np.full(int(back.sum()), TURNED)])
        rows, columns = np.concatenate([row[goes], column[back]]), np.concatenate([column[goes], row[back]])
        to = np.concatenate([owner[goes], other[back]])
        order = np.argsort(to, kind="stable")
        self._source, self._how = source[order], how[order].astype(np.int8)
        out = np.bincount(to, minlength=comm.size)
        ends = np.cumsum(out)[:-1]
        sent = zip(np.split(rows[order], ends), np.split(columns[order], ends), strict=True)
        came = comm.alltoall(list(sent)) if comm.size > 1 else list(sent)
        self.rows: Ints = np.concatenate([part[0] for part in came])
        self.columns: Ints = np.concatenate([part[1] for part in came])
        self._counts = 9 * out, 9 * np.array([len(part[0]) for part in came])
        self._target = np.zeros(0, dtype=np.int64)

    def into(self, target: Ints) -> None:
        """Set where each received block is to be added; frees ``rows`` and ``columns``."""
        self._target = target
        self.rows = self.columns = np.empty(0, dtype=np.int64)

    def add(self, blocks: Array, out: Array) -> None:
        """Add what all ranks have in blocks (m, 9) to the owners' out (n_blocks, 9); collective."""
        if self._comm.size == 1:
            return
        send, received = np.empty((len(self._source), 9)), np.empty((len(self._target), 9))
        _pack(blocks, self._source, self._how, send)
        out_counts, in_counts = self._counts
        self._comm.Alltoallv([send, out_counts], [received, in_counts])
        _add(received, self._target, out)
