"""Local rows (owned and ghost) and block pattern of a rank, rebuilt when stencils change.

Fixed stencils determine the pattern once. Terms with changing stencils (``Registration.neighbours``)
search for elements again when a vertex is farther than half their skin from its expected path. Rows of
other ranks that their elements need are appended to the ghosts, so that local numbers in fixed stencils stay
valid. The pattern is updated when a matrix is assembled (`Discretisation.update_pattern`), and kept while it
has all blocks. Code that keeps arrays of n_local rows or of n_blocks blocks must compare ``layout`` and
``rows`` with those for which the arrays were made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.kernels.sorting import sort_rows
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.pattern import BlockPattern, union
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.near import swept_boxes
from lyra_petsc.mesh.points import Layout
from lyra_petsc.terms.term import Coupling, Elastic, Term

SORT_COLUMNS = 6
"""Leading attributes of an element that distinguish it from others with the same stencil."""

FRACTIONS = *(0.25**k for k in range(12)), 0.0
"""Fractions of a displacement that are tried in turn, until a search along it finds few enough elements."""

MAX_STEPS = 4
"""Largest number of steps along which a search looks while nothing is near."""

MAX_UNUSED = 0.1
"""Largest number of unused blocks that a pattern keeps, relative to the blocks of fixed stencils."""


@cached(inline="always")
def _is_beyond(x, origin, path, at, i, square):  # type: ignore[no-untyped-def]
    """1 if the distance of point i to its place on the path, squared, exceeds ``square`` [m²] or is NaN; else
    0.
    """
    a, b, c = x[i, 0] - origin[i, 0], x[i, 1] - origin[i, 1], x[i, 2] - origin[i, 2]
    a, b, c = a - at * path[i, 0], b - at * path[i, 1], c - at * path[i, 2]
    return 0 if a * a + b * b + c * c <= square else 1


@cached()
def _any_beyond(x, origin, path, at, radius):  # type: ignore[no-untyped-def]
    """Whether any point x (n, 3) is farther than ``radius`` from origin + at · path."""
    square, far = radius * radius, 0
    for row in range(len(x)):  # no early exit, so that the loop is vectorised
        far |= _is_beyond(x, origin, path, at, Index(row), square)
    return far != 0


@cached()
def _fraction_within(x, displacement, origin, radius):  # type: ignore[no-untyped-def]
    """Largest f ≤ 1 for which all x + f displacement (n, 3) are within ``radius`` of their origins."""
    smallest = 1.0
    for i in range(len(x)):
        uu = du = dd = 0.0
        for k in range(3):
            u, d = displacement[i, k], x[i, k] - origin[i, k]
            uu, du, dd = uu + u**2, du + d * u, dd + d * d
        # root f of |d + f u|² = radius²
        remaining = max(radius * radius - dd, 0.0)
        if uu > remaining or 2.0 * du + uu > remaining:
            root = math.sqrt(du * du + uu * remaining)
            smallest = min(smallest, remaining / (du + root) if du > 0.0 else (root - du) / uu)
    return smallest


def _with_marks(triangles: Ints, term: Elastic) -> Ints:
    """Triangles (F, 3), with a further column of the term's surface marks, if it has any."""
    return triangles if term.surface_marks is None else np.column_stack([triangles, term.surface_marks])


