"""Coulomb friction of all pairs in contact; ``friction_pairs`` has its potential in a time step.

Pairs, normals and normal forces are those of the last accepted state. A pair that is in contact again, or a
vertex that moved on to a neighbouring triangle, keeps its elastic slip, so that sticking pairs do not creep.
The owner of a pair's first vertex stores the pair and sends it to the owners of the others.

The equations of a step use the normal forces at its start, or where these change much, those at the end of
the solve before (`SceneContact.follow`). When the normal forces of the step are known, an impulse changes the
friction of each pair to that of Coulomb's law with these: the point of the disc |f| ≤ μ N that is nearest to
the friction which stops the pair (`impacts`). So friction never exceeds μ times the normal force of
the same step, and it opposes the motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact import friction_pairs
from lyra_petsc.contact.barrier import ContactBarrier, Contacts
from lyra_petsc.contact.contact_pairs import EDGE_EDGE
from lyra_petsc.contact.contact_setup import HALFWAY_CURVATURE
from lyra_petsc.contact.friction_pairs import (
    BETA,
    COLUMNS,
    CONTACT,
    FACTOR,
    FORCE,
    SLID,
    SLIP,
    START,
    STIFFNESS,
)
from lyra_petsc.kernels.sorting import sort_rows
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene, coefficients
from lyra_petsc.terms.protocols import Place, Stateful, TermState
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Assembly, UpcomingStep

MAX_ELASTIC_SLIP = 0.01
"""Largest slip of a sticking pair over the gap. If the kinetic coefficient is below the static one, all pairs
have this elastic slip: if lightly pressed pairs, such as those at a sheet's border, slid before the others,
the sheet would slide too early. Otherwise lightly pressed pairs have a shorter one, because they have to
build it up again whenever they separate and come back."""

STILL = 1e-8
"""Displacement in a step, over the gap, up to which a sticking pair is not stopped: without the round-off in
velocities, Newton's method would start where round-off leaves it no smaller energy."""

SHEET_SOFTNESS = 0.25
"""Friction stiffness between sheets over that on obstacles, for lightly pressed pairs. With springs as stiff
as the barrier halfway through the gap sheets rotate by much, and Newton's method needs up to 1.4 times as
many iterations."""


class Pairs(NamedTuple):
    """Pairs in contact in an accepted state that this rank counts, with ascending keys.

    Attributes
    ----------
    key : (E, 10)
        Numbers of four vertices, kind, obstacle, and numbers of the obstacle's points (0 for vertices): these
        identify a pair.
    data : (E, 35)
        The key without the vertices; elastic slip [m]; 1 if the pair slid in the last step; β (0 for points
        of obstacles), unit normal, Σ β_i x_i + Σ d_i (n · x_i) [m], contact point of an obstacle [m], normal
        force [N], factor of friction (`FACTOR`), k of the barrier [N/m], and d_i of all but the first vertex
        [m/m].
    stencil : (E, 4)
        Numbers of all vertices of the triangle, or of both edges.
    """

    key: Ints
    data: Array
    stencil: Ints


class ObstacleMotion(NamedTuple):
    """Motion of the obstacles in a step.

    Attributes
    ----------
    start, time : float
        Start and end of the step [s].
    motions : list of (3, 3) and (3,)
        Rotation and translation [m] of each obstacle from the time at which the pairs were found to the time
        of the forces. Pairs are found at the start of the step, or in statics after a part of a load step.
    end_points : (m, 3)
        Points [m] and normals of the obstacles at the end of the step.
    """

    start: float
    time: float
    motions: list[tuple[Array, Array]]
    end_points: Array


class EndFriction(NamedTuple):
    """Friction of the counted pairs in the equations of a step, and its limits at the end of the step.

    Attributes
    ----------
    points, beta : (m, 4)
        As in `Contacts`.
    tangents : (m, 2, 3)
        Unit vectors perpendicular to the normal and to each other.
    gradients : (m, 2, 4, 3)
        Gradients of the relative displacement along ``tangents`` with respect to the points' positions.
    normal_force : (m,)
        Normal force of the step [N], 0 for pairs that are no longer in contact.
    force, applied : (m, 2)
        Friction [N] along ``tangents`` in the equations of the step: that with which a pair of the end
        begins, and that of the pairs of the equations, which follow them and end.
    static, kinetic : (m,)
        Largest friction [N] of sticking pairs, and of sliding ones.
    slides, held : (m,)
        Whether the pair slides in the equations of the step, and whether it sticks in them.
    obstacle, velocity : (m,), (m, 3)
        As in `Contacts`.
    still : float
        Displacement [m] in a step up to which a sticking pair counts as at rest.
    """

    points: Ints
    beta: Array
    tangents: Array
    gradients: Array
    normal_force: Array
    force: Array
    applied: Array
    static: Array
    kinetic: Array
    slides: NDArray[np.bool_]
    held: NDArray[np.bool_]
    obstacle: Ints
    velocity: Array
    still: float


