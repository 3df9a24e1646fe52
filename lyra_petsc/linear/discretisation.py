"""Which rows a rank knows and which of them the matrix couples: made anew as stencils change.

Terms with fixed stencils give a pattern once. Terms whose stencils change (``Registration.neighbours``) look
for their elements anew when a vertex has moved by more than half their skin; points of other ranks that they
need become further ghosts, after the present ones, so that what fixed stencils refer to stays where it is.
The pattern behind follows when a matrix is wanted (`Discretisation.renew_pattern`). Code that keeps arrays of
n_local rows or of n_blocks blocks compares them with ``layout`` and ``rows``.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.points import Layout
from lyra_petsc.terms.term import Coupling, Elastic, Term

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class Discretisation:
    """Local rows and block rows of a scene on a rank.

    Parameters
    ----------
    layout : Layout
        With the ghosts that fixed stencils need.
    terms : iterable of Term
        Those whose Hessians are in the matrix.

    Attributes
    ----------
    layout : Layout
        With the ghosts that all stencils need.
    fixed, rows : BlockRows
        Of the couplings by fixed stencils, and of all; one and the same where stencils do not change.
    place : (n,) int64 or None
        Where the blocks of ``fixed`` stand among those of ``rows``; None: they are the same.
    """

    def __init__(self, layout: Layout, terms: Iterable[Term]) -> None:
        self._fixed_layout = self.layout = layout
        self._changing: list[Elastic] = []
        couplings: dict[str, Coupling] = {}
        for term in terms:
            if isinstance(term, Elastic) and term.registration.neighbours:
                self._changing.append(term)
            else:
                couplings |= term.couplings
        self.fixed = BlockRows(BlockPattern(couplings, layout.n_owned, layout.n_local))
        self.rows = self.fixed
        self.place: Ints | None = None
        self._current = True
        self._searched: Array | None = None

    @property
    def changes(self) -> bool:
        """Whether any stencils depend on the positions."""
        return bool(self._changing)

    def follow(self, x: Array) -> bool:
        """Let stencils be those at positions x (n_owned, 3) [m]; whether ghosts are others; collective."""
        layout = self.layout
        comm, here = layout.comm, x[: layout.n_vertices]
        if not self._changing or not self._moved(here):
            return False
        self._searched = here.copy()
        numbers, positions = self._near(here, max(term.search_distance for term in self._changing))
        candidates = np.concatenate([layout.start + np.arange(len(here)), numbers])
        points = np.concatenate([here, positions])
        found = []
        for term in self._changing:
            stencil = np.asarray(term.neighbours(points, candidates))
            found.append(candidates[stencil[(stencil < len(here)).any(axis=1)]])
        every = np.unique(np.concatenate([stencil.ravel() for stencil in found]))
        end = layout.start + layout.n_owned
        more = np.setdiff1d(every[(every < layout.start) | (every >= end)], self._fixed_layout.ghosts)
        present = layout.ghosts[len(self._fixed_layout.ghosts) :]
        others = bool(comm.allreduce(int(not np.array_equal(more, present)), MPI.MAX))
        if others:
            if layout is not self._fixed_layout:
                layout.destroy()
            self.layout = layout = self._fixed_layout.with_ghosts(more)
        changed = others
        for term, stencil in zip(self._changing, found, strict=True):
            elements = self._elements(stencil)
            changed |= not np.array_equal(elements.stencil, term.stencil)
            term.take(elements)
        self._current &= not comm.allreduce(int(changed), MPI.MAX)
        return others

    def _moved(self, here: Array) -> bool:
        """Whether points may be near that were not when stencils were looked for; collective."""
        if self._searched is None:
            return True
        way = here - self._searched
        farthest = float(np.einsum("ij,ij->i", way, way).max(initial=0.0))
        farthest = self.layout.comm.allreduce(farthest, MPI.MAX)
        return not np.sqrt(farthest) <= 0.5 * min(term.skin for term in self._changing)

    def _near(self, here: Array, distance: float) -> tuple[Ints, Array]:
        """Global numbers (n,) and positions (n, 3) of others' vertices near this rank's box; collective."""
        layout = self.layout
        comm = layout.comm
        if comm.size == 1:
            return np.empty(0, dtype=np.int64), np.empty((0, 3))
        box = np.array([here.min(axis=0, initial=np.inf), here.max(axis=0, initial=-np.inf)])
        boxes = np.empty((comm.size, 2, 3))
        comm.Allgather(box, boxes)
        sent: list[tuple[Ints, Array] | None] = []
        for rank, (low, high) in enumerate(boxes):
            inside = ((here >= low - distance) & (here <= high + distance)).all(axis=1)
            near = np.flatnonzero(inside) if rank != comm.rank else np.empty(0, dtype=np.int64)
            sent.append((layout.start + near, here[near]) if len(near) else None)
        received = [part for part in comm.alltoall(sent) if part is not None]
        numbers = [np.empty(0, dtype=np.int64), *(part[0] for part in received)]
        positions = [np.empty((0, 3)), *(part[1] for part in received)]
        return np.concatenate(numbers), np.concatenate(positions)

    def _elements(self, stencil: Ints) -> Elements:
        """Elements of rows given by global numbers (E, n), in local numbers; counted ones come first."""
        layout = self.layout
        first = stencil[:, 0]
        counted = (first >= layout.start) & (first < layout.start + layout.n_owned)
        # one order of the elements on any search, so that the same elements are the same stencil
        order = np.lexsort((*stencil.T[::-1], ~counted))
        local = layout.local(stencil[order].ravel()).reshape(stencil.shape).astype(np.int32)
        return Elements(local, {}, int(counted.sum()))

    def renew_pattern(self) -> bool:
        """Let ``rows`` have the blocks of the present stencils; whether they are others than before."""
        if self._current:
            return False
        couplings: dict[str, Coupling] = {}
        for term in self._changing:
            couplings |= term.couplings
        pattern, self.place = self.fixed.pattern.extended(couplings, self.layout.n_local)
        self.rows = BlockRows(pattern)
        self._current = True
        return True

    def destroy(self) -> None:
        """Free the communication objects; collective."""
        if self.layout is not self._fixed_layout:
            self.layout.destroy()
        self._fixed_layout.destroy()
