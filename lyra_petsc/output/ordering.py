"""Redistribution of rows between their owners and slabs in the order of the mesh file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import ArrayLike, NDArray

from lyra_petsc.arrays import Ints


class FileOrder:
    """Communication plan between rows in the owners' numbering and contiguous slabs in file order.

    Rank r of P has the slab ``[r N // P, (r + 1) N // P)`` of the N rows of a file. Each
    direction is one ``Alltoallv``; no rank ever holds more than its rows and its slab.

    Parameters
    ----------
    comm : MPI.Comm
        All ranks that own rows or write; construction is collective.
    original : (n_owned,) int
        Row number in the file of each row this rank owns, in any order; may be empty. Each of
        ``0 … n_global − 1`` occurs on exactly one rank, once.
    n_global : int
        N, the number of rows in the file.
    """

    def __init__(self, comm: MPI.Comm, original: ArrayLike, n_global: int) -> None:
        rows = np.asarray(original, dtype=np.int64).reshape(-1)
        self.comm = comm
        self.n_global = int(n_global)
        self.starts: Ints = np.arange(comm.size + 1, dtype=np.int64) * self.n_global // comm.size

        self._outgoing: Ints = np.argsort(rows, kind="stable")
        ordered = rows[self._outgoing]
        self._to_ranks = np.diff(np.searchsorted(ordered, self.starts)).astype(np.int32)
        self._from_ranks = np.empty_like(self._to_ranks)
        comm.Alltoall(self._to_ranks, self._from_ranks)
        self._incoming: Ints = self._exchange(ordered, self._to_ranks, self._from_ranks) - self.start

    @property
    def start(self) -> int:
        """First file row of this rank's slab."""
        return int(self.starts[self.comm.rank])

    @property
    def n_slab(self) -> int:
        """Number of file rows in this rank's slab."""
        return int(self.starts[self.comm.rank + 1]) - self.start

    def to_slab(self, rows: NDArray[Any]) -> NDArray[Any]:
        """This rank's slab of the file, from rows in the owners' numbering. Collective.

        Parameters
        ----------
        rows : (n_owned, ...) array
            Any type and trailing shape, the same on all ranks.

        Returns
        -------
        (n_slab, ...) array
        """
        arrived = self._exchange(np.take(rows, self._outgoing, axis=0), self._to_ranks, self._from_ranks)
        if self.comm.size == 1:  # rows of a single rank arrive in file order
            return arrived
        slab = np.empty_like(arrived)
        slab[self._incoming] = arrived
        return slab

    def from_slab(self, slab: NDArray[Any]) -> NDArray[Any]:
        """The rows this rank owns, in its numbering, from the slabs of the file. Collective.

        Parameters
        ----------
        slab : (n_slab, ...) array
            Any type and trailing shape, the same on all ranks.

        Returns
        -------
        (n_owned, ...) array
        """
        arrived = self._exchange(slab[self._incoming], self._from_ranks, self._to_ranks)
        rows = np.empty_like(arrived)
        rows[self._outgoing] = arrived
        return rows

    def look_up(self, rows: NDArray[Any], numbers: Ints) -> NDArray[Any]:
        """Values of any rows of the file, also of rows that other ranks own. Collective.

        Parameters
        ----------
        rows : (n_owned, ...) array
            Values of the rows that this rank owns, in its numbering.
        numbers : (n,) int64
            Row numbers in the file.

        Returns
        -------
        (n, ...) array
        """
        slab = self.to_slab(rows)
        holder = np.searchsorted(self.starts, numbers, side="right") - 1
        by_rank = [np.flatnonzero(holder == rank) for rank in range(self.comm.size)]
        requests = self.comm.alltoall([numbers[at] - self.starts[rank] for rank, at in enumerate(by_rank)])
        answers = self.comm.alltoall([slab[at] for at in requests])
        values = np.empty((len(numbers), *slab.shape[1:]), dtype=slab.dtype)
        for at, answer in zip(by_rank, answers, strict=True):
            values[at] = answer
        return values

    def _exchange(
        self, rows: NDArray[Any], send: NDArray[np.int32], receive: NDArray[np.int32]
    ) -> NDArray[Any]:
        rows = np.ascontiguousarray(rows)
        if self.comm.size == 1:
            return rows
        arrived = np.empty((int(receive.sum()), *rows.shape[1:]), dtype=rows.dtype)
        with row_type(rows) as kind:
            self.comm.Alltoallv(
                [rows, (send, _offsets(send)), kind], [arrived, (receive, _offsets(receive)), kind]
            )
        return arrived


def _offsets(counts: NDArray[np.int32]) -> NDArray[np.int32]:
    return np.concatenate(([0], np.cumsum(counts)[:-1])).astype(np.int32)


@contextmanager
def row_type(rows: NDArray[Any]) -> Iterator[MPI.Datatype]:
    """MPI datatype of one row of an array; counts of rows, unlike counts of bytes, fit 32 bits."""
    width = rows.dtype.itemsize * int(np.prod(rows.shape[1:], dtype=np.int64))
    kind = MPI.BYTE.Create_contiguous(width).Commit()
    try:
        yield kind
    finally:
        kind.Free()