class StartingFriction(NamedTuple):
    """Friction of the counted pairs at the start of a step, in two tangential components.

    Attributes
    ----------
    points : (m, 4)
        Local rows of the vertices.
    gradients : (m, 2, 4, 3)
        Gradients of the relative displacement's components with respect to the points' positions.
    beta : (m, 4)
        As in `Contacts`, 0 for points of obstacles.
    weight, limit : (m,)
        Normal forces, in proportion to which masses are divided, and largest friction [N].
    force : (m, 2)
        Friction of the elastic slip, opposite to it [N].
    moved : (m, 2)
        Relative displacement in the step by the motion of the obstacle alone [m].
    """

    points: Ints
    gradients: Array
    beta: Array
    weight: Array
    limit: Array
    force: Array
    moved: Array


class _EndedStep(NamedTuple):
    """What friction is after a step that is not accepted yet.

    Attributes
    ----------
    time : float
        The end of the step [s].
    pairs : Pairs
        Pairs in contact there.
    loads : (obstacles, 8)
        As in `Elastic.obstacle_forces`.
    work : (n_vertices,)
        Heat [J] of sliding.
    """

    time: float
    pairs: Pairs
    loads: Array
    work: Array


ContactState = tuple[Pairs, Array, Array, float | None]
"""Pairs, heat (n_vertices,) [J] of sliding, loads of obstacles, and the time [s] at which pairs were found
after a part of a load step."""


def _no_pairs() -> Pairs:
    return Pairs(np.empty((0, 10), np.int64), np.empty((0, COLUMNS)), np.empty((0, 4), np.int64))


def _order(key: Ints) -> Ints:
    """Rows (E,) of keys (E, 10) in ascending order of the keys."""
    return sort_rows(np.arange(len(key)), key)


def _unpacked(data: Array) -> list[Array]:
    """Arrays for pairs with ``data`` (E, 35), as from `friction_pairs.unpack`."""
    shapes = (4,), (2, 3), (2, 4, 3), (2,), (3,), (3,)
    arrays = [np.empty((len(data), *shape)) for shape in shapes]
    friction_pairs.unpack(data, *arrays)
    return arrays


def _restored_pairs(
    vertices: Ints,
    values: Array,
    places_before: Mapping[str, tuple[int, int]],
    places: Mapping[str, tuple[int, int]],
) -> Pairs:
    """The pairs of a checkpoint with ``vertices`` (E, 4) and ``values`` as in `CoulombFriction.state`.

    Their obstacles had the numbers and first points ``places_before``, and now have ``places`` or are gone;
    `CoulombFriction.initialise_pairs` finds what is not in a checkpoint.
    """
    obstacle, kept = values[:, 1].copy(), np.ones(len(values), dtype=np.bool_)
    values = values.copy()
    for name, (number, first) in places_before.items():
        at = np.flatnonzero(obstacle == number)
        kept[at] = name in places
        values[at, 1], now = places.get(name, (number, first))
        points = values[at, 2:6]
        values[at, 2:6] = np.where(points < 0, points + (first - now), points)
    vertices, values = vertices[kept], values[kept]
    identity = values[:, :6].astype(np.int64)
    slip, edges, sheets = values[:, 6:9].copy(), identity[:, 0] == EDGE_EDGE, identity[:, 1] < 0
    # the order of vertices in an edge depends on their present numbers
    for rows, first in ((edges, 0), (edges & sheets, 2)):
        reversed_ = rows & (vertices[:, first] > vertices[:, first + 1])
        vertices[reversed_, first : first + 2] = vertices[reversed_, first : first + 2][:, ::-1]
    vertices[edges & ~sheets, 2:] = vertices[edges & ~sheets, :1]
    swapped = edges & sheets & (vertices[:, 0] > vertices[:, 2])
    vertices[swapped], slip[swapped] = vertices[swapped][:, [2, 3, 0, 1]], -slip[swapped]
    key = np.column_stack([vertices, identity])
    order = _order(key)
    zeros = np.zeros((len(key), COLUMNS - values.shape[1]))
    data = np.column_stack([identity, slip, values[:, 9], zeros])
    return Pairs(key[order], data[order], vertices[order])


