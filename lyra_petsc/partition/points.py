"""Owned and ghost points of one kind on a rank, and how several kinds share one vector.

Vertices are the kind that exists today; edges are numbered by the same code when a term needs
unknowns on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Numbering:
    """Global numbering of one kind of point on rank 0: contiguous per rank.

    Attributes
    ----------
    owner : (N,) int64
        Owning rank of each point of the mesh.
    number : (N,) int64
        New global number of each; rank r owns ``bounds[r]`` to ``bounds[r + 1]``.
    bounds : (ranks + 1,) int64
    """

    owner: Ints
    number: Ints
    bounds: Ints

    @classmethod
    def build(cls, owner: Ints, position: Ints, n_ranks: int) -> Numbering:
        """Number by owner, within an owner by ``position`` (N,), an order that keeps neighbours near."""
        order = np.lexsort((position, owner))
        number = np.empty(len(owner), dtype=np.int64)
        number[order] = np.arange(len(owner))
        bounds = np.zeros(n_ranks + 1, dtype=np.int64)
        np.cumsum(np.bincount(owner, minlength=n_ranks), out=bounds[1:])
        return cls(owner, number, bounds)


class Points:
    """Points of one kind on a rank: owned first, then ghosts (others' points that its elements touch).

    Parameters
    ----------
    comm : MPI.Comm
    bounds : (ranks + 1,) int64
        First global number of each rank's points, and N.
    ghosts : (n_ghost,) int64
        Global numbers of the ghosts, ascending.
    original : (n_owned,) int64
        Index of each owned point in the mesh (file order).
    """

    def __init__(self, comm: MPI.Comm, bounds: Ints, ghosts: Ints, original: Ints) -> None:
        self.comm, self.bounds, self.ghosts, self.original = comm, bounds, ghosts, original
        self.n_global = int(bounds[-1])
        self.start = int(bounds[comm.rank])
        self.n_owned = int(bounds[comm.rank + 1]) - self.start
        self.n_local = self.n_owned + len(ghosts)
        ranks = np.searchsorted(bounds, ghosts, side="right") - 1
        remote = np.column_stack([ranks, ghosts - bounds[ranks]]).astype(PETSc.IntType)
        self._forest = PETSc.SF().create(comm)
        self._forest.setGraph(self.n_owned, None, remote)
        types = {np.dtype(np.float64): MPI.DOUBLE, np.dtype(np.float32): MPI.FLOAT}
        self._triples = {kind: unit.Create_contiguous(3).Commit() for kind, unit in types.items()}

    @property
    def global_number(self) -> Ints:
        """Global number of each local point, (n_local,)."""
        owned = np.arange(self.start, self.start + self.n_owned, dtype=np.int64)
        return np.concatenate([owned, self.ghosts])

    def update_ghosts(self, values: NDArray[np.float64] | NDArray[np.float32]) -> None:
        """Copy the owners' rows of ``values`` (n_local, 3) into the ghost rows; collective."""
        if self.comm.size == 1:
            return
        owned, ghosts = values[: self.n_owned], values[self.n_owned :]
        triple = self._triples[values.dtype]
        self._forest.bcastBegin(triple, owned, ghosts, MPI.REPLACE)
        self._forest.bcastEnd(triple, owned, ghosts, MPI.REPLACE)

    def add_to_owners(self, values: NDArray[np.float64] | NDArray[np.float32]) -> None:
        """Add the ghost rows of ``values`` (n_local, 3) to the owners' rows; collective."""
        if self.comm.size == 1:
            return
        wide = values.astype(np.float64)  # PETSc has no sums of single precision
        owned, ghosts = wide[: self.n_owned], wide[self.n_owned :]
        triple = self._triples[wide.dtype]
        self._forest.reduceBegin(triple, ghosts, owned, MPI.SUM)
        self._forest.reduceEnd(triple, ghosts, owned, MPI.SUM)
        values[: self.n_owned] = owned

    def summed(self, *numbers: float) -> NDArray[np.float64]:
        """Sums over all ranks of each rank's numbers; collective."""
        sums = np.array(numbers)
        if self.comm.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, sums)
        return sums

    def destroy(self) -> None:
        """Free the communication objects; collective."""
        self._forest.destroy()
        for triple in self._triples.values():
            triple.Free()


class Layout:
    """Where the unknowns of several kinds of points stand in one global vector.

    On every rank the unknowns of the first kind come first, then those of the second, and so on.

    Parameters
    ----------
    fields : sequence of (bounds, components)
        The ``bounds`` (ranks + 1,) of each kind's numbering and its unknowns per point.
    """

    def __init__(self, fields: Sequence[tuple[Ints, int]]) -> None:
        self._fields = [(np.asarray(bounds), components) for bounds, components in fields]
        sizes = np.sum([np.diff(bounds) * components for bounds, components in self._fields], axis=0)
        self.bounds = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)

    def unknowns(self, kind: int, points: Ints) -> Ints:
        """Global unknowns (n, components) of points of a kind given by their global numbers (n,)."""
        bounds, components = self._fields[kind]
        rank = np.searchsorted(bounds, points, side="right") - 1
        before = np.zeros(len(self.bounds) - 1, dtype=np.int64)
        for earlier, count in self._fields[:kind]:
            before += np.diff(earlier) * count
        first = self.bounds[rank] + before[rank] + (points - bounds[rank]) * components
        return np.asarray(first[:, None] + np.arange(components))
