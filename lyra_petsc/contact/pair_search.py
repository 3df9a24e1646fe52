"""The broad phase of contact: which pairs are near, found again when vertices leave their expected path.

A search finds all pairs within a distance, the skin included, along straight displacements. It holds while no
vertex is farther than half the skin from its place on that path. The pairs of friction are those in contact
in the last accepted state, or in the last solve of the step. Rows of other ranks that pairs need become
ghosts.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.contact.friction import CoulombFriction
from lyra_petsc.contact.near import swept_boxes
from lyra_petsc.contact.pairs import (
    FrictionPairs,
    NearPairs,
    chosen,
    joined,
    no_friction_pairs,
    no_near_pairs,
)
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.kernels.sorting import sort_rows
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.mesh.points import Layout

FRACTIONS = *(0.25**k for k in range(12)), 0.0
"""Fractions of a displacement that are tried in turn, until a search along it finds few enough pairs."""

MAX_STEPS = 4
"""Largest number of steps along which a search looks while nothing is near."""


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


class PairSearch:
    """The near pairs of this rank; every method is collective.

    Parameters
    ----------
    discretisation : Discretisation
    barrier : ContactBarrier
        Gets the near pairs.
    friction : CoulombFriction or None
        Gets the pairs in contact with a vertex of this rank.

    Attributes
    ----------
    near : bool
        Whether there are pairs on any rank.
    """

    def __init__(
        self, discretisation: Discretisation, barrier: ContactBarrier, friction: CoulombFriction | None
    ) -> None:
        self._discretisation, self._barrier, self._friction = discretisation, barrier, friction
        self.near = False
        self._pairs = no_near_pairs()
        self._friction_pairs = no_friction_pairs()
        # of the last search: positions and displacements (n, 3) [m], and over all ranks the products of both,
        # and of the displacements [m²]
        self._path: tuple[Array, Array] | None = None
        self._begin = self._square = 0.0
        self._steps = 1  # steps that were expected to lead along the path
        self._radius = 0.5 * barrier.search.skin  # distance [m] from the path up to which the search is valid
        self._fraction = 1.0  # of the expected displacement that was searched
        self._triangles = self._with_marks(barrier.search.surface.astype(np.int64))  # all, on a single rank

    @property
    def _layout(self) -> Layout:
        return self._discretisation.layout

    def update(
        self, x: Array, expected: Array | None = None, ahead: Callable[[int], Array] | None = None
    ) -> None:
        """Update the pairs for positions x (n_local, 3) [m], which may add ghosts.

        ``expected`` (n_local, 3) [m] is the displacement expected from x. If it is that of a step, ``ahead``
        returns that of several steps: a search looks along these while nothing is near.
        """
        layout, barrier, friction = self._layout, self._barrier, self._friction
        here = x[: layout.n_vertices]
        positions = (here,) if expected is None else (here, here + expected[: len(here)])
        leaves, moved, changed = layout.global_max(
            not self._are_near_path(self._radius, *positions),
            barrier.search.outdated,
            friction is not None and friction.pairs_have_changed,
        )
        searches = leaves or moved
        if not (searches or changed):
            return
        of_barrier, of_friction = len(self._pairs.kind), len(self._friction_pairs.key)
        if searches:
            self._search_ahead(x, np.zeros_like(x) if expected is None else expected, ahead)
        if friction is not None and changed:
            self._friction_pairs = self._exchanged(friction.take_equation_pairs())
        others = self._add_ghosts()
        if others or (searches and of_barrier + len(self._pairs.kind) > 0):
            self._give_barrier_pairs()
        if friction is not None and (others or (changed and of_friction + len(self._friction_pairs.key) > 0)):
            self._give_friction_pairs(friction)

    def _add_ghosts(self) -> bool:
        """Add the rows of other ranks that pairs need to the ghosts; returns whether any were missing."""
        layout = self._layout
        stencils = [self._pairs.vertices, self._friction_pairs.vertices]
        more, end = layout.ghosts[:0], layout.start + layout.n_owned
        any_here = any(len(vertices) for vertices in stencils)
        if any_here:
            beyond = [vertices[(vertices < layout.start) | (vertices >= end)] for vertices in stencils]
            more = np.setdiff1d(np.concatenate(beyond), self._discretisation.fixed_ghosts)
        missing = len(more) > 0 and not np.isin(more, layout.ghosts).all()
        others, self.near = (flag > 0.0 for flag in layout.global_max(missing, any_here))
        if others:
            self._discretisation.set_ghosts(more)
        return others

    def _counted(self, vertices: Ints) -> tuple[Ints, Ints]:
        """Rows of the pairs (E, 4) whose energy this rank counts, since it owns the first vertex, and of the
        others.
        """
        first, start = vertices[:, 0], self._layout.start
        counted = (first >= start) & (first < start + self._layout.n_owned)
        return np.flatnonzero(counted), np.flatnonzero(~counted)

    def _local(self, vertices: Ints) -> NDArray[np.int32]:
        return self._layout.local(vertices.ravel()).reshape(vertices.shape).astype(np.int32)

    def _give_barrier_pairs(self) -> None:
        pairs = self._pairs
        keys = np.column_stack([pairs.vertices, pairs.kind, pairs.obstacle, pairs.obstacle_points])
        # sorted, so that the same pairs give the same stencil after every search
        parts = [sort_rows(part, keys) for part in self._counted(pairs.vertices)]
        order = np.concatenate(parts)
        pairs = chosen(pairs, order)
        stencil = self._local(pairs.vertices)
        self._discretisation.replace_stencil(self._barrier, stencil)
        self._barrier.set_pairs(pairs, stencil, len(parts[0]))

    def _give_friction_pairs(self, friction: CoulombFriction) -> None:
        pairs = self._friction_pairs
        parts = self._counted(pairs.vertices)
        pairs = chosen(pairs, np.concatenate(parts))
        stencil = self._local(pairs.vertices)
        self._discretisation.replace_stencil(friction, stencil)
        friction.set_pairs(pairs, stencil, len(parts[0]))

    def _search_ahead(self, x: Array, expected: Array, ahead: Callable[[int], Array] | None) -> None:
        """Search along ``expected`` (n_local, 3), or the displacement of several steps.

        Several steps are tried, one more than the last search was valid for, while nothing is near. What is
        found then may be near only after the step, or only because the guess is wrong.
        """
        here = x[: self._layout.n_vertices]
        displacement, steps = expected, 1
        if ahead is not None and self._path is not None and not self.near:
            next_steps = min(round(self._steps * self._places(here)[0]) + 1, MAX_STEPS)
            farther, to = ahead(next_steps), here + expected[: len(here)]
            self._set_path(here, farther)
            if not any(self._layout.global_max(not self._are_near_path(self._radius, to))):
                displacement, steps = farther, next_steps
        part = self._search(x, displacement)
        if steps > 1 and (part < 1.0 or any(self._layout.global_max(len(self._pairs.kind) > 0))):
            displacement, steps = expected, 0  # so that the next search tries one step
            part = self._search(x, displacement)
        self._set_path(here, part * displacement)
        self._steps = steps

    def fraction_covered(self, x: Array, displacement: Array) -> float:
        """Fraction ≤ 1 of a displacement (n_owned, 3) [m] from x that the last search covers."""
        if self._path is None:
            return 1.0
        n = self._layout.n_vertices
        radius = 0.5 * self._barrier.search.approach_limit
        x, displacement = x[:n], displacement[:n]
        for part in (1.0, self._fraction) if 0.0 < self._fraction < 1.0 else (1.0,):
            near = self._are_near_path(radius, x, x + part * displacement)
            if not any(self._layout.global_max(not near)):
                return part
        # points beside the path may move farther from one of its places than from another
        places, (origin, path) = (0.0, *self._places(x), 1.0), self._path
        beyond = self._layout.global_max(*(_any_beyond(x, origin, path, at, radius) for at in places))
        fractions = [
            0.0 if far else _fraction_within(x, displacement, origin + at * path, radius)
            for far, at in zip(beyond, places, strict=True)
        ]
        return -min(self._layout.global_max(*(-fraction for fraction in fractions)))

    def _set_path(self, here: Array, displacement: Array) -> None:
        """Set the path of the owned vertices, from positions ``here`` (n, 3) [m]."""
        path = displacement[: len(here)]
        self._path = here.copy(), path
        products = float(np.vdot(here, path)), float(np.vdot(path, path))
        self._begin, self._square = self._layout.global_sum(*products).tolist()

    def _places(self, *positions: Array) -> list[float]:
        """Fraction of the path of the last search to which the owned vertices are nearest, at each of several
        positions (n, 3).
        """
        assert self._path is not None
        if not self._square > 0.0:
            return [0.0] * len(positions)
        along = self._layout.global_sum(*[float(np.vdot(x, self._path[1])) for x in positions]).tolist()
        return [min(max((product - self._begin) / self._square, 0.0), 1.0) for product in along]

    def _are_near_path(self, radius: float, *positions: Array) -> bool:
        """Whether this rank's vertices are within ``radius`` [m] of one place on the path, at each of several
        positions (n, 3).
        """
        if self._path is None:
            return False
        origin, path = self._path
        places = zip(positions, self._places(*positions), strict=True)
        return not any([_any_beyond(x, origin, path, at, radius) for x, at in places])

    def _search(self, x: Array, displacement: Array) -> float:
        """Find the pairs along displacements (n_local, 3) [m], shortened if there are too many; returns the
        fraction that was searched.
        """
        for part in FRACTIONS:
            pairs = self._near_pairs(x, part * displacement)
            if not any(self._layout.global_max(pairs is None)):
                break
        assert pairs is not None
        self._fraction, self._pairs = part, pairs
        return part

    def _with_marks(self, triangles: Ints) -> Ints:
        """Triangles (F, 3) with further columns, the barrier's marks."""
        return np.column_stack([triangles, self._barrier.search.marks])

    def _near_pairs(self, x: Array, u: Array) -> NearPairs | None:
        """The pairs near owned vertices, on displacements u (n_local, 3) [m]; None if there are too many."""
        layout, n, barrier = self._layout, self._layout.n_vertices, self._barrier
        own = layout.start + np.arange(n)
        if layout.comm.size == 1:
            return barrier.search.near_pairs(x[:n], u[:n], own, self._triangles)
        surface, number_of = barrier.search.surface.astype(np.int64), np.arange(layout.n_local)
        corners = self._with_marks(layout.global_number[surface])
        mine = surface[:, 0] < layout.n_owned  # each triangle is sent once
        # a pair of a triangle with ghost corners also acts on the triangle's owned corners
        corners, moves = self._gather_near(corners, surface, x, u, mine)
        # triangles with owned corners are local already
        new = ((corners[:, :3] < layout.start) | (corners[:, :3] >= layout.start + n)).all(axis=1)
        corners, moves = corners[new], moves[new].reshape(-1, 2, 3)
        ghosts = np.unique(surface[surface >= n])
        number_of[ghosts] = n + np.arange(len(ghosts))
        numbers = np.concatenate([own, layout.global_number[ghosts]])
        others, first = np.unique(corners[:, :3], return_index=True)
        more = ~np.isin(others, numbers[n:])
        numbers = np.concatenate([numbers, others[more]])
        moves = moves[first[more]]
        order = n + np.argsort(numbers[n:])
        at = np.minimum(np.searchsorted(numbers[order], corners[:, :3]), max(len(order) - 1, 0))
        triangles = np.concatenate(
            [self._with_marks(number_of[surface]), np.concatenate([order[at], corners[:, 3:]], axis=1)]
        )
        points = np.concatenate([x[:n], x[ghosts], moves[:, 0]])
        pairs = barrier.search.near_pairs(
            points, np.concatenate([u[:n], u[ghosts], moves[:, 1]]), numbers, triangles
        )
        if pairs is None:
            return None
        touching = np.flatnonzero(
            ((pairs.vertices >= layout.start) & (pairs.vertices < layout.start + n)).any(axis=1)
        )
        return chosen(pairs, touching)

    def _gather_near(self, numbers: Ints, rows: Ints, x: Array, u: Array, mine: Mask) -> tuple[Ints, Array]:
        """Triangles of other ranks near the bounding box of those of this rank.

        Parameters
        ----------
        numbers, rows : (n, …), (n, 3)
            Global numbers of the triangles' corners with their marks, and local rows of the corners.
        x, u : (n_local, 3)
            Positions and displacements [m].
        mine : (n,)
            Which of them this rank sends.

        Returns
        -------
        numbers, moves : (k, …), (k, 3, 2, 3)
            The received ones; ``moves`` holds position and displacement of each corner.
        """
        comm, distance = self._layout.comm, self._barrier.search.distance
        received = [(numbers[:0], np.empty((0, rows.shape[1], 2, 3)))]
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

    def _exchanged(self, pairs: FrictionPairs) -> FrictionPairs:
        """Pairs of this rank, and those of others on its vertices."""
        comm, bounds = self._layout.comm, self._layout.bounds
        if comm.size == 1:
            return pairs
        owners = np.searchsorted(bounds, pairs.vertices, side="right") - 1
        on_rank = [(owners == rank).any(axis=1) for rank in range(comm.size)]
        sent = [None if rank == comm.rank else chosen(pairs, rows) for rank, rows in enumerate(on_rank)]
        return joined([pairs, *(part for part in comm.alltoall(sent) if part is not None)])