def _move_with_obstacles(data: Array, motions: list[tuple[Array, Array]]) -> None:
    """Move the contact points of pairs ``data`` (E, 35), and rotate their slip, with the obstacles."""
    for obstacle, (rotation, translation) in enumerate(motions):
        rows = np.flatnonzero(data[:, 1] == obstacle)
        side = data[rows, BETA : BETA + 4].sum(axis=1)[:, None]
        point, slip = (data[rows, first : first + 3] for first in (CONTACT, SLIP))
        moved = point @ rotation.T + translation
        data[rows, START : START + 3] += side * (moved - point)
        data[rows, CONTACT : CONTACT + 3], data[rows, SLIP : SLIP + 3] = moved, slip @ rotation.T


class CoulombFriction(Stateful):
    """Friction of all pairs in contact during a step.

    Parameters
    ----------
    scene : Scene
    n_vertices : int
        Number of vertices that this rank owns.
    """

    def __init__(self, scene: Scene, n_vertices: int) -> None:
        assert scene.contact is not None
        self._sheet_friction = coefficients(scene.contact.friction)
        self._work = np.zeros(n_vertices)  # of friction [J]
        self._pairs = self._element_pairs = _no_pairs()
        self._contact_time: float | None = None  # [s], of the last part of a load step
        self._ended: _EndedStep | None = None  # until that step is accepted
        self._next_pairs: Pairs | None = None  # of the present Newton iterate
        self.pairs_have_changed = False
        super().__init__(Elements(np.empty((0, 4), dtype=np.int32)))
        self.set_pairs(self.stencil, np.empty((0, COLUMNS)), 0)

    def set_up(self, contact: ContactBarrier) -> None:
        """Take the contact term whose pairs have friction."""
        self._contact = contact
        each = [*(obstacle.friction for obstacle in contact.obstacles.each), self._sheet_friction]
        self._coefficients = np.array(each)
        self.obstacle_loads = np.zeros((len(contact.obstacles.each), 8))  # in the last step

    def set_pairs(self, stencil: NDArray[np.int32], data: Array, n_counted: int) -> None:
        """Take the pairs in contact with a vertex of this rank, in local rows ``stencil`` (E, 4), and their
        data (E, 35) as in `Pairs`; this rank counts the first ``n_counted``.
        """
        self.set_elements(Elements(stencil, n_owned=n_counted))
        n = len(data)
        unpacked = _unpacked(data)
        self._beta, self._tangents, self._gradients, self._constant, self._slip, self._contact_point = (
            unpacked
        )
        self._obstacle = data[:, 1].astype(np.int64)
        self._force = self._limit = self._stiffness = data[:, FORCE].copy()
        if n:
            static, kinetic = self._coefficients[self._obstacle].T
            self._limit = np.where(data[:, SLID] > 0.5, kinetic, static) * self._force
            max_elastic_slip = MAX_ELASTIC_SLIP * self._contact.barrier.gap
            softness = np.where(self._obstacle < 0, SHEET_SOFTNESS, 1.0)
            stiffness = softness * HALFWAY_CURVATURE * data[:, STIFFNESS]
            self._stiffness = np.maximum(stiffness, self._limit / max_elastic_slip)
            weakens = kinetic < static
            self._stiffness[weakens] = static[weakens] * self._force[weakens] / max_elastic_slip
            self._limit *= data[:, FACTOR]
            self._stiffness *= data[:, FACTOR]
        self._data_of: ObstacleMotion | None = None  # whose `_data` are stored

    @property
    def n_friction_pairs(self) -> int:
        """Number of pairs in contact that may stick or slide in the next step."""
        return len(self._pairs.key)

    # -- pairs -------------------------------------------------------------------------------------

    def current_pairs(self) -> tuple[Ints, Array]:
        """Global numbers of the vertices (E, 4) of the pairs that this rank counts in the step's equations,
        and their data (E, 35).
        """
        self.pairs_have_changed, self._element_pairs = False, self._next_pairs or self._pairs
        return self._element_pairs.stencil, self._element_pairs.data

    def begin_step(self) -> None:
        """Prepare for an attempt at a step from the accepted state."""
        self._next_pairs = None
        self.pairs_have_changed |= self._element_pairs is not self._pairs

    def changed_contacts(self, x: Array, start: Array, frozen: ObstacleMotion) -> tuple[float, float]:
        """Change of the normal forces of this rank's pairs since they were last taken, and their sum [N], at
        a Newton iterate x of a step from ``start``, (n_local, 3) each.
        """
        contact, given = self._contact, self._element_pairs
        if not contact.n_elements and not len(given.key):
            return 0.0, 0.0
        beta, normal, force, _, pair = contact.find_contacts(x, frozen.end_points, contact.n_owned)
        self._next_pairs = now = self._pairs_of(x, start, (beta, normal, force, pair), self._pairs)[0]
        rows = np.empty(len(now.key), dtype=np.int64)
        friction_pairs.match_pairs(now.key, given.key, given.data, rows)
        continued = np.bincount(rows + 1, now.data[:, FORCE], len(given.key) + 1)  # the first: none
        change = continued[0] + np.abs(continued[1:] - given.data[:, FORCE]).sum()
        return float(change), float(continued.sum())

    def take_contacts(self) -> None:
        """Take the pairs that `changed_contacts` found for the step's equations."""
        self.pairs_have_changed = True

    def _update_pairs(self, x: Array, obstacle_x: Array, old: Pairs) -> None:
        """Store the pairs in contact at x (n_local, 3) and obstacle_x (m, 3); those in ``old`` keep their
        elastic slip.
        """
        contact = self._contact
        if not contact.n_elements and not len(self._pairs.key):
            return
        beta, normal, force, _, pair = contact.find_contacts(x, obstacle_x, contact.n_owned)
        self._pairs, self.pairs_have_changed = self._pairs_of(x, x, (beta, normal, force, pair), old)[0], True

    def _pairs_of(
        self, x: Array, start: Array, contacts: tuple[Array, Array, Array, Ints], old: Pairs
    ) -> tuple[Pairs, Ints, Ints, Ints]:
        """The pairs of ``contacts`` (β, unit normals, normal forces, numbers of elements) at x, whose slip
        counts from ``start``, (n_local, 3) each.

        Returns also the numbers (E,) of their elements and contacts, and of the pairs in ``old`` that they
        continue, −1 for none; these keep their elastic slip.
        """
        contact, (beta, normal, force, pair) = self._contact, contacts
        beta, normal, pair = beta.copy(), normal.copy(), pair.copy()
        key = np.empty((len(pair), 10), dtype=np.int64)
        pair_data = contact.points, contact.number, contact.kind, contact.obstacle
        friction_pairs.choose_triangles(x, contact.stencil, *pair_data, beta, normal, pair)
        friction_pairs.write_keys(*pair_data, beta, pair, key)
        order = _order(key)
        key, previous, data = key[order], np.empty(len(pair), dtype=np.int64), np.empty((len(pair), COLUMNS))
        friction_pairs.match_pairs(key, old.key, old.data, previous)
        pair = pair[order]
        sorted_ = pair, beta[order], normal[order], force[order], contact.pair_stiffness[pair]
        friction_pairs.fill_columns(
            start, contact.stencil, contact.points, key, sorted_, previous, old.data, data
        )
        return Pairs(key, data, contact.number[pair]), pair, order, previous

    def initialise_pairs(self, x: Array, frozen: ObstacleMotion) -> None:
        """Store the pairs in contact at positions x (n_local, 3), where a run begins or is resumed."""
        self._update_pairs(x, frozen.end_points, self._pairs)

    def restore_pairs(self, vertices: Ints, values: Array, places: Mapping[str, tuple[int, int]]) -> None:
        """Restore the pairs of a `state` with a vertex of this rank; ``places`` are the numbers and first
        points that the obstacles had.
        """
        self._pairs = _restored_pairs(vertices, values, places, self._contact.obstacles.places)

    # -- a step ------------------------------------------------------------------------------------

    def freeze(self, step: UpcomingStep) -> ObstacleMotion:
        obstacles = self._contact.obstacles
        start = step.start if self._contact_time is None else self._contact_time
        motions = obstacles.rigid_motions(start, step.target_time)
        return ObstacleMotion(step.start, step.end, motions, obstacles.positions(step.end))

    def _tangential(self, vectors: Array, rows: Any = slice(None)) -> Array:
        """Tangential components (n, 2) of vectors (n, 3) at some pairs."""
        components: Array = np.einsum("eck,ek->ec", self._tangents[rows], vectors)
        return components

    def _kernel_data(self, motions: list[tuple[Array, Array]]) -> tuple[tuple[NDArray[Any], ...], Array]:
        """Arguments of the kernels after ``motions`` of the obstacles, and the elastic slip rotated with
        them.
        """
        constant, slip = self._constant, self._slip
        for obstacle, (rotation, translation) in enumerate(motions):
            if not translation.any() and (rotation == np.eye(3)).all():
                continue
            if constant is self._constant:
                constant, slip = constant.copy(), slip.copy()
            rows = self._obstacle == obstacle
            side, contact, old_slip = self._beta[rows].sum(axis=1), self._contact_point[rows], slip[rows]
            slip[rows] = old_slip @ rotation.T
            moved = side[:, None] * (contact @ rotation.T + translation - contact)
            constant[rows] += self._tangential(slip[rows] - old_slip - moved, rows)
        return (self.stencil, self._gradients, constant, self._stiffness, self._limit), slip

    def _data(self, frozen: ObstacleMotion) -> tuple[NDArray[Any], ...]:
        """Arguments of the kernels after the obstacles' motion."""
        if self._data_of is not frozen:
            self._data_of, (self._moved_data, _) = frozen, self._kernel_data(frozen.motions)
        return self._moved_data

    def _return_map(
        self, x: Array, state: tuple[NDArray[Any], ...], slip: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Elastic slip (E, 3) at positions x (n_local, 3), heat of sliding [J], and which pairs slide."""
        slip, heat, slides = slip.copy(), np.empty(len(slip)), np.empty(len(slip), dtype=np.bool_)
        friction_pairs.return_map(x, *state, self._tangents, slip, heat, slides)
        return slip, heat, slides

    def energies(self, x: Array, frozen: ObstacleMotion) -> Array:
        out = np.empty(self.n_owned)
        if not self.n_elements:
            return out
        friction_pairs.energies(x, *self._data(frozen), out)
        return out

    def work_of_targets(
        self, ends: tuple[Array, Array], frozen: tuple[ObstacleMotion, ObstacleMotion]
    ) -> float:
        # by forces: an obstacle moves by many times the elastic slip, so that energies would not do
        if not (self._contact.obstacles.moving and self.n_elements):
            return 0.0
        n, data = self.n_owned, [self._data(each) for each in frozen]
        slips, forces, energies = [], [], []
        for x, each, (stencil, gradients, constant, stiffness, limit) in zip(ends, frozen, data, strict=True):
            u = np.einsum("ecik,eik->ec", gradients, x[stencil]) + constant
            secant = np.minimum(stiffness, limit / np.maximum(np.linalg.norm(u, axis=1), 1e-300))
            slips.append(u[:n])
            forces.append((secant[:, None] * u)[:n])
            energies.append(self.energies(x, each)[:n])
        # the mean of the forces, with that part along the slip by which they do the work that is stored or
        # lost: from rest, friction reaches its limit long before the end of the step
        mean, slip = 0.5 * (forces[0] + forces[1]), slips[1] - slips[0]
        missing = energies[1] - energies[0] - np.einsum("ec,ec->e", mean, slip)
        square, of_both = (slip * slip).sum(axis=1), sum((u * u).sum(axis=1) for u in slips)
        # shorter slip is round-off
        mean += (missing / np.maximum(square, np.maximum(1e-16 * of_both, 1e-300)))[:, None] * slip
        return float(np.vdot(mean, (data[1][2] - data[0][2])[:n]))

    def add_gradient(self, x: Array, frozen: ObstacleMotion, out: Array) -> None:
        if self.n_elements:
            friction_pairs.add_gradient(x, *self._data(frozen), out)

    def add_hessian(self, x: Array, frozen: ObstacleMotion, into: Assembly) -> None:
        data = self._data(frozen)
        # the potential is convex; with a secant for sliding pairs equilibria would converge only linearly
        convexity = 0.0 if self._contact.static else into.convexity
        to = into.offsets[self.name], into.values
        friction_pairs.add_hessians(x, *data, into.weight, convexity, *to)

    def count_sticking(self, x: Array, frozen: ObstacleMotion) -> tuple[float, float, float]:
        """Numbers of sticking and of sliding pairs of this rank at x (n_local, 3), and the sum of their
        normal forces [N] in the step's equations.
        """
        owned, data = slice(self.n_owned), self._data(frozen)
        *_, slides = self._return_map(x, data, self._slip)
        sliding = float(np.count_nonzero(slides[owned]))
        return self.n_owned - sliding, sliding, float(self._force[owned].sum())

    def force_scale(self, size: float) -> Array:
        return self._stiffness * size

    def accept(self, x: Array, frozen: ObstacleMotion) -> None:
        self._contact_time = None
        if self._ended is not None and self._ended.time == frozen.time:  # not of a rejected attempt
            self._pairs, self.obstacle_loads, self.pairs_have_changed = (
                self._ended.pairs,
                self._ended.loads,
                True,
            )
            self._work += self._ended.work
        elif not self.n_elements:
            self.obstacle_loads = np.zeros_like(self.obstacle_loads)
            self._update_pairs(x, frozen.end_points, self._element_pairs)
        else:
            old, data, heat = self._moved_pairs(x, frozen)
            self.obstacle_loads, number = self._forces(x, data), self._obstacle[: self.n_owned]
            on = np.flatnonzero(number >= 0)
            slip = np.linalg.norm(old.data[:, SLIP:SLID], axis=1)
            np.add.at(self.obstacle_loads[:, 7], number[on], (self._stiffness[: self.n_owned] * slip)[on])
            np.add.at(self._work, self.stencil[: self.n_owned, 0], heat)
            self._update_pairs(x, frozen.end_points, old)
        self._ended = None

    def _moved_pairs(self, x: Array, frozen: ObstacleMotion) -> tuple[Pairs, tuple[NDArray[Any], ...], Array]:
        """The pairs of the step with their elastic slip at x (n_local, 3), arguments of the kernels, and the
        heat (n_owned,) [J] of sliding.
        """
        (data, slip), owned = self._kernel_data(frozen.motions), slice(self.n_owned)
        slip, heat, slides = self._return_map(x, data, slip)
        old = self._element_pairs.data.copy()
        old[:, SLIP:SLID], old[:, SLID] = slip[owned], slides[owned]
        return self._element_pairs._replace(data=old), data, heat[owned]

    def end_friction(
        self,
        x: Array,
        v: Array,
        frozen: ObstacleMotion,
        contacts: Contacts,
        normal_force: Array,
        last: tuple[float, float],
    ) -> EndFriction:
        """Friction at the end of a step to positions x, with velocities v (n_local, 3), in ``contacts`` whose
        normal forces in the step are ``normal_force`` (m,) [N]; ``last`` as in `ContactBarrier.contacts`.
        """
        old, data, _ = self._moved_pairs(x, frozen)
        found = contacts.beta, contacts.normal, contacts.force, contacts.pair
        pairs, pair, order, previous = self._pairs_of(x, x, found, old)
        self._ended = _EndedStep(frozen.time, pairs, self._forces(x, data), np.zeros_like(self._work))
        # several pairs that continue one share its friction in proportion to their normal forces; the last
        # row of these arrays, −1, is for those that continue none
        normal_force, owned = normal_force[order], slice(self.n_owned)
        total = np.bincount(previous % (len(old.key) + 1), normal_force, len(old.key) + 1)
        share = np.divide(
            normal_force, total[previous], out=np.zeros_like(normal_force), where=normal_force > 0.0
        )
        of_slip = np.zeros((len(old.key) + 1, 3))
        of_slip[:-1] = -self._stiffness[owned, None] * old.data[:, SLIP:SLID]
        arrays = _unpacked(pairs.data)
        beta, tangents, gradients = (
            np.concatenate([new, given[owned]])
            for new, given in zip(arrays[:3], (self._beta, self._tangents, self._gradients), strict=True)
        )
        force = np.concatenate([share[:, None] * of_slip[previous], of_slip[:-1]])
        force = np.einsum("eck,ek->ec", tangents, force)
        applied = force.copy()
        applied[: len(pairs.key)] = 0.0
        slides = pairs.data[:, SLID] > 0.5
        static, kinetic = self._coefficients[pairs.data[:, 1].astype(np.int64)].T
        limit, none = pairs.data[:, FACTOR] * normal_force, np.zeros(self.n_owned)
        before = self.stencil[owned].astype(np.int64), self._beta[owned], self._obstacle[owned]
        points = np.concatenate([self._contact.stencil[pair].astype(np.int64), before[0]])
        obstacle = np.concatenate([contacts.obstacle[order], before[2]])
        velocity = self._contact.obstacles.contact_velocities(x, v, *before, last)
        velocity = np.concatenate([contacts.velocity[order], velocity])
        return EndFriction(
            points,
            beta,
            tangents,
            gradients,
            np.concatenate([normal_force, none]),
            force,
            applied,
            np.concatenate([static * limit, none]),
            np.concatenate([kinetic * limit, none]),
            np.concatenate([slides, none == 0.0]),
            np.concatenate([~slides & (previous >= 0), none > 0.0]),
            obstacle,
            velocity,
            STILL * self._contact.barrier.gap,
        )

    def set_end_friction(
        self, friction: EndFriction, force: Array, sticks: NDArray[np.bool_], work: Array
    ) -> None:
        """Set friction (m, 2) [N] of the step in the pairs of an `end_friction`, which of them stick, and the
        heat (m,) [J] of sliding.
        """
        assert self._ended is not None
        pairs, loads, at_vertices = self._ended[1:]
        size, before = (np.linalg.norm(each, axis=1) for each in (force, friction.force))
        limit = np.where(sticks, friction.static, friction.kinetic)
        less = np.divide(limit, before, out=np.ones_like(size), where=before > limit)
        n = len(pairs.key)
        pairs.data[:, SLIP:SLID] *= less[:n, None]
        pairs.data[:, SLID] = ~sticks[:n]
        on = np.flatnonzero(friction.obstacle >= 0)
        np.add.at(loads[:, 7], friction.obstacle[on], size[on])
        np.add.at(at_vertices, friction.points[:, 0], work)

    def starting_friction(self, frozen: ObstacleMotion) -> StartingFriction:
        """Friction at the start of the step."""
        owned = slice(self.n_owned)
        gradients, beta = self._gradients[owned], self._beta[owned]
        (_, _, constant, stiffness, _), _ = self._kernel_data(frozen.motions)
        elastic = -(stiffness[:, None] * self._tangential(self._slip))[owned]
        moved, force = (constant - self._constant)[owned], self._force[owned]
        points = self.stencil[owned].astype(np.int64)
        return StartingFriction(points, gradients, beta, force, self._limit[owned], elastic, moved)

    def set_starting_friction(self, friction: Array) -> None:
        """Set the friction (m, 2) [N] of the pairs of `starting_friction`."""
        owned, data = slice(self.n_owned), self._pairs.data.copy()
        slip = np.einsum("eck,ec->ek", self._tangents[owned], -friction / self._stiffness[owned, None])
        data[:, SLIP:SLID] = slip
        self._pairs, self.pairs_have_changed = self._pairs._replace(data=data), True

    def accept_substep(
        self, x: Array, frozen: ObstacleMotion, start: tuple[Array, ContactState] | None
    ) -> Array:
        """Accept a part of a static load step that ended at positions x (n_local, 3).

        ``start``: positions (n_local, 3) [m] and `contact_state` at the start of the load step, if the slip
        of what touched then counts from there; else it goes on from that of the part before. Returns, with
        ``start``, of what has touched since: heat [J] and normal force [N] on this rank, and the normal force
        of all.
        """
        self.accept(x, frozen)
        self._contact_time = frozen.time  # otherwise the obstacles' motion would count twice
        if start is None or not len(self._pairs.key):
            return np.zeros(3)
        start_x, (old, work, _, time) = start
        contact = self._contact
        beta, normal, force, _, pair = contact.find_contacts(x, frozen.end_points, contact.n_owned)
        # the same pairs as now, with slip from the start
        pairs, pair, _, previous = self._pairs_of(x, start_x, (beta, normal, force, pair), old)
        motions = contact.obstacles.rigid_motions(frozen.start if time is None else time, frozen.time)
        _move_with_obstacles(pairs.data, motions)
        continued = np.flatnonzero(previous >= 0)
        self._pairs.data[continued] = pairs.data[continued]
        vertices = contact.stencil[pair[continued], 0]
        self._work[vertices] = work[vertices]
        force = self._pairs.data[:, FORCE]
        return np.array([(self._work - work).sum(), force[previous < 0].sum(), force.sum()])

    def friction_lag(self, x: Array, frozen: ObstacleMotion) -> dict[str, Array]:
        """How far friction is from the limit of the normal forces at positions x (n_local, 3).

        For each obstacle by its name, and between sheets (empty name), three sums [N] over this rank's
        vertices: error (friction beyond the limit, or below it where pairs slide), friction, limit.
        """
        names = [*(obstacle.name for obstacle in self._contact.obstacles.each), ""]
        (slip, _, slides), count = self._return_map(x, *self._kernel_data(frozen.motions)), len(names)
        owned, friction = slice(self.n_owned), self._stiffness * np.linalg.norm(slip, axis=1)
        _, _, force, _, pair = self._contact.find_contacts(x, frozen.end_points, self._contact.n_owned)

        def by_vertex(vertex: NDArray[np.int32], obstacle: Ints, each: Array) -> Array:
            bins, n_bins = vertex.astype(np.int64) * count + obstacle % count, len(self._work) * count
            return np.bincount(bins, each, n_bins).reshape(-1, count).astype(np.float64)

        acted = by_vertex(self._contact.stencil[pair, 0], self._contact.obstacle[pair], force)
        given, limit, friction, sliding = (
            by_vertex(self.stencil[owned, 0], self._obstacle[owned], each[owned])
            for each in (self._force, self._limit, friction, np.where(slides, friction, 0.0))
        )
        ratio = acted / np.maximum(given, np.finfo(float).tiny)
        error = np.maximum(friction - ratio * limit, np.maximum(ratio - 1.0, 0.0) * sliding)
        sums = np.stack([error.sum(axis=0), friction.sum(axis=0), (ratio * limit).sum(axis=0)], axis=1)
        return dict(zip(names, sums, strict=True))

    def slip_under_changed_forces(self, x: Array, dx: Array, frozen: ObstacleMotion) -> tuple[float, float]:
        """How far points slip while normal forces change, in a solve by dx (n_local, 3) [m] to x.

        Two sums over this rank's vertices: slip times the change of the normal force since friction was
        computed [J], and the larger of the normal forces before and after [N].
        """
        contact, n = self._contact, len(self._work)
        obstacles, motions, owned = contact.obstacles, frozen.motions, slice(self.n_owned)
        beta, normal, force, _, pair = contact.find_contacts(x, frozen.end_points, contact.n_owned)
        points, obstacle = contact.points[pair], contact.obstacle[pair]
        moved = obstacles.contact_displacements(x, points, beta, obstacle, motions)
        found = np.einsum("ei,eik->ek", np.where(points >= 0, beta, 0.0), dx[np.maximum(points, 0)]) - moved
        found -= np.einsum("ek,ek->e", found, normal)[:, None] * normal
        stencil, given = self.stencil[owned].astype(np.int64), self._force[owned]
        moved = obstacles.contact_displacements(x, stencil, self._beta[owned], self._obstacle[owned], motions)
        before = np.einsum("ecik,eik->ec", self._gradients[owned], dx[stencil])
        before -= self._tangential(moved, owned)

        def by_vertex(first: Ints, normal_force: Array, slip: Array) -> tuple[Array, Array]:
            total = np.bincount(first, normal_force, n).astype(np.float64)
            moment = np.bincount(first, normal_force * np.linalg.norm(slip, axis=1), n)
            return total, moment / np.maximum(total, np.finfo(float).tiny)

        after, slip_after = by_vertex(contact.stencil[pair, 0], force, found)
        given, slip_before = by_vertex(stencil[:, 0], given, before)
        slip = np.maximum(slip_after, slip_before)
        return float(np.vdot(np.abs(after - given), slip)), float(np.maximum(after, given).sum())

    def contact_state(self) -> ContactState:
        return self._pairs, self._work.copy(), self.obstacle_loads, self._contact_time

    def restore_contacts(self, state: ContactState) -> None:
        self._pairs, self._work, self.obstacle_loads, self._contact_time = state
        self.pairs_have_changed = True

    def _forces(self, x: Array, data: tuple[NDArray[Any], ...]) -> Array:
        """Force [N] on each obstacle and its torque [N m] about the origin by the owned pairs, (count, 8)."""
        number = self._obstacle[: self.n_owned]
        out = np.zeros((len(self._contact.obstacles.each), 8))
        for obstacle in np.unique(number[number >= 0]):
            rows, force = np.flatnonzero(number == obstacle), np.zeros_like(x)
            friction_pairs.add_gradient(x, *(part[rows] for part in data), force)
            out[obstacle, :6] = *force.sum(axis=0), *np.cross(x, force).sum(axis=0)
        return out

    def initialise(self, x: Array) -> None:
        """No pairs are in contact before the first step."""

    def state(self) -> dict[str, TermState]:
        """Pairs have their kind, obstacle and its points, elastic slip [m], and whether they slid."""
        pairs = self._pairs.data[:, : SLID + 1]
        return {
            "friction_work": TermState(Place.VERTEX, np.outer(self._work, [1.0, 0.0, 0.0])),
            "pairs": TermState(Place.ELEMENT, pairs, self._pairs.key[:, :4]),
        }

    def restore(self, values: Mapping[str, Array], x: Array) -> None:
        self._work = values["friction_work"][:, 0].copy()

    def history(self, x: Array, frozen: ObstacleMotion) -> Mapping[str, float]:
        return {"friction_work": float(self._work.sum())}


def elements(rest: RestShape) -> None:
    """None: there are no elements before anything is in contact."""


def make(elements: None, scene: Scene, mass: Array) -> CoulombFriction:
    """The term on one rank; `CoulombFriction.set_up` must be called next."""
    return CoulombFriction(scene, len(mass))
