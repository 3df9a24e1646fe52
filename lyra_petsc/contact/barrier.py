"""Contact of sheets with themselves, each other and obstacles by a barrier on the distances of simplices.

Pairs of a vertex and a triangle, and of two edges, without a common vertex repel each other if their distance
less ``thickness`` and less the radius of the obstacle is below ``gap`` (`contact_pairs`). The barrier's
stiffness k is chosen such that b″ in the middle of the gap is the membrane stiffness of the sheet, which is
about the diagonal of its Jacobian.

Nothing can pass through anything else: Newton's increments are limited by continuous collision detection, and
also such that pairs which the last search did not return cannot come into contact.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, unwritable
from lyra_petsc.contact import contact_pairs, one_sided, pair_distances, pair_motion
from lyra_petsc.contact.barrier_law import barrier as barrier_law
from lyra_petsc.contact.barrier_pairs import barrier_pairs
from lyra_petsc.contact.contact_search import ContactSearch
from lyra_petsc.contact.contact_setup import HALFWAY_CURVATURE, Barrier, surface_elements
from lyra_petsc.contact.joined import JoinedVertices
from lyra_petsc.contact.obstacle_points import ObstaclePositions, Obstacles
from lyra_petsc.contact.one_sided import Springs
from lyra_petsc.contact.pair_distances import EDGE_EDGE
from lyra_petsc.contact.pairs import (
    NO_PAIRS,
    ActiveAt,
    ActivePairs,
    Contacts,
    NearPairs,
    chosen,
    no_near_pairs,
)
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.protocols import KEPT_FRACTION, LimitsStep
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Assembly, UpcomingStep

TARGET_FRACTION = 0.7
"""Part of the gap at which pairs that become active in a Newton iteration shall be after it."""

TARGET_TOLERANCE = 0.05
"""Part of the gap by which pairs may be nearer than their target distance after a Newton iteration."""

MAX_DEVIATION = 0.1
"""Largest deviation over the gap of an obstacle's paths from straight lines, where these are used instead."""


class Pair(NamedTuple):
    """The two simplices (vertex, edge or triangle) that an element keeps apart.

    Attributes
    ----------
    parts : tuple of tuples of int
        Local rows of the vertices of each simplex of a sheet: two, or one in front of an obstacle.
    obstacle : str
        Name of the obstacle, empty between sheets.
    thickness : float
        Distance [m] of the mid-surfaces at which the gap is zero.
    """

    parts: tuple[tuple[int, ...], ...]
    obstacle: str
    thickness: float