class Discretisation:
    """Local rows and block rows of a scene on a rank.

    Parameters
    ----------
    layout : Layout
        Layout with the ghosts that fixed stencils need.
    terms : iterable of Term
        Terms whose Hessians are assembled into the matrix.

    Attributes
    ----------
    layout : Layout
        Layout with the ghosts that all stencils need.
    fixed, rows : BlockRows
        Block rows of fixed stencils only, and of all stencils; the same object if stencils do not change.
    fixed_positions : (n,) int64 or None
        Index in ``rows`` of each block of ``fixed``; None if both are the same.
    has_near_elements : bool
        Whether terms with changing stencils have elements, on any rank.
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
        self.fixed_positions: Ints | None = None
        self.has_near_elements = False
        self._rows_layout = layout  # for which ``rows`` were made
        self._located: set[str] = set()  # terms whose present stencils have offsets in the pattern
        self._searching = [term for term in self._changing if term.search_distance > 0.0]
        # of the last search: positions and displacements (n, 3) [m], and over all ranks the products of both,
        # and of the displacements [m²]
        self._path: tuple[Array, Array] | None = None
        self._begin = self._square = 0.0
        self._steps = 1  # steps that were expected to lead along the path
        self._radius = 0.0  # distance [m] from the path up to which the search is valid
        self._fraction = 1.0  # of the expected displacement that was searched
        self._triangles: dict[Elastic, Ints] = {}  # all triangles, on a single rank
        self._global_elements: dict[Elastic, tuple[Ints, Ints | Array]] = {}
        self._extra_keys = np.empty(0, dtype=np.int64)  # keys of the blocks of ``rows`` that ``fixed`` lacks

    @property
    def stencils_change(self) -> bool:
        """Whether any stencils depend on the positions."""
        return bool(self._changing)

    def update_stencils(
        self, x: Array, expected: Array | None = None, ahead: Callable[[int], Array] | None = None
    ) -> bool:
        """Update the stencils for positions x (n_local, 3) [m]; returns whether ghosts changed; collective.

        ``expected`` (n_local, 3) [m] is the displacement expected from x. If it is that of a step, ``ahead``
        returns that of several steps: a search looks along these while nothing is near.
        """
        if not self._changing:
            return False
        here = x[: self.layout.n_vertices]
        to = here if expected is None else here + expected[: len(here)]
        asked = self._terms_to_update(here) if to is here else self._terms_to_update(here, to)
        if not asked:
            return False
        layout, had = self.layout, [term.n_elements for term in asked]
        if self._searching and asked[0] is self._searching[0]:
            self._search_ahead(x, np.zeros_like(x) if expected is None else expected, ahead)
        for term in asked:
            if term.search_distance == 0.0:
                self._global_elements[term] = self._exchange_elements(*term.current_elements())
        more, fixed = layout.ghosts[:0], self._fixed_layout.ghosts
        if any(len(stencil) for stencil, _ in self._global_elements.values()):
            end = layout.start + layout.n_owned
            stencils = [stencil for stencil, _ in self._global_elements.values()]
            beyond = [stencil[(stencil < layout.start) | (stencil >= end)] for stencil in stencils]
            more = np.setdiff1d(np.concatenate(beyond), fixed)
        missing = len(more) > 0 and not np.isin(more, layout.ghosts[len(fixed) :]).all()
        any_here = any(len(stencil) for stencil, _ in self._global_elements.values())
        others, self.has_near_elements = (flag > 0.0 for flag in layout.global_max(missing, any_here))
        if others:
            if layout is not self._fixed_layout:
                layout.destroy()
            self.layout = layout = self._fixed_layout.with_ghosts(more)
        else:  # terms that had no elements and have none now are up to date
            found = self._global_elements
            asked = [term for term, n in zip(asked, had, strict=True) if n or len(found[term][0])]
        for term in self._changing if others else asked:
            elements = self._local_elements(*self._global_elements[term], sort=term.search_distance > 0.0)
            if others or not np.array_equal(elements.stencil, term.stencil):
                self._located.discard(term.name)
            term.set_elements(elements)
        return others

    def _search_ahead(self, x: Array, expected: Array, ahead: Callable[[int], Array] | None) -> None:
        """Search along ``expected`` (n_local, 3), or the displacement of several steps; collective.

        Several steps are tried, one more than the last search was valid for, while nothing is near. What is
        found then may be near only after the step, or only because the guess is wrong.
        """
        here = x[: self.layout.n_vertices]
        self._radius = 0.5 * min(term.skin for term in self._searching)
        displacement, steps = expected, 1
        if ahead is not None and self._path is not None and not self.has_near_elements:
            next_steps = min(round(self._steps * self._places(here)[0]) + 1, MAX_STEPS)
            farther, to = ahead(next_steps), here + expected[: len(here)]
            self._set_path(here, farther)
            if not any(self.layout.global_max(not self._are_near_path(self._radius, to))):
                displacement, steps = farther, next_steps
        part = self._search(x, displacement)
        if steps > 1 and (part < 1.0 or self._any_found()):
            displacement, steps = expected, 0  # so that the next search tries one step
            part = self._search(x, displacement)
        self._set_path(here, part * displacement)
        self._steps = steps

    def _terms_to_update(self, *positions: Array) -> list[Elastic]:
        """Terms whose elements may change at any of these positions (n, 3) of the owned vertices; collective.

        If one term must search, all terms that search are returned, before the others.
        """
        leaves, *stale = self.layout.global_max(
            not self._are_near_path(self._radius, *positions), *(term.stale for term in self._changing)
        )
        if self._global_elements and not leaves and not any(stale):
            return []
        searches = bool(leaves and self._searching)
        new = [term for term, is_stale in zip(self._changing, stale, strict=True) if is_stale]
        if not self._global_elements:
            searches, new = True, self._changing
        searches |= any(term in self._searching for term in new)
        return [*(self._searching if searches else []), *(t for t in new if t not in self._searching)]

    @property
    def limits_motion(self) -> bool:
        """Whether displacements must be checked before points move, since a term detects collisions."""
        return any(term.detects_collisions for term in self._changing)

    def searched_fraction(self, x: Array, displacement: Array) -> float:
        """Fraction ≤ 1 of a displacement (n_owned, 3) [m] from x that the last search covers; collective."""
        if not self.limits_motion or self._path is None:
            return 1.0
        n = self.layout.n_vertices
        radius = 0.5 * min(term.approach_limit for term in self._searching)
        x, displacement = x[:n], displacement[:n]
        for part in (1.0, self._fraction) if 0.0 < self._fraction < 1.0 else (1.0,):
            near = self._are_near_path(radius, x, x + part * displacement)
            if not any(self.layout.global_max(not near)):
                return part
        # points beside the path may move farther from one of its places than from another
        places, (origin, path) = (0.0, *self._places(x), 1.0), self._path
        beyond = self.layout.global_max(*(_any_beyond(x, origin, path, at, radius) for at in places))
        fractions = [
            0.0 if far else _fraction_within(x, displacement, origin + at * path, radius)
            for far, at in zip(beyond, places, strict=True)
        ]
        return -min(self.layout.global_max(*(-fraction for fraction in fractions)))

    def _set_path(self, here: Array, displacement: Array) -> None:
        """Set the path of the owned vertices, from positions ``here`` (n, 3) [m]; collective."""
        path = displacement[: len(here)]
        self._path = here.copy(), path
        products = float(np.vdot(here, path)), float(np.vdot(path, path))
        self._begin, self._square = self.layout.global_sum(*products).tolist()

    def _places(self, *positions: Array) -> list[float]:
        """Fraction of the path of the last search to which the owned vertices are nearest, at each of several
        positions (n, 3); collective.
        """
        assert self._path is not None
        if not self._square > 0.0:
            return [0.0] * len(positions)
        along = self.layout.global_sum(*[float(np.vdot(x, self._path[1])) for x in positions]).tolist()
        return [min(max((each - self._begin) / self._square, 0.0), 1.0) for each in along]

    def _are_near_path(self, radius: float, *positions: Array) -> bool:
        """Whether this rank's vertices are within ``radius`` [m] of one place on the path, at each of several
        positions (n, 3); collective.
        """
        if self._path is None:
            return False
        origin, path = self._path
        places = zip(positions, self._places(*positions), strict=True)
        return not any([_any_beyond(x, origin, path, at, radius) for x, at in places])

    def _search(self, x: Array, displacement: Array) -> float:
        """Find the elements of all terms that search, along displacements (n_local, 3) [m]; collective.

        Displacements are shortened if there are too many elements; returns the fraction that was searched.
        """
        for part in FRACTIONS:
            found = {term: self._find_elements(term, x, part * displacement) for term in self._searching}
            if not any(self.layout.global_max(any(each is None for each in found.values()))):
                break
        self._fraction = part
        self._global_elements |= {term: each for term, each in found.items() if each is not None}
        return part

    def _any_found(self) -> bool:
        """Whether the last search found elements on any rank; collective."""
        found = any(len(self._global_elements[term][0]) for term in self._searching)
        return any(self.layout.global_max(found))

    def _find_elements(self, term: Elastic, x: Array, u: Array) -> tuple[Ints, Ints] | None:
        """Stencils (E, n) in global numbers, and attributes (E, m), of a term's elements near owned vertices.

        Vertices move by displacements u (n_local, 3) [m]; None if that yields too many elements; collective.
        """
        layout, n = self.layout, self.layout.n_vertices
        own = layout.start + np.arange(n)
        if layout.comm.size == 1 and term.surface is not None:
            if term not in self._triangles:
                self._triangles[term] = _with_marks(term.surface.astype(np.int64), term)
            return term.neighbours(x[:n], u[:n], own, self._triangles[term])
        distance, triangles = term.search_distance, np.empty((0, 3), dtype=np.int64)
        if term.surface is None:
            theirs, moves = self._gather_near(own, np.arange(n)[:, None], x, u, distance, own >= 0)
            numbers, points, point_u, moves = np.concatenate([own, theirs]), x[:n], u[:n], moves[:, 0]
        else:
            surface, number_of = term.surface.astype(np.int64), np.arange(layout.n_local)
            corners = _with_marks(layout.global_number[surface], term)
            mine = surface[:, 0] < layout.n_owned  # each triangle is sent once
            # an element of a triangle with ghost corners also acts on the triangle's owned corners
            corners, moves = self._gather_near(corners, surface, x, u, distance, mine)
            # triangles with owned corners are local already
            new = ((corners[:, :3] < layout.start) | (corners[:, :3] >= layout.start + n)).all(axis=1)
            corners, moves = corners[new], moves[new].reshape(-1, 2, 3)
            ghosts = np.unique(surface[surface >= n])
            number_of[ghosts] = n + np.arange(len(ghosts))
            numbers = np.concatenate([own, layout.global_number[ghosts]])
            others, first = np.unique(corners[:, :3], return_index=True)
            more = ~np.isin(others, numbers[n:])
            numbers = np.concatenate([numbers, others[more]])
            points, point_u = (np.concatenate([each[:n], each[ghosts]]) for each in (x, u))
            moves = moves[first[more]]
            order = n + np.argsort(numbers[n:])
            at = np.minimum(np.searchsorted(numbers[order], corners[:, :3]), max(len(order) - 1, 0))
            triangles = np.concatenate(
                [_with_marks(number_of[surface], term), np.concatenate([order[at], corners[:, 3:]], axis=1)]
            )
        points, point_u = np.concatenate([points, moves[:, 0]]), np.concatenate([point_u, moves[:, 1]])
        found = term.neighbours(points, point_u, numbers, triangles)
        if found is None:
            return None
        stencil, attributes = found
        touching = (stencil < n).any(axis=1)
        return numbers[stencil[touching]], attributes[touching]

    def _gather_near(
        self, numbers: Ints, rows: Ints, x: Array, u: Array, distance: float, mine: NDArray[np.bool_]
    ) -> tuple[Ints, Array]:
        """Vertices or triangles of other ranks near the bounding box of those of this rank; collective.

        Parameters
        ----------
        numbers, rows : (n, …), (n, m)
            Global numbers of the vertices or triangles with their marks, and local rows of their points.
        x, u : (n_local, 3)
            Positions and displacements [m].
        distance : float [m]
        mine : (n,)
            Which of them this rank sends.

        Returns
        -------
        numbers, moves : (k, …), (k, m, 2, 3)
            The received ones; ``moves`` holds position and displacement of each point.
        """
        comm = self.layout.comm
        received = [(numbers[:0], np.empty((0, rows.shape[1], 2, 3)))]
        if comm.size > 1:
            low, high = swept_boxes(x, u, rows)
            box = np.array([low.min(axis=0, initial=np.inf), high.max(axis=0, initial=-np.inf)])
            boxes = np.empty((comm.size, 2, 3))
            comm.Allgather(box, boxes)
            sent: list[tuple[Ints, Array] | None] = []
            for rank, (lower, upper) in enumerate(boxes):
                if rank == comm.rank:
                    sent.append(None)
                    continue
                near = mine & ((low <= upper + distance) & (high >= lower - distance)).all(axis=1)
                some = rows[near]
                moves = np.stack([x[some], u[some]], axis=2)
                sent.append((numbers[near], moves) if len(some) else None)
            received += [part for part in comm.alltoall(sent) if part is not None]
        return np.concatenate([part[0] for part in received]), np.concatenate([part[1] for part in received])

    def _exchange_elements(self, stencil: Ints, attributes: Ints | Array) -> tuple[Ints, Ints | Array]:
        """Elements (E, n) of this rank in global numbers, and those of others on its vertices; collective."""
        comm, bounds = self.layout.comm, self.layout.bounds
        if comm.size == 1:
            return stencil, attributes
        owners = np.searchsorted(bounds, stencil, side="right") - 1
        parts = [(owners == rank).any(axis=1) for rank in range(comm.size)]
        sent = [None if rank == comm.rank else (stencil[at], attributes[at]) for rank, at in enumerate(parts)]
        received = [part for part in comm.alltoall(sent) if part is not None]
        stencils, attribute_parts = zip((stencil, attributes), *received, strict=True)
        return np.concatenate(stencils), np.concatenate(attribute_parts)

    def _local_elements(self, stencil: Ints, attributes: Ints | Array, *, sort: bool) -> Elements:
        """Elements in local numbers, from global numbers (E, n) and attributes (E, m).

        Elements whose energy this rank counts come first. Those that a term itself returned (not ``sort``)
        stay in its order.
        """
        layout, attributes = self.layout, attributes.astype(np.float64, copy=False)
        first = stencil[:, 0]
        counted = (first >= layout.start) & (first < layout.start + layout.n_owned)
        parts = [np.flatnonzero(counted), np.flatnonzero(~counted)]
        if sort:  # so that the same elements give the same stencil after every search
            parts = [sort_rows(part, stencil, attributes, SORT_COLUMNS) for part in parts]
        order = np.concatenate(parts)
        if (order[1:] < order[:-1]).any():
            stencil, attributes = stencil[order], attributes[order]
        local = layout.local(stencil.ravel()).reshape(stencil.shape).astype(np.int32)
        data = {"what": attributes, "number": stencil.astype(np.float64)}
        return Elements(local, data, len(parts[0]))

    def update_pattern(self, acting: Mapping[Elastic, NDArray[np.bool_]]) -> bool:
        """Give ``rows`` the blocks of elements that act, ``acting`` (E,); returns whether ``rows`` changed.

        Unused blocks stay up to `MAX_UNUSED`; elements that do not act get an offset if their block exists.
        Collective.
        """
        if not self._changing or (not self.has_near_elements and self._rows_layout is self.layout):
            return False
        n_local = self.layout.n_local
        stencils = {term.name: term.stencil for term in self._changing}
        pattern = self.rows.pattern
        fits = fits_layout = (
            self._rows_layout is self.layout
        )  # not n_local: another layout may have as many rows
        if fits:
            pattern.locate({name: stencil for name, stencil in stencils.items() if name not in self._located})
            self._located = set(stencils)
            acts = [term for term in self._changing if term.n_elements]
            fits = not any(pattern.misses_block(term.name, acting[term]) for term in acts)
        if not any(self.layout.global_max(not fits)):
            return False
        # includes elements that do not act yet, as some soon will
        soon = self.fixed.pattern.missing(stencils.values(), n_local)
        kept = self._extra_keys if fits_layout else self._extra_keys[:0]
        few = len(kept) <= len(soon) + MAX_UNUSED * self.fixed.pattern.n_blocks
        self._extra_keys = union(kept, soon) if few else soon
        pattern, self.fixed_positions = self.fixed.pattern.extended(self._extra_keys, n_local)
        self.rows = BlockRows(pattern)
        pattern.locate(stencils)
        self._rows_layout, self._located = self.layout, set(stencils)
        return True

    def destroy(self) -> None:
        """Free the communication objects; collective."""
        if self.layout is not self._fixed_layout:
            self.layout.destroy()
        self._fixed_layout.destroy()
