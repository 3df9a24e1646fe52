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

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact import contact_pairs, surface_shares
from lyra_petsc.contact.contact_pairs import EDGE_EDGE, VERTEX_TRIANGLE
from lyra_petsc.contact.contact_search import EDGE_GAP, ContactSearch
from lyra_petsc.contact.contact_setup import AREA_UNITS, HALFWAY_CURVATURE, Barrier, surface_elements
from lyra_petsc.contact.obstacle_points import ObstaclePositions, Obstacles, StepInterval
from lyra_petsc.contact.one_sided import Springs
from lyra_petsc.contact.pairs import NearPairs, no_near_pairs
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.position_cache import PositionCache, unwritable
from lyra_petsc.terms.protocols import KEPT_FRACTION, LimitsStep
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Assembly, UpcomingStep

TARGET_FRACTION = 0.7
"""Part of the gap at which pairs that become active in a Newton iteration shall be after it."""

TARGET_TOLERANCE = 0.05
"""Part of the gap by which pairs may be nearer than their target distance after a Newton iteration."""

MAX_DEVIATION = 0.1
"""Largest deviation over the gap of an obstacle's paths from straight lines, where these are used instead."""


TO_STAGE = StepInterval(0.0, 1.0)


class ActivePairs(NamedTuple):
    """Pairs nearer than the gap; of those with the same nearest vertices only one.

    Attributes
    ----------
    lower_bound : (E,)
        Lower bound of the distance less offset [m] of every pair, exact below the gap.
    pair, weight, owned_weight, beta, energy, derivatives : (m, …)
        Data of the active pairs, as `contact_pairs.find_active` writes them.
    """

    lower_bound: Array
    pair: Ints
    weight: Array
    owned_weight: Array
    beta: Array
    energy: Array
    derivatives: Array

    @property
    def square(self) -> Array:
        """|g|² [m²], (m,)."""
        g = self.derivatives[:, :3]
        square: Array = np.einsum("mk,mk->m", g, g)
        return square

    @property
    def stiffness(self) -> Array:
        """b″ times the mollifier [N/m], (m,)."""
        return self.derivatives[:, 5] * self.derivatives[:, 4] * self.square

    @property
    def forces(self) -> tuple[Ints, Array, Array, Array]:
        """The arguments of kernels: pair, weight, β and derivatives."""
        return self.pair, self.weight, self.beta, self.derivatives


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


class Contacts(NamedTuple):
    """Pairs in contact at the end of a step that this rank counts.

    Attributes
    ----------
    points, sheet_beta, beta : (m, 4)
        Local rows of the vertices, their coefficients β, 0 for points of obstacles, and those of all points:
        the vector between the nearest points is Σ β_i p_i.
    normal : (m, 3)
        Unit normals towards the first simplex.
    force, stiffness : (m,)
        Normal force [N] and second derivative b″ of the energy with respect to the distance [N/m], > 0.
    obstacle : (m,)
        Number of the obstacle, −1 between sheets.
    velocity : (m, 3)
        Velocity [m/s] of the obstacle at the contact, times Σ β_i; 0 between sheets.
    pair : (m,)
        Numbers of the term's elements.
    """

    points: Ints
    sheet_beta: Array
    beta: Array
    normal: Array
    force: Array
    stiffness: Array
    obstacle: Ints
    velocity: Array
    pair: Ints


_EMPTY = np.empty(0)
_EMPTY_ROWS = np.empty(0, dtype=np.int64), _EMPTY, _EMPTY, np.empty((0, 4)), _EMPTY, np.empty((0, 6))
NO_PAIRS = ActivePairs(*unwritable(_EMPTY, *_EMPTY_ROWS))


