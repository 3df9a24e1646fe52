"""Redistribution of rows between their owners and slabs in the order of the mesh file."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import ArrayLike, NDArray
from petsc4py import PETSc

from lyra_petsc.arrays import Ints


class FileOrder:
    """Communication plan between rows in the owners' numbering and contiguous slabs in file order.

    Rank r of P has the slab ``[r N // P, (r + 1) N // P)`` of the N rows of a file. No rank ever holds more
    than its rows and its slab.

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
        self.comm = comm
        self.n_global = int(n_global)
        self.starts: Ints = np.arange(comm.size + 1, dtype=np.int64) * self.n_global // comm.size
        self._n_owned = np.size(original)
        self._plan = self._plan_for(np.asarray(original, dtype=np.int64).reshape(-1))

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
        rows = np.ascontiguousarray(rows)
        slab = np.empty((self.n_slab, *rows.shape[1:]), rows.dtype)
        kind = _row_type(rows)
        self._plan.reduceBegin(kind, rows, slab, MPI.REPLACE)
        self._plan.reduceEnd(kind, rows, slab, MPI.REPLACE)
        kind.Free()
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
        return _fetch(self._plan, slab, self._n_owned)

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
        return _fetch(self._plan_for(numbers), self.to_slab(rows), len(numbers))

    def _plan_for(self, numbers: Ints) -> PETSc.SF:
        """Plan for an array whose rows are these rows of the file."""
        holder = np.searchsorted(self.starts, numbers, side="right") - 1
        places = np.column_stack([holder, numbers - self.starts[holder]])
        plan = PETSc.SF().create(self.comm)
        plan.setGraph(self.n_slab, None, np.ascontiguousarray(places, dtype=PETSc.IntType))
        plan.setUp()
        return plan


def _fetch(plan: PETSc.SF, slab: NDArray[Any], n: int) -> NDArray[Any]:
    slab = np.ascontiguousarray(slab)
    rows = np.empty((n, *slab.shape[1:]), slab.dtype)
    kind = _row_type(slab)
    plan.bcastBegin(kind, slab, rows, MPI.REPLACE)
    plan.bcastEnd(kind, slab, rows, MPI.REPLACE)
    kind.Free()
    return rows


def _row_type(rows: NDArray[Any]) -> MPI.Datatype:
    """MPI datatype of one row of an array."""
    return MPI.BYTE.Create_contiguous(rows.itemsize * int(np.prod(rows.shape[1:], dtype=np.int64))).Commit()
