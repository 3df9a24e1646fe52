"""Which rows a rank knows and which of them the matrix couples: made anew as stencils change.

Terms with fixed stencils give a pattern once. Terms whose stencils change (``Registration.neighbours``) look
for their elements anew when a vertex has moved by more than half their skin from the way that it was expected
to go; points of other ranks that they need become further ghosts, after the present ones, so that what fixed
stencils refer to stays where it is. The pattern behind follows when a matrix is wanted
(`Discretisation.renew_pattern`), and is kept while it has all blocks. Code that keeps arrays of n_local rows
or of n_blocks blocks compares them with ``layout`` and ``rows``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.kernels.sorting import ascending
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.pattern import BlockPattern, union
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.near import swept_boxes
from lyra_petsc.mesh.points import Layout
from lyra_petsc.terms.term import Coupling, Elastic, Term

TELLING = 6
"""Of the numbers that go with an element, how many tell it from others with its stencil."""

SHORTER = *(0.25**k for k in range(12)), 0.0
"""Parts of a way that are searched one after the other, until there are not too many elements along it."""

FEW = 0.1
"""Blocks that are of no use any longer, over all of fixed stencils, up to which they are kept."""


@cached(inline="always")
def _far(x, origin, i, square):  # type: ignore[no-untyped-def]
    """1 where point i is farther than the root of a square [m²] from its origin, or no number; else 0."""
    a, b, c = x[i, 0] - origin[i, 0], x[i, 1] - origin[i, 1], x[i, 2] - origin[i, 2]
    return 0 if a * a + b * b + c * c <= square else 1


@cached()
def _leaves(x, place, reach):  # type: ignore[no-untyped-def]
    """Whether some of x are farther than ``reach`` from a place."""
    square, far = reach * reach, 0
    for row in range(len(x)):  # without a way out, so that several are looked at together
        far |= _far(x, place, Index(row), square)
    return far != 0


@cached()
def _free_part(x, way, origin, reach):  # type: ignore[no-untyped-def]
    """Fraction, up to 1, of ways (n, 3) that points x (n, 3) go until one is ``reach`` from its origin."""
    least = 1.0
    for i in range(len(x)):
        square = mixed = gone = 0.0
        for k in range(3):
            off = x[i, k] - origin[i, k]
            square, mixed, gone = square + way[i, k] ** 2, mixed + off * way[i, k], gone + off * off
        # |gone + f way| = reach
        left = max(reach * reach - gone, 0.0)
        if square > left or 2.0 * mixed + square > left:
            root = math.sqrt(mixed * mixed + square * left)
            fraction = left / (mixed + root) if mixed > 0.0 else (root - mixed) / square
            least = min(least, fraction)
    return least


def _marked(triangles: Ints, term: Elastic) -> Ints:
    """Triangles (F, 3), with a column of what goes with each if a term has that."""
    return triangles if term.surface_marks is None else np.column_stack([triangles, term.surface_marks])


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
    near : bool
        Whether there are elements of changing stencils, on any rank.
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
        self.near = False
        self._rows_of = layout  # that ``rows`` were made for
        self._located: set[str] = set()  # terms of whose present stencils the pattern has the offsets
        self._searching = [term for term in self._changing if term.search_distance > 0.0]
        self._places: list[Array] = []  # on the way along which what is near is known
        self._at = 0  # of these, where points were last
        self._reach = 0.0  # how far from it points may be [m]
        self._searched = 1.0  # part of the way that was asked for
        self._triangles: dict[Elastic, Ints] = {}  # where a rank has them all
        self._found: dict[Elastic, tuple[Ints, Ints | Array]] = {}
        self._extra = np.empty(0, dtype=np.int64)  # keys of the blocks that ``fixed`` has not

    @property
    def changes(self) -> bool:
        """Whether any stencils depend on the positions."""
        return bool(self._changing)

    def follow(self, x: Array, ahead: Array | None = None, stops: Sequence[float] = ()) -> bool:
        """Let stencils be those at positions x (n_local, 3) [m]; whether ghosts are others; collective.

        ``ahead`` (n_local, 3) [m] is the way that points are expected to go together from there. Where it is
        that of a step, ``stops`` are the parts of it after which they are asked for.
        """
        if not self._changing:
            return False
        here = x[: self.layout.n_vertices]
        to = here if ahead is None else here + ahead[: len(here)]
        asked = self._renewed(here, to)
        if not asked:
            return False
        layout, had = self.layout, [term.n_elements for term in asked]
        if self._searching and asked[0] is self._searching[0]:
            way = np.zeros_like(x) if ahead is None else ahead
            part = self._search(x, way)
            parts = stops if stops and part == 1.0 else (part,)
            self._places = [here + part * way[: len(here)] for part in (0.0, *parts)]
            self._at = 0
            self._reach = 0.5 * min(term.skin for term in self._searching)
        for term in asked:
            if term.search_distance == 0.0:
                self._found[term] = self._sent(*term.current_elements())
        more, fixed = layout.ghosts[:0], self._fixed_layout.ghosts
        if any(len(stencil) for stencil, _ in self._found.values()):
            end = layout.start + layout.n_owned
            stencils = [stencil for stencil, _ in self._found.values()]
            beyond = [stencil[(stencil < layout.start) | (stencil >= end)] for stencil in stencils]
            more = np.setdiff1d(np.concatenate(beyond), fixed)
        lacking = len(more) > 0 and not np.isin(more, layout.ghosts[len(fixed) :]).all()
        any_here = any(len(stencil) for stencil, _ in self._found.values())
        others, self.near = (flag > 0.0 for flag in layout.largest(lacking, any_here))
        if others:
            if layout is not self._fixed_layout:
                layout.destroy()
            self.layout = layout = self._fixed_layout.with_ghosts(more)
        else:  # where nothing is near and nothing was, nothing is new
            asked = [term for term, n in zip(asked, had, strict=True) if n or len(self._found[term][0])]
        for term in self._changing if others else asked:
            elements = self._elements(*self._found[term])
            if others or not np.array_equal(elements.stencil, term.stencil):
                self._located.discard(term.name)
            term.take(elements)
        return others

    def _renewed(self, here: Array, to: Array) -> list[Elastic]:
        """Terms whose elements may be others along the way of owned vertices; collective.

        If any that search, then all that do, and they come first.
        """
        told = self.layout.largest(*(term.stale for term in self._changing))
        leaves = not (self._is_known(here, self._reach) and (to is here or self._is_known(to, self._reach)))
        if self._found and not leaves and not any(told):
            return []
        searches = leaves and bool(self._searching)
        new = [term for term, stale in zip(self._changing, told, strict=True) if stale]
        if not self._found:
            searches, new = True, self._changing
        searches |= any(term in self._searching for term in new)
        return [*(self._searching if searches else []), *(t for t in new if t not in self._searching)]

    @property
    def guards(self) -> bool:
        """Whether ways must be looked at before they are gone: a term has to see who meets there."""
        return any(np.isfinite(term.approach_limit) for term in self._changing)

    def largest_step(self, x: Array, way: Array) -> float:
        """Fraction, up to 1, of the way (n_owned, 3) [m] from x that vertices may go until stencils are
        looked for again; collective.
        """
        if not self.guards or not self._places:
            return 1.0
        n = self.layout.n_vertices
        reach = 0.5 * min(term.approach_limit for term in self._searching)
        x, way = x[:n], way[:n]
        if self._is_known(x, reach):
            for part in (1.0, self._searched) if 0.0 < self._searched < 1.0 else (1.0,):
                if self._is_known(x + part * way, reach):
                    return part
        # near several places there may be no room left at the one, and all at the other
        gone = self.layout.largest(*(_leaves(x, place, reach) for place in self._places))
        rooms = zip(gone, self._places, strict=True)
        less = self.layout.largest(
            *(-_free_part(x, way, place, reach) if not left else 0.0 for left, place in rooms)
        )
        return -min(less)

    def _is_known(self, x: Array, reach: float) -> bool:
        """Whether all owned vertices x (n, 3) are within ``reach`` [m] of one and the same place of the way
        that was searched; collective.
        """
        if not self._places:
            return False
        if not any(self.layout.largest(_leaves(x, self._places[self._at], reach))):
            return True
        left = self.layout.largest(*(_leaves(x, place, reach) for place in self._places))
        self._at = left.index(min(left))
        return not left[self._at]

    def _search(self, x: Array, way: Array) -> float:
        """Find the elements of all terms that search, along ways (n_local, 3) [m] that are shortened where
        there would be too many; to what part of them; collective.
        """
        for part in SHORTER:
            found = {term: self._near(term, x, part * way) for term in self._searching}
            if not any(self.layout.largest(any(each is None for each in found.values()))):
                break
        self._searched = part
        self._found |= {term: each for term, each in found.items() if each is not None}
        return part

    def _near(self, term: Elastic, x: Array, way: Array) -> tuple[Ints, Ints] | None:
        """Stencils (E, n) in global numbers, and what goes with them (E, m), that touch owned vertices on
        their ways (n_local, 3); None if these are too long; collective.
        """
        layout, n = self.layout, self.layout.n_vertices
        own = layout.start + np.arange(n)
        if layout.comm.size == 1 and term.surface is not None:
            if term not in self._triangles:
                self._triangles[term] = _marked(term.surface.astype(np.int64), term)
            return term.neighbours(x[:n], way[:n], own, self._triangles[term])
        distance, triangles = term.search_distance, np.empty((0, 3), dtype=np.int64)
        if term.surface is None:
            theirs, moves = self._near_others(own, np.arange(n)[:, None], x, way, distance, own >= 0)
            numbers, points, ways, moves = np.concatenate([own, theirs]), x[:n], way[:n], moves[:, 0]
        else:
            surface, place = term.surface.astype(np.int64), np.arange(layout.n_local)
            corners = _marked(layout.global_number[surface], term)
            mine = surface[:, 0] < layout.n_owned  # each triangle is sent once
            # who meets a triangle that reaches out to a ghost counts for its owned vertices, too
            corners, moves = self._near_others(corners, surface, x, way, distance, mine)
            # those that touch owned vertices are here already
            new = ((corners[:, :3] < layout.start) | (corners[:, :3] >= layout.start + n)).all(axis=1)
            corners, moves = corners[new], moves[new].reshape(-1, 2, 3)
            ghosts = np.unique(surface[surface >= n])
            place[ghosts] = n + np.arange(len(ghosts))
            numbers = np.concatenate([own, layout.global_number[ghosts]])
            others, first = np.unique(corners[:, :3], return_index=True)
            more = ~np.isin(others, numbers[n:])
            numbers = np.concatenate([numbers, others[more]])
            points, ways = (np.concatenate([each[:n], each[ghosts]]) for each in (x, way))
            moves = moves[first[more]]
            order = n + np.argsort(numbers[n:])
            at = np.minimum(np.searchsorted(numbers[order], corners[:, :3]), max(len(order) - 1, 0))
            triangles = np.concatenate(
                [_marked(place[surface], term), np.concatenate([order[at], corners[:, 3:]], axis=1)]
            )
        points, ways = np.concatenate([points, moves[:, 0]]), np.concatenate([ways, moves[:, 1]])
        found = term.neighbours(points, ways, numbers, triangles)
        if found is None:
            return None
        stencil, what = found
        touching = (stencil < n).any(axis=1)
        return numbers[stencil[touching]], what[touching]

    def _near_others(
        self, numbers: Ints, rows: Ints, x: Array, way: Array, distance: float, mine: NDArray[np.bool_]
    ) -> tuple[Ints, Array]:
        """Other ranks' vertices or triangles that are near the box of this one's; collective.

        Parameters
        ----------
        numbers, rows : (n, …), (n, m)
            Global numbers of this rank's with what goes with them, and local rows of their points.
        x, way : (n_local, 3)
            Where points are and which way they go [m].
        distance : float [m]
        mine : (n,)
            Which of them this rank sends.

        Returns
        -------
        numbers, moves : (k, …), (k, m, 2, 3)
            Of the others, with places and ways of their points.
        """
        comm = self.layout.comm
        received = [(numbers[:0], np.empty((0, rows.shape[1], 2, 3)))]
        if comm.size > 1:
            low, high = swept_boxes(x, way, rows)
            box = np.array([low.min(axis=0, initial=np.inf), high.max(axis=0, initial=-np.inf)])
            boxes = np.empty((comm.size, 2, 3))
            comm.Allgather(box, boxes)
            sent: list[tuple[Ints, Array] | None] = []
            for rank, (least, most) in enumerate(boxes):
                if rank == comm.rank:
                    sent.append(None)
                    continue
                near = mine & ((low <= most + distance) & (high >= least - distance)).all(axis=1)
                some = rows[near]
                moves = np.stack([x[some], way[some]], axis=2)
                sent.append((numbers[near], moves) if len(some) else None)
            received += [part for part in comm.alltoall(sent) if part is not None]
        return np.concatenate([part[0] for part in received]), np.concatenate([part[1] for part in received])

    def _sent(self, stencil: Ints, what: Ints | Array) -> tuple[Ints, Ints | Array]:
        """Elements by global numbers (E, n) that this rank knows, and what others know of its vertices;
        collective.
        """
        comm, bounds = self.layout.comm, self.layout.bounds
        if comm.size == 1:
            return stencil, what
        owners = np.searchsorted(bounds, stencil, side="right") - 1
        parts = [(owners == rank).any(axis=1) for rank in range(comm.size)]
        sent = [None if rank == comm.rank else (stencil[at], what[at]) for rank, at in enumerate(parts)]
        received = [part for part in comm.alltoall(sent) if part is not None]
        stencils, whats = zip((stencil, what), *received, strict=True)
        return np.concatenate(stencils), np.concatenate(whats)

    def _elements(self, stencil: Ints, what: Ints | Array) -> Elements:
        """Elements of rows given by global numbers (E, n), and what goes with them (E, m), in local numbers;
        counted ones come first.
        """
        layout = self.layout
        first = stencil[:, 0]
        counted = (first >= layout.start) & (first < layout.start + layout.n_owned)
        # one order of the elements on any search, so that the same elements are the same stencil
        parts = np.flatnonzero(counted), np.flatnonzero(~counted)
        order = np.concatenate([ascending(part, stencil, what, TELLING) for part in parts])
        if (order[1:] < order[:-1]).any():
            stencil, what = stencil[order], what[order]
        local = layout.local(stencil.ravel()).reshape(stencil.shape).astype(np.int32)
        data = {"what": what.astype(np.float64, copy=False), "number": stencil.astype(np.float64)}
        return Elements(local, data, len(parts[0]))

    def renew_pattern(self, acting: Mapping[Elastic, NDArray[np.bool_]]) -> bool:
        """Let ``rows`` have the blocks of those elements that act (E,); whether they are others than before.

        Blocks of earlier ones stay while they are `FEW`; other elements have an offset where there is one.
        Collective.
        """
        if not self._changing or (not self.near and self._rows_of is self.layout):
            return False
        n_local = self.layout.n_local
        stencils = {term.name: term.stencil for term in self._changing}
        pattern = self.rows.pattern
        fits = fits_layout = self._rows_of is self.layout  # another may have as many rows
        if fits:
            pattern.locate({name: stencil for name, stencil in stencils.items() if name not in self._located})
            self._located = set(stencils)
            acts = [term for term in self._changing if term.n_elements]
            fits = not any(pattern.lacks(term.name, acting[term]) for term in acts)
        if not any(self.layout.largest(not fits)):
            return False
        # with those of elements that do not act yet: some soon will
        soon = self.fixed.pattern.missing(stencils.values(), n_local)
        kept = self._extra if fits_layout else self._extra[:0]
        few = len(kept) <= len(soon) + FEW * self.fixed.pattern.n_blocks
        self._extra = union(kept, soon) if few else soon
        pattern, self.place = self.fixed.pattern.extended(self._extra, n_local)
        self.rows = BlockRows(pattern)
        pattern.locate(stencils)
        self._rows_of, self._located = self.layout, set(stencils)
        return True

    def destroy(self) -> None:
        """Free the communication objects; collective."""
        if self.layout is not self._fixed_layout:
            self.layout.destroy()
        self._fixed_layout.destroy()