class ContactBarrier(LimitsStep):
    """The barrier energy of all near pairs.

    Parameters
    ----------
    search : ContactSearch
    """

    def __init__(self, search: ContactSearch) -> None:
        self.search = search
        self.barrier = Barrier(0.0, 0.0, 0.0, 1.0)
        super().__init__(Elements(np.empty((0, 4), dtype=np.int32)))
        self._capacity = self._set_number = 0
        self.set_pairs(no_near_pairs(), self.stencil, 0)

    def set_up(
        self, barrier: Barrier, obstacles: Sequence[Solid | Container], joined: JoinedVertices
    ) -> None:
        """Take the data that are the same on all ranks; must be called first."""
        self.barrier = barrier
        self.search.set_up(barrier, obstacles, joined)

    @property
    def obstacles(self) -> Obstacles:
        """The obstacles of the scene, and its symmetry planes."""
        return self.search.obstacles

    def set_pairs(self, pairs: NearPairs, stencil: NDArray[np.int32], n_counted: int) -> None:
        """Take the near pairs with a vertex of this rank, in local rows ``stencil`` (E, 4); this rank counts
        the first ``n_counted``.
        """
        self.set_elements(Elements(stencil, n_owned=n_counted))
        of_search = self.obstacles, self.search.obstacle_x
        self.pairs = barrier_pairs(pairs, self.stencil, self.barrier, *of_search)
        self._set_number += 1
        self._expected = np.full(self.n_elements, np.nan)
        self._springs: Springs | None = None

    # -- obstacles ---------------------------------------------------------------------------------

    def freeze(self, step: UpcomingStep) -> ObstaclePositions:
        return self.obstacles.in_step(step.start, step.target_time, act=step.in_contact)

    @property
    def moving(self) -> bool:
        return self.obstacles.moving

    # -- energy ------------------------------------------------------------------------------------

    def active_pairs(self, x: Array, obstacle_x: Array) -> ActivePairs:
        """The pairs nearer than the gap for positions x (n_local, 3) [m] and obstacle_x (m, 3) [m]."""
        if not self.n_elements:
            return NO_PAIRS
        lower_bound = np.empty(self.n_elements)
        data = *self._pair_data, self.pairs.shares, self.n_owned
        while True:
            capacity = self._capacity
            integers = np.empty(capacity, dtype=np.int64), *np.empty((2, capacity))
            arrays = *integers, np.empty((capacity, 4)), np.empty(capacity), np.empty((capacity, 6))
            active = contact_pairs.find_active(x, obstacle_x, *data, lower_bound, arrays)
            if active <= capacity:
                return ActivePairs(*unwritable(lower_bound, *(values[:active] for values in arrays)))
            self._capacity = active + active // 4

    def at(self, x: Array, frozen: ObstaclePositions) -> ObstaclePositions:
        """The obstacles with the pairs that are active with the sheets at positions x (n_local, 3) [m]."""
        return frozen._replace(active=ActiveAt(self._set_number, lambda: self._acting_pairs(x, frozen)))

    def _acting_pairs(self, x: Array, frozen: ObstaclePositions) -> ActivePairs:
        """The pairs with forces in the equations of a step, at positions x (n_local, 3) [m] at its end."""
        here = frozen.active
        if here is not None and here.set_number == self._set_number:
            return here.pairs
        return self.active_pairs(x, frozen.end) if frozen.act else NO_PAIRS

    @property
    def _pair_data(self) -> tuple[Any, ...]:
        """The pairs, their stiffness and `Barrier.parallel`: arguments of kernels."""
        return *self.pairs.geometry, self.pairs.stiffness, self.barrier.parallel

    def energies(self, x: Array, frozen: ObstaclePositions) -> Array:
        if not self.n_elements:
            return np.empty(0)
        active = self._acting_pairs(x, frozen)
        counted = active.owned_weight != 0.0  # only owned pairs, which come first
        energies = (active.owned_weight * active.energy)[counted]
        return np.bincount(active.pair[counted], energies, minlength=self.n_owned).astype(np.float64)

    def add_gradient(self, x: Array, frozen: ObstaclePositions, out: Array) -> None:
        if not self.n_elements:
            return
        active, on_obstacles = self._acting_pairs(x, frozen).forces, np.zeros_like(frozen.end)
        contact_pairs.add_gradient(x, frozen.end, *self._pair_data, active, out, on_obstacles)

    def overrun(self, x: Array, frozen: ObstaclePositions) -> tuple[float, str]:
        return 0.0, ""

    def active_elements(self, x: Array, frozen: ObstaclePositions) -> NDArray[np.bool_]:
        """Which pairs (E,) have a non-zero Hessian at positions x (n_local, 3), springs included."""
        out = np.zeros(self.n_elements, dtype=np.bool_)
        if self.n_elements:
            out[self._acting_pairs(x, frozen).pair] = True
            if self._springs is not None:
                out[self._springs.pair] = True
        return out

    def add_hessian(self, x: Array, frozen: ObstaclePositions, into: Assembly) -> None:
        pair, pair_weight, beta, derivatives = self._acting_pairs(x, frozen).forces
        active = pair, into.weight[pair] * pair_weight, beta, derivatives
        to = into.convexity, into.offsets[self.name], into.values
        contact_pairs.add_hessians(x, frozen.end, *self._pair_data, active, *to)

    def largest_stiffness(self, x: Array, frozen: ObstaclePositions) -> float:
        """Largest b″ [N/m] of an active pair times its weight on this rank."""
        active = self._acting_pairs(x, frozen)
        return float((active.owned_weight * active.stiffness).max(initial=0.0))

    def force_scale(self, size: float) -> Array:
        return HALFWAY_CURVATURE * self.pairs.stiffness * size

    def stiffness(self, x: Array, frozen: ObstaclePositions) -> Array:
        active, out = self._acting_pairs(x, frozen), np.zeros(self.n_elements)
        stiffness = np.maximum(active.weight, active.owned_weight) * active.stiffness
        out[active.pair] = np.maximum(stiffness, HALFWAY_CURVATURE * self.pairs.stiffness[active.pair])
        return out

    def coordinate_scale(self, size: float) -> Array:
        return np.maximum(size, self.pairs.coordinate)

    # -- limits and corrections of Newton's increments ---------------------------------------------

    def largest_step(self, x: Array, dx: Array, frozen: ObstaclePositions) -> float:
        if not self.n_elements:
            return 1.0
        at_rest = np.zeros_like(frozen.end)
        approach = pair_motion.largest_approach(dx, at_rest)
        bound = self._acting_pairs(x, frozen).lower_bound
        near = np.flatnonzero(approach > (1.0 - KEPT_FRACTION) * bound)
        pairs = *(data[near] for data in self.pairs.geometry), KEPT_FRACTION, 1.0
        return float(pair_motion.largest_step(x, frozen.end, dx, at_rest, *pairs))

    def springs(self, x: Array, approach: float, frozen: ObstaclePositions) -> Springs:
        """One-sided springs for the pairs in contact at x (n_local, 3), or that may be after points have
        approached each other by ``approach`` [m], the same on all ranks. Their pairs count as active until
        `release_springs`.
        """
        active, capacity = self._acting_pairs(x, frozen), self._capacity
        of_active = active.pair, active.weight, active.owned_weight, active.beta, active.derivatives
        while True:
            integers = np.empty(capacity, dtype=np.int64)
            arrays = integers, np.empty((capacity, 4)), np.empty((capacity, 3)), *np.empty((3, capacity))
            pairs = *self._pair_data, of_active, self.n_owned
            n_active, n = one_sided.find_springs(x, frozen.end, approach, *pairs, arrays)
            if n <= capacity:
                break
            capacity = n
        pair, beta, normal, scale, length, counted = (values[:n] for values in arrays)
        springs = self.pairs.points[pair], beta, normal, scale, self.pairs.gap[pair], length, counted
        self._springs = Springs(pair, *springs, np.arange(n) < n_active)
        return self._springs

    def release_springs(self, length: Array | None) -> None:
        """Drop the springs. Their forces at lengths (m,) [m], where given, are those that `target_distances`
        expects.
        """
        self._expected[:] = np.nan
        if length is not None and self._springs is not None:
            self._expected[self._springs.pair] = self._springs.law(length)[0] / self._springs.scale
        self._springs = None

    def target_distances(self, x: Array, dx: Array, frozen: ObstaclePositions) -> tuple[NDArray[Any], ...]:
        """Distances of pairs that `add_corrections` restores after Newton's increment dx (n_local, 3) [m]."""
        n, pairs = self.n_elements, (*self.pairs.geometry, TARGET_FRACTION, self._expected)
        targets = np.empty(n), np.zeros((n, 3)), np.empty(n, np.bool_)
        pair_motion.target_distances(x, frozen.end, dx, *pairs, *targets)
        return targets

    def add_corrections(
        self,
        x: Array,
        dx: Array,
        frozen: ObstaclePositions,
        targets: tuple[NDArray[Any], ...],
        out: Array,
        weight: Array,
    ) -> bool:
        """Whether points are nearer after the increment dx (n_local, 3) [m] of x than their target distances.

        Adds corrections of the increment to ``out`` (n_local, 3) [m], each times a weight, and the weights to
        ``weight`` (n_local, 1).
        """
        pairs = *self.pairs.geometry, *targets, TARGET_TOLERANCE
        return bool(pair_motion.add_corrections(x, frozen.end, dx, *pairs, out, weight))

    # -- collisions --------------------------------------------------------------------------------

    def is_collision_free(self, x: Array, dx: Array, frozen: ObstaclePositions) -> bool:
        """Whether nothing collides on the displacement dx (n_local, 3) [m] from x, while obstacles move."""
        if not self.n_elements:
            return True
        curved = np.flatnonzero(self.search.path_deviations > MAX_DEVIATION * self.barrier.gap)
        if len(curved) and np.isin(self.pairs.obstacle, curved).any():
            return False
        motion = frozen.start, dx, frozen.end - frozen.start
        return bool(pair_motion.largest_step(x, *motion, *self.pairs.geometry, KEPT_FRACTION, 1.0) == 1.0)

    def distances(self, x: Array, obstacle_x: Array) -> Array:
        """Distance less offset [m] of all pairs, (E,), with points of obstacles at obstacle_x (m, 3)."""
        out = np.empty(self.n_elements)
        pair_distances.distances(x, obstacle_x, self.pairs.kind, self.pairs.points, out)
        return out - self.pairs.offset

    def gaps(self, x: Array, frozen: ObstaclePositions) -> Array:
        """Distance less thickness [m] between the two simplices of each owned pair, (n_owned,)."""
        return (self.pairs.scale * self.distances(x, frozen.end))[: self.n_owned]

    def largest_steps(self, x: Array, dx: Array, frozen: ObstaclePositions) -> Array:
        """Fraction, up to 1, of the displacement dx (n_local, 3) [m] from x, while obstacles move, on which
        each pair alone does not collide, (E,).
        """
        motion, out = (frozen.start, dx, frozen.end - frozen.start), np.empty(self.n_elements)
        pair_motion.largest_steps(x, *motion, *self.pairs.geometry, KEPT_FRACTION, out)
        return out

    def may_collide(self, x: Array, dx: Array, frozen: ObstaclePositions, threshold: float) -> bool:
        """Whether any pair of this rank may come into contact in a step with displacement dx (n_local, 3) [m]
        from x; only pairs that approach by more than ``threshold`` [m] count.
        """
        motion = frozen.start, dx, frozen.end - frozen.start
        return bool(pair_motion.may_collide(x, *motion, *self.pairs.geometry, threshold))

    def pair(self, element: int) -> Pair:
        """The pair of simplices of this number."""
        points, n_first = (
            self.pairs.points[element].tolist(),
            2 if self.pairs.kind[element] == EDGE_EDGE else 1,
        )
        parts = (tuple(points[:n_first]), tuple(points[n_first:]))
        number = int(self.pairs.obstacle[element])
        name = self.obstacles.bodies[number].name if number >= 0 else ""
        return Pair(tuple(part for part in parts if min(part) >= 0), name, self.barrier.thickness)

    # -- obstacles that move, and forces on them ---------------------------------------------------

    def _obstacle_gradients(self, x: Array, obstacle_x: Array) -> Iterator[tuple[int, Array, Array]]:
        """Numbers of obstacles in contact, and for each the forces (n_local, 3) [N] of this rank's pairs on
        it, and the gradient (m, 3) [N] of their energy by the points of obstacles.
        """
        active = self.active_pairs(x, obstacle_x)
        number = self.pairs.obstacle[active.pair]
        for obstacle in np.unique(number[number >= 0]):
            rows = np.flatnonzero((number == obstacle) & (active.owned_weight != 0.0))
            gradient, on_obstacles = np.zeros_like(x), np.zeros_like(obstacle_x)
            arrays = active.pair, active.owned_weight, active.beta, active.derivatives
            chosen_arrays = unwritable(*(array[rows] for array in arrays))
            contact_pairs.add_gradient(x, obstacle_x, *self._pair_data, chosen_arrays, gradient, on_obstacles)
            yield int(obstacle), gradient, on_obstacles

    def obstacle_forces(self, x: Array, frozen: ObstaclePositions) -> Array:
        """Force [N] of this rank's pairs on each obstacle, its torque [N m] about the origin, the sum over
        contacts of the magnitudes of normal forces [N], and 0, (obstacles, 8).
        """
        out = np.zeros((len(self.obstacles.bodies), 8))
        for obstacle, force, _ in self._obstacle_gradients(x, frozen.end):
            out[obstacle, :6] = *force.sum(axis=0), *np.cross(x, force).sum(axis=0)
        contacts = self.find_contacts(x, frozen.end)
        on = contacts.obstacle >= 0
        np.add.at(out[:, 6], contacts.obstacle[on], contacts.force[on])
        return out

    def work(self, x: Array, at: float, start: float, end: float) -> float:
        """Work [J] of moving obstacles on this rank's pairs between the times ``start`` and ``end`` [s], by
        the forces at positions x (n_local, 3) with obstacles at time ``at``.
        """
        to_start, to_end = (self.obstacles.motions(at, time) for time in (start, end))
        work = 0.0
        for obstacle, *forces in self._obstacle_gradients(x, self.obstacles.positions(at)):
            work += to_end.work(obstacle, x, *forces) - to_start.work(obstacle, x, *forces)
        return work

    def moved_with_obstacles(self, x: Array, dx: Array, frozen: ObstaclePositions) -> Array:
        """Displacements dx (n_local, 3) [m] from x, for vertices in the path of moving obstacles changed to
        those of the obstacles.
        """
        if not self.moving:
            return dx
        blocked = self.largest_steps(x, dx, frozen) < 1.0
        moved = dx.copy()
        for number in range(len(self.obstacles.bodies)):
            points = self.pairs.points[blocked & (self.pairs.obstacle == number)]
            pair, corner = np.nonzero(points >= 0)
            own = points[pair, corner]
            moved[own] = frozen.motions.carried(number, x[own], points[pair])[0] - x[own]
        for points in self.pairs.points[blocked & (self.pairs.obstacle < 0)]:  # a sheet moves the next one
            changed = (moved[points] != dx[points]).any(axis=1)
            if changed.any():
                moved[points[~changed]] = moved[points[changed]][0]
        return moved

    # -- contact forces ----------------------------------------------------------------------------

    def find_contacts(self, x: Array, obstacle_x: Array) -> Contacts:
        """The contacts of this rank's pairs for positions x (n_local, 3) [m] and obstacle_x (m, 3) [m]."""
        active, near = self.active_pairs(x, obstacle_x), self.pairs
        capacity = len(active.pair) + self.n_owned
        pair, force, distance = np.empty(capacity, dtype=np.int64), *np.empty((2, capacity))
        beta, normal = np.empty((capacity, 4)), np.empty((capacity, 3))
        data = *self._pair_data, active.lower_bound, active.forces, self.n_owned
        out = beta, normal, force, distance, pair
        n = contact_pairs.find_contacts(x, obstacle_x, *data, out)
        pair, beta, normal, force = pair[:n], beta[:n], normal[:n], force[:n]
        if (force < 0.0).any():
            contact_pairs.cancel_negative(near.kind[pair], near.points[pair, 0], normal, force)
        rows, sheet_beta = self.stencil[pair].astype(np.int64), np.where(near.points[pair] >= 0, beta, 0.0)
        obstacle = near.obstacle[pair]
        contacts = Contacts(
            pair, rows, sheet_beta, beta, normal, force, distance[:n], obstacle, near.points[pair]
        )
        return chosen(contacts, force > 0.0)

    def contact_stiffness(self, contacts: Contacts) -> Array:
        """Second derivative b″ [N/m] of the energy with respect to the distance of each contact, > 0."""
        _, slope, curvature = barrier_law(contacts.distance, self.pairs.gap[contacts.pair])
        stiffness: Array = -contacts.force * curvature / slope
        return stiffness

    def normal_forces(self, x: Array, frozen: ObstaclePositions) -> Array:
        """Sum of the normal forces [N] at each local vertex, (n_local,), of the pairs that this rank counts.

        Only the owner of a vertex knows all pairs between which its force is divided.
        """
        contacts = self.find_contacts(x, frozen.end)
        shares = contacts.force[:, None] * np.abs(contacts.sheet_beta)
        return np.bincount(contacts.rows.ravel(), shares.ravel(), len(x)).astype(np.float64)

    def history(self, x: Array, frozen: ObstaclePositions) -> Mapping[str, float]:
        active, n = self.active_pairs(x, frozen.end), self.n_owned
        distance, gap = active.lower_bound[:n], self.pairs.gap[:n]  # exact below the gap
        # which farther pairs are known depends on when they were searched
        touches = distance < gap
        smallest = (self.pairs.scale[:n] * distance)[touches].min(initial=np.inf)
        work = {"friction_work": 0.0}  # replaced by the friction term's if there is one
        return work | {"contacts": float(active.owned_weight.sum()), "smallest_gap": float(smallest)}


def elements(rest: RestShape) -> Elements:
    """The triangles of the sheets (rank 0)."""
    return surface_elements(rest)


def make(elements: Elements, scene: Scene, mass: Array) -> ContactBarrier:
    """The term on one rank; `ContactBarrier.set_up` must be called next."""
    uv, marks = elements.data["uv"].reshape(-1, 3, 2), elements.data["marks"]
    return ContactBarrier(ContactSearch(elements.stencil.astype(np.int32), uv, marks.astype(np.int64)))