class ContactBarrier(LimitsStep):
    """The barrier energy of all near pairs.

    Parameters
    ----------
    search : ContactSearch
    """

    def __init__(self, search: ContactSearch) -> None:
        self.search, self.static = search, False
        self.barrier = Barrier(0.0, 0.0, 0.0, 1.0)
        super().__init__(Elements(np.empty((0, 4), dtype=np.int32)))
        self._capacity = 0
        self.set_pairs(no_near_pairs(), self.stencil, 0)

    def set_up(
        self, barrier: Barrier, obstacles: Sequence[Solid | Container], *, self_contact: bool, static: bool
    ) -> None:
        """Take the data that are the same on all ranks; must be called first.

        ``self_contact``: sheets repel each other and themselves; ``static``: an equilibrium is computed.
        """
        self.barrier, self.static = barrier, static
        self.search.set_up(barrier, obstacles, self_contact=self_contact, static=static)

    @property
    def obstacles(self) -> Obstacles:
        """The obstacles of the scene, and its symmetry planes."""
        return self.search.obstacles

    def set_pairs(self, pairs: NearPairs, stencil: NDArray[np.int32], n_counted: int) -> None:
        """Take the near pairs with a vertex of this rank, in local rows ``stencil`` (E, 4); this rank counts
        the first ``n_counted``.
        """
        self.set_elements(Elements(stencil, n_owned=n_counted))
        self.number, self.kind, self.obstacle = pairs.vertices, pairs.kind, pairs.obstacle
        self.points = np.where(pairs.obstacle_points < 0, pairs.obstacle_points, self.stencil)
        narrowing = pairs.narrowing / AREA_UNITS
        self.offset = self.barrier.thickness / narrowing + self.obstacles.radius[self.obstacle]
        self.shares = surface_shares.shares(pairs.surroundings)
        self.pair_stiffness = self.barrier.stiffness / AREA_UNITS * pairs.stiffness
        self.gap = np.where(self._are_secondary(), EDGE_GAP, 1.0) * self.barrier.gap
        # distance from the image in a wall over that from the wall: k (g − 2 d)³ / 2 d = 4 k (g / 2 − d)³ / d
        image_scale = np.where(self.obstacle >= self.obstacles.first_wall, 2.0, 1.0)
        self._scale = image_scale * narrowing
        self.gap /= self._scale
        self.pair_stiffness *= image_scale**2 * narrowing
        self._active_at = PositionCache(self._find_active)
        self._expected = np.full(self.n_elements, np.nan)
        largest = np.append(np.abs(self.search.obstacle_x).max(axis=(0, 2)), 0.0)
        of_points = largest[np.where(self.points < 0, ~self.points, -1)]
        self._largest_coordinate = np.maximum(np.abs(self.offset), of_points.max(axis=1))
        self._springs: Springs | None = None

    def _are_secondary(self) -> NDArray[np.bool_]:
        """Which pairs (E,) have the gap `EDGE_GAP`: two edges of sheets, and edges and points of obstacles
        where their triangles are smooth.
        """
        obstacles, points = self.obstacles, self.points
        out: NDArray[np.bool_] = (self.kind == EDGE_EDGE) & (self.obstacle < 0)
        corners = np.flatnonzero((self.kind == VERTEX_TRIANGLE) & (points[:, 0] < 0))
        out[corners] = obstacles.smooth_points[~points[corners, 0]]
        edges = np.flatnonzero((self.kind == EDGE_EDGE) & (self.obstacle >= 0))
        ends = np.sort(~points[edges, 2:], axis=1)
        keys = ends[:, 0] * obstacles.n_points + ends[:, 1]
        first, last = (np.searchsorted(obstacles.smooth_edges, keys, side=s) for s in ("left", "right"))
        out[edges] = first < last
        return out

    # -- obstacles ---------------------------------------------------------------------------------

    def freeze(self, step: UpcomingStep) -> ObstaclePositions:
        return self.search.expect(step)

    @property
    def moving(self) -> bool:
        return self.obstacles.moving

    # -- energy ------------------------------------------------------------------------------------

    def active_pairs(self, x: Array, obstacle_x: Array) -> ActivePairs:
        """The pairs nearer than the gap for positions x (n_local, 3) [m] and obstacle_x (m, 3) [m]."""
        if not self.n_elements:
            return NO_PAIRS
        return ActivePairs(*self._active_at(np.concatenate([x, obstacle_x])))

    def _find_active(self, points: Array) -> tuple[NDArray[Any], ...]:
        x, obstacle_x = np.split(points, [len(points) - self.obstacles.n_points])
        lower_bound = np.empty(self.n_elements)
        data = *self._pair_data, self.shares, self.n_owned
        while True:
            capacity = self._capacity
            integers = np.empty(capacity, dtype=np.int64), *np.empty((2, capacity))
            found = *integers, np.empty((capacity, 4)), np.empty(capacity), np.empty((capacity, 6))
            active = contact_pairs.find_active(x, obstacle_x, *data, lower_bound, found)
            if active <= capacity:
                return lower_bound, *(part[:active] for part in found)
            self._capacity = active + active // 4

    @property
    def _geometry(self) -> tuple[Ints, Ints, Array, Array]:
        """Kinds, points, offsets and gaps of the pairs: arguments of kernels."""
        return self.kind, self.points, self.offset, self.gap

    @property
    def _pair_data(self) -> tuple[Any, ...]:
        """Also their stiffness, and `Barrier.parallel`."""
        return *self._geometry, self.pair_stiffness, self.barrier.parallel

    def energies(self, x: Array, frozen: ObstaclePositions) -> Array:
        if not self.n_elements:
            return _EMPTY
        active = self.active_pairs(x, frozen.stage)
        counted = active.owned_weight != 0.0  # only owned pairs, which come first
        energies = (active.owned_weight * active.energy)[counted]
        return np.bincount(active.pair[counted], energies, minlength=self.n_owned).astype(np.float64)

    def add_gradient(self, x: Array, frozen: ObstaclePositions, out: Array) -> None:
        if not self.n_elements:
            return
        active, on_obstacles = self.active_pairs(x, frozen.stage).forces, np.zeros_like(frozen.stage)
        contact_pairs.add_gradient(x, frozen.stage, *self._pair_data, active, out, on_obstacles)

    def overrun(self, x: Array, frozen: ObstaclePositions) -> tuple[float, str]:
        return 0.0, ""

    def active_elements(self, x: Array, frozen: ObstaclePositions) -> NDArray[np.bool_]:
        """Which pairs (E,) have a non-zero Hessian at positions x (n_local, 3), springs included."""
        out = np.zeros(self.n_elements, dtype=np.bool_)
        if self.n_elements:
            out[self.active_pairs(x, frozen.stage).pair] = True
            if self._springs is not None:
                out[self._springs.pair] = True
        return out

    def add_hessian(self, x: Array, frozen: ObstaclePositions, into: Assembly) -> None:
        pair, pair_weight, beta, derivatives = self.active_pairs(x, frozen.stage).forces
        active = pair, into.weight[pair] * pair_weight, beta, derivatives
        to = into.convexity, into.offsets[self.name], into.values
        contact_pairs.add_hessians(x, frozen.stage, *self._pair_data, active, *to)

    def largest_stiffness(self, x: Array, frozen: ObstaclePositions) -> float:
        """Largest b″ [N/m] of an active pair times its weight on this rank."""
        active = self.active_pairs(x, frozen.stage)
        return float((active.owned_weight * active.stiffness).max(initial=0.0))

    def force_scale(self, size: float) -> Array:
        return HALFWAY_CURVATURE * self.pair_stiffness * size

    def stiffness(self, x: Array, frozen: ObstaclePositions) -> Array:
        active, out = self.active_pairs(x, frozen.stage), np.zeros(self.n_elements)
        stiffness = np.maximum(active.weight, active.owned_weight) * active.stiffness
        out[active.pair] = np.maximum(stiffness, HALFWAY_CURVATURE * self.pair_stiffness[active.pair])
        return out

    def coordinate_scale(self, size: float) -> Array:
        return np.maximum(size, self._largest_coordinate)

    # -- limits and corrections of Newton's increments ---------------------------------------------

    def largest_step(self, x: Array, dx: Array, frozen: ObstaclePositions) -> float:
        if not self.n_elements:
            return 1.0
        at_rest = np.zeros_like(frozen.stage)
        approach = contact_pairs.largest_approach(dx, at_rest)
        bound = self.active_pairs(x, frozen.stage).lower_bound
        near = np.flatnonzero(approach > (1.0 - KEPT_FRACTION) * bound)
        pairs = *(data[near] for data in self._geometry), KEPT_FRACTION, 1.0
        return float(contact_pairs.largest_step(x, frozen.stage, dx, at_rest, *pairs))

    def springs(self, x: Array, approach: float, frozen: ObstaclePositions) -> Springs:
        """One-sided springs for the pairs in contact at x (n_local, 3), or that may be after points have
        approached each other by ``approach`` [m], the same on all ranks. Their pairs count as active until
        `release_springs`.
        """
        active, capacity = self.active_pairs(x, frozen.stage), self._capacity
        given = active.pair, active.weight, active.owned_weight, active.beta, active.derivatives
        while True:
            integers = np.empty(capacity, dtype=np.int64)
            found = integers, np.empty((capacity, 4)), np.empty((capacity, 3)), *np.empty((3, capacity))
            pairs = *self._pair_data, given, self.n_owned
            n_active, n = contact_pairs.find_springs(x, frozen.stage, approach, *pairs, found)
            if n <= capacity:
                break
            capacity = n
        pair, beta, normal, scale, length, counted = (part[:n] for part in found)
        springs = self.points[pair], beta, normal, scale, self.gap[pair], length, counted
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
        n, pairs = self.n_elements, (*self._geometry, TARGET_FRACTION, self._expected)
        targets = np.empty(n), np.zeros((n, 3)), np.empty(n, np.bool_)
        contact_pairs.target_distances(x, frozen.stage, dx, *pairs, *targets)
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
        pairs = *self._geometry, *targets, TARGET_TOLERANCE
        return bool(contact_pairs.add_corrections(x, frozen.stage, dx, *pairs, out, weight))

    # -- collisions --------------------------------------------------------------------------------

    def is_collision_free(
        self, x: Array, dx: Array, frozen: ObstaclePositions, interval: StepInterval
    ) -> bool:
        """Whether nothing collides on the displacement dx (n_local, 3) [m] from x, while obstacles move as
        in an interval of the step.
        """
        if not self.n_elements:
            return True
        curved = np.flatnonzero(self.search.path_deviations > MAX_DEVIATION * self.barrier.gap)
        if len(curved) and np.isin(self.obstacle, curved).any():
            return False
        motion = frozen.displacements(interval, dx)
        return bool(contact_pairs.largest_step(x, *motion, *self._geometry, KEPT_FRACTION, 1.0) == 1.0)

    def distances(self, x: Array, obstacle_x: Array) -> Array:
        """Distance less offset [m] of all pairs, (E,), with points of obstacles at obstacle_x (m, 3)."""
        out = np.empty(self.n_elements)
        contact_pairs.distances(x, obstacle_x, self.kind, self.points, out)
        return out - self.offset

    def gaps(self, x: Array, frozen: ObstaclePositions) -> Array:
        """Distance less thickness [m] between the two simplices of each owned pair, (n_owned,)."""
        return (self._scale * self.distances(x, frozen.stage))[: self.n_owned]

    def largest_steps(self, x: Array, dx: Array, frozen: ObstaclePositions, interval: StepInterval) -> Array:
        """Fraction, up to 1, of the displacement dx (n_local, 3) [m] from x on which each pair alone does not
        collide, (E,), while obstacles move as in an interval of the step.
        """
        motion, out = frozen.displacements(interval, dx), np.empty(self.n_elements)
        contact_pairs.largest_steps(x, *motion, *self._geometry, KEPT_FRACTION, out)
        return out

    def may_collide(self, x: Array, dx: Array, frozen: ObstaclePositions, threshold: float) -> bool:
        """Whether any pair of this rank may come into contact in a step with displacement dx (n_local, 3) [m]
        from x; only pairs that approach by more than ``threshold`` [m] count.
        """
        motion = frozen.displacements(TO_STAGE, dx)
        return bool(contact_pairs.may_collide(x, *motion, *self._geometry, threshold))

    def pair(self, element: int) -> Pair:
        """The pair of simplices of this number."""
        points, n_first = self.points[element].tolist(), 2 if self.kind[element] == EDGE_EDGE else 1
        parts = (tuple(points[:n_first]), tuple(points[n_first:]))
        number = int(self.obstacle[element])
        name = self.obstacles.each[number].name if number >= 0 else ""
        return Pair(tuple(part for part in parts if min(part) >= 0), name, self.barrier.thickness)

    # -- obstacles that move, and forces on them ---------------------------------------------------

    def _obstacle_gradients(self, x: Array, obstacle_x: Array) -> Iterator[tuple[int, Array]]:
        """Numbers of obstacles in contact, and for each the forces (n_local, 3) [N] of this rank's pairs on
        it.
        """
        active = self.active_pairs(x, obstacle_x)
        number = self.obstacle[active.pair]
        for obstacle in np.unique(number[number >= 0]):
            rows = np.flatnonzero((number == obstacle) & (active.owned_weight != 0.0))
            gradient, on_obstacles = np.zeros_like(x), np.zeros_like(obstacle_x)
            arrays = active.pair, active.owned_weight, active.beta, active.derivatives
            given = unwritable(*(array[rows] for array in arrays))
            contact_pairs.add_gradient(x, obstacle_x, *self._pair_data, given, gradient, on_obstacles)
            yield int(obstacle), gradient

    def obstacle_forces(self, x: Array, frozen: ObstaclePositions) -> Array:
        """Force [N] of this rank's pairs on each obstacle, its torque [N m] about the origin, the sum over
        contacts of the magnitudes of normal forces [N], and 0, (obstacles, 8).
        """
        out = np.zeros((len(self.obstacles.each), 8))
        for obstacle, force in self._obstacle_gradients(x, frozen.stage):
            out[obstacle, :6] = *force.sum(axis=0), *np.cross(x, force).sum(axis=0)
        _, _, normal_force, _, pair = self.find_contacts(x, frozen.stage, self.n_owned)
        on = self.obstacle[pair] >= 0
        np.add.at(out[:, 6], self.obstacle[pair][on], normal_force[on])
        return out

    def work(self, x: Array, at: float, start: float, end: float) -> float:
        """Work [J] of moving obstacles on this rank's pairs between the times ``start`` and ``end`` [s], by
        the forces at positions x (n_local, 3) with obstacles at time ``at``.
        """
        to_start, to_end = (self.obstacles.rigid_motions(at, time) for time in (start, end))
        work = 0.0
        for obstacle, force in self._obstacle_gradients(x, self.obstacles.positions(at)):
            (r0, t0), (r1, t1) = to_start[obstacle], to_end[obstacle]
            work -= float(np.vdot(force, x @ (r1 - r0).T + t1 - t0))
        return work

    def moved_with_obstacles(self, x: Array, dx: Array, frozen: ObstaclePositions) -> Array:
        """Displacements dx (n_local, 3) [m] from x, for vertices in the path of moving obstacles changed to
        those of the obstacles.
        """
        if not self.moving:
            return dx
        blocked = self.largest_steps(x, dx, frozen, TO_STAGE) < 1.0
        moved = dx.copy()
        for number, (rotation, translation) in enumerate(frozen.stage_motions):
            points = self.points[blocked & (self.obstacle == number)]
            points = np.unique(points[points >= 0])
            moved[points] = (x @ rotation.T + translation - x)[points]
        for points in self.points[blocked & (self.obstacle < 0)]:  # a moved sheet moves the next one
            changed = (moved[points] != dx[points]).any(axis=1)
            if changed.any():
                moved[points[~changed]] = moved[points[changed]][0]
        return moved

    # -- contact forces ----------------------------------------------------------------------------

    def find_contacts(self, x: Array, obstacle_x: Array, n_counted: int) -> tuple[NDArray[Any], ...]:
        """The pairs with a contact force among the first ``n_counted``.

        Returns β (m, 4), unit normals (m, 3), normal forces (m,) [N], distances less offset (m,) [m] and
        numbers of the pairs (m,). For a vertex of a sheet, pairs with the same nearest vertices occur once;
        all other pairs are returned singly.
        """
        active = self.active_pairs(x, obstacle_x)
        n = len(active.pair) + n_counted
        found = np.empty((n, 4)), np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(n, dtype=np.int64)
        given = active.lower_bound, active.forces, n_counted
        n = contact_pairs.find_contacts(x, obstacle_x, *self._pair_data, *given, found)
        beta, normal, force, delta, pair = (part[:n] for part in found)
        if (force < 0.0).any():
            contact_pairs.cancel_negative(self.kind[pair], self.points[pair, 0], normal, force)
        kept = force > 0.0
        return beta[kept], normal[kept], force[kept], delta[kept], pair[kept]

    def contacts(self, x: Array, v: Array, frozen: ObstaclePositions, last: tuple[float, float]) -> Contacts:
        """The pairs in contact at the end of the step, with positions x and velocities v (n_local, 3). The
        velocities of obstacles are means between the two times ``last`` [s].
        """
        beta, normal, force, delta, pair = self.find_contacts(x, frozen.end, self.n_owned)
        points, obstacle = self.stencil[pair].astype(np.int64), self.obstacle[pair]
        _, slope, curvature = contact_pairs.barrier(delta, self.gap[pair])
        of_sheet = np.where(self.points[pair] >= 0, beta, 0.0)
        velocity = self.obstacles.contact_velocities(x, v, points, of_sheet, obstacle, last)
        stiffness = -force * curvature / slope
        return Contacts(points, of_sheet, beta, normal, force, stiffness, obstacle, velocity, pair)

    def normal_forces(self, x: Array, frozen: ObstaclePositions) -> Array:
        """Sum of the normal forces [N] at each local vertex, (n_local,), of the pairs that this rank counts.

        Only the owner of a vertex knows all pairs between which its force is divided.
        """
        out = np.zeros(len(x))
        beta, _, force, _, pair = self.find_contacts(x, frozen.stage, self.n_owned)
        contact_pairs.add_normal_forces(self.points[pair], beta, force, out)
        return out

    def history(self, x: Array, frozen: ObstaclePositions) -> Mapping[str, float]:
        active, n = self.active_pairs(x, frozen.stage), self.n_owned
        scale = self._scale[:n]
        bound = scale * active.lower_bound[:n]
        exact = bound < scale * self.gap[:n]
        smallest = bound[exact].min(initial=np.inf)
        rows = np.flatnonzero(~exact & (bound < smallest))
        if len(rows):
            distance = np.empty(len(rows))
            contact_pairs.distances(x, frozen.stage, self.kind[rows], self.points[rows], distance)
            smallest = min(smallest, (scale[rows] * (distance - self.offset[rows])).min())
        work = {"friction_work": 0.0}  # replaced by the friction term's if there is one
        return work | {"contacts": float(active.owned_weight.sum()), "smallest_gap": float(smallest)}


def elements(rest: RestShape) -> Elements:
    """The triangles of the sheets (rank 0)."""
    return surface_elements(rest)


def make(elements: Elements, scene: Scene, mass: Array) -> ContactBarrier:
    """The term on one rank; `ContactBarrier.set_up` must be called next."""
    uv, marks = elements.data["uv"].reshape(-1, 3, 2), elements.data["marks"]
    return ContactBarrier(ContactSearch(elements.stencil.astype(np.int32), uv, marks.astype(np.int64)))
