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
        self._current = not self._changing  # their offsets are not in the fixed pattern
        self._searched: Array | None = None

    @property
    def changes(self) -> bool:
        """Whether any stencils depend on the positions."""
        return bool(self._changing)

    def follow(self, x: Array) -> bool:
        """Let stencils be those at positions x (n_local, 3) [m]; whether ghosts are others; collective."""
        layout = self.layout
        comm, here = layout.comm, x[: layout.n_vertices]
        if not self._changing:
            return False
        moved = self._moved(here) or any([term.stale for term in self._changing])
        if not comm.allreduce(int(moved), MPI.MAX):
            return False
        self._searched = here.copy()
        found = [self._search(term, x) for term in self._changing]
        every = np.unique(np.concatenate([stencil.ravel() for stencil, _ in found]))
        end = layout.start + layout.n_owned
        more = np.setdiff1d(every[(every < layout.start) | (every >= end)], self._fixed_layout.ghosts)
        present = layout.ghosts[len(self._fixed_layout.ghosts) :]
        others = bool(comm.allreduce(int(not np.array_equal(more, present)), MPI.MAX))
        if others:
            if layout is not self._fixed_layout:
                layout.destroy()
            self.layout = layout = self._fixed_layout.with_ghosts(more)
        changed = others
        for term, (stencil, what) in zip(self._changing, found, strict=True):
            elements = self._elements(stencil, what)
            changed |= not np.array_equal(elements.stencil, term.stencil)
            term.take(elements)
        self._current &= not comm.allreduce(int(changed), MPI.MAX)
        return others

    @property
    def guards(self) -> bool:
        """Whether ways must be looked at before they are gone: a term has to see who meets there."""
        return any(np.isfinite(term.unseen) for term in self._changing)

    def largest_step(self, x: Array, way: Array) -> float:
        """Fraction, up to 1, of the way (n_owned, 3) [m] from x that this rank's vertices may go until
        stencils are looked for again.
        """
        if not self.guards or self._searched is None:
            return 1.0
        n = self.layout.n_vertices
        reach = 0.5 * min(term.unseen for term in self._changing)
        gone, way = x[:n] - self._searched, way[:n]
        # |gone + f way| = reach
        square, mixed = np.einsum("ij,ij->i", way, way), np.einsum("ij,ij->i", gone, way)
        left = np.maximum(reach**2 - np.einsum("ij,ij->i", gone, gone), 0.0)
        root = np.sqrt(mixed**2 + square * left)
        with np.errstate(divide="ignore", invalid="ignore"):
            fraction = np.where(mixed > 0.0, left / (mixed + root), (root - mixed) / square)
        return float(np.nanmin(np.where(square > 0.0, fraction, 1.0), initial=1.0))

    def _search(self, term: Elastic, x: Array) -> tuple[Ints, Ints]:
        """Stencils (E, n) in global numbers, and what goes with them (E, m), that touch owned vertices;
        collective.
        """
        layout, n = self.layout, self.layout.n_vertices
        own, here = layout.start + np.arange(n), x[:n]
        triangles = np.empty((0, 3), dtype=np.int64)
        if term.surface is None:
            numbers, positions = self._with_near(own, here[:, None], term.search_distance, own >= 0)
            points = positions[:, 0]
        else:
            corners, places = layout.global_number[term.surface], x[term.surface]
            mine = term.surface[:, 0] < layout.n_owned  # each triangle is sent once
            # who meets a triangle that reaches out to a ghost counts for its owned vertices, too
            corners, places = self._with_near(corners, places, term.search_distance, mine)
            _, first = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
            corners, places = corners[np.sort(first)], places[np.sort(first)]
            others, first = np.unique(corners, return_index=True)
            more = ~np.isin(others, own)
            numbers = np.concatenate([own, others[more]])
            points = np.concatenate([here, places.reshape(-1, 3)[first[more]]])
            order = np.argsort(numbers)
            triangles = order[np.searchsorted(numbers, corners, sorter=order)]
        stencil, what = term.neighbours(points, numbers, triangles)
        touching = (stencil < n).any(axis=1)
        return numbers[stencil[touching]], what[touching]

    def _moved(self, here: Array) -> bool:
        """Whether points of this rank may be near that were not when stencils were looked for."""
        if self._searched is None:
            return True
        way = here - self._searched
        farthest = float(np.einsum("ij,ij->i", way, way).max(initial=0.0))
        return not np.sqrt(farthest) <= 0.5 * min(term.skin for term in self._changing)

    def _with_near(
        self, numbers: Ints, places: Array, distance: float, mine: NDArray[np.bool_]
    ) -> tuple[Ints, Array]:
        """This rank's vertices or triangles and those of others that are near its box; collective.

        Parameters
        ----------
        numbers, places : (n, …), (n, m, 3)
            Global numbers of their points, and where these are [m].
        distance : float [m]
        mine : (n,)
            Which of them this rank sends.
        """
        comm = self.layout.comm
        if comm.size == 1:
            return numbers, places
        low, high = places.min(axis=1), places.max(axis=1)
        box = np.array([low.min(axis=0, initial=np.inf), high.max(axis=0, initial=-np.inf)])
        boxes = np.empty((comm.size, 2, 3))
        comm.Allgather(box, boxes)
        sent: list[tuple[Ints, Array] | None] = []
        for rank, (least, most) in enumerate(boxes):
            near = mine & ((low <= most + distance) & (high >= least - distance)).all(axis=1)
            sent.append((numbers[near], places[near]) if rank != comm.rank and near.any() else None)
        received = [part for part in comm.alltoall(sent) if part is not None]
        return (
            np.concatenate([numbers, *(part[0] for part in received)]),
            np.concatenate([places, *(part[1] for part in received)]),
        )

    def _elements(self, stencil: Ints, what: Ints) -> Elements:
        """Elements of rows given by global numbers (E, n), and what goes with them (E, m), in local numbers;
        counted ones come first.
        """
        layout = self.layout
        first = stencil[:, 0]
        counted = (first >= layout.start) & (first < layout.start + layout.n_owned)
        # one order of the elements on any search, so that the same elements are the same stencil
        order = np.lexsort((*what.T[::-1], *stencil.T[::-1], ~counted))
        local = layout.local(stencil[order].ravel()).reshape(stencil.shape).astype(np.int32)
        return Elements(
            local,
            {"what": what[order].astype(np.float64), "number": stencil[order].astype(np.float64)},
            int(counted.sum()),
        )

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
