"""Coulomb friction of all pairs in contact; ``friction_pairs`` has its potential in a time step.

Pairs, normals and normal forces are those of the last accepted state. A pair that is in contact again, or a
vertex that moved on to a neighbouring triangle, keeps its elastic slip, so that sticking pairs do not creep.
The owner of a pair's first vertex stores the pair and sends it to the owners of the others.

The equations of a step use the normal forces at its start. Where other forces act in the step, the difference
is added up for each sliding vertex as an impulse that is owed. At the end of each step a part of it is paid,
and all of it when the vertex leaves (`CoulombFriction.friction_corrections`, `stepping.impacts`), so that
friction adds up to μ times the impulse of the normal forces. Otherwise a sheet that lands on a slope would
keep the velocity that its weight gives it in a step, and only the friction in excess of that would stop it.
Between sheets, where normal forces oscillate and a knot would need 40 % more Newton iterations, this is done
only if the stage is before the end of the step, so that the forces differ systematically.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.sorting import sort_rows
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene, coefficients
from lyra_petsc.terms.contact import friction_pairs
from lyra_petsc.terms.contact.barrier import HALFWAY_CURVATURE, ContactBarrier
from lyra_petsc.terms.contact.contact_pairs import EDGE_EDGE
from lyra_petsc.terms.contact.friction_pairs import COLUMNS, FACTOR, FORCE, SLID, STIFFNESS
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Elastic, FrictionCorrections, Offsets, StartingFriction, UpcomingStep

WORK, OWED = 0, 1
"""Columns of the data of vertices: work of friction [J]; impulse of normal forces [N s] whose friction is
owed."""

IS_WORK = np.arange(3) == WORK
"""Mask of the column of the work."""

PAID_FRACTION = 0.25
"""Part of the owed impulse that is paid in a step: with all of it at once friction would oscillate."""

MAX_ELASTIC_SLIP = 0.01
"""Largest slip of a sticking pair over the gap. If the kinetic coefficient is below the static one, all pairs
have this elastic slip: if lightly pressed pairs, such as those at a sheet's border, slid before the others,
the sheet would slide too early. Otherwise lightly pressed pairs have a shorter one, because they have to
build it up again whenever they separate and come back."""

OVERSHOOT = 0.3
"""Part by which the static limit may be exceeded to stop a sticking pair in a step, if the kinetic
coefficient is lower: integrators of second order overshoot in steps longer than the period of the friction
springs."""

STILL = 1e-6
"""Displacement in a step, over the largest elastic slip, up to which a sticking pair is not stopped: without
the round-off in the velocities, Newton's method would start where round-off leaves it no smaller energy."""

NOTHING_CORRECTED = -np.inf, 0.0, 0.0
"""Corrections of friction before any step: its end [s], impulses [N s] owed and work [J] of impulses."""

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
    time : float
        The end of the step [s].
    stage_fraction : float
        Time from the start of the step to its stage over the length of the step; 1 also for a stage at the
        start.
    stage_motions, end_motions : list of (3, 3) and (3,)
        Rotation and translation [m] of each obstacle from the time at which the pairs were found to the time
        of the forces, and to the end of the step. Pairs are found at the start of the step, or in statics
        after a part of a load step.
    stage_points, end_points : (m, 3)
        Points [m] and normals of the obstacles at the stage, and at the end.
    """

    time: float
    stage_fraction: float
    stage_motions: list[tuple[Array, Array]]
    end_motions: list[tuple[Array, Array]]
    stage_points: Array
    end_points: Array


def _no_pairs() -> Pairs:
    return Pairs(np.empty((0, 10), np.int64), np.empty((0, COLUMNS)), np.empty((0, 4), np.int64))


def _order(key: Ints) -> Ints:
    """Rows (E,) of keys (E, 10) in ascending order of the keys."""
    return sort_rows(np.arange(len(key)), key, np.empty((len(key), 0)), 0)


class CoulombFriction(Elastic):
    """Friction of all pairs in contact during a step.

    Parameters
    ----------
    scene : Scene
    n_vertices : int
        Number of vertices that this rank owns.
    """

    slips = True

    def __init__(self, scene: Scene, n_vertices: int) -> None:
        assert scene.contact is not None
        self._sheet_friction = coefficients(scene.contact.friction)
        self._vertex_data = np.zeros((n_vertices, 3))
        self._pairs = self._element_pairs = _no_pairs()
        self._contact_time: float | None = None  # [s], of the last part of a load step
        # until a step is accepted: its end, the impulses owed after it, and the work of its impulses
        self._corrected: tuple[float, Array | float, Array | float] = NOTHING_CORRECTED
        self.stale = False
        super().__init__(Elements(np.empty((0, 4), dtype=np.int32), {"what": np.empty((0, COLUMNS))}))

    def set_up(self, contact: ContactBarrier) -> None:
        """Take the contact term whose pairs have friction."""
        self._contact = contact
        each = [*(obstacle.friction for obstacle in contact.obstacles.each), self._sheet_friction]
        self._coefficients = np.array(each)
        self._obstacle_loads = np.zeros((len(contact.obstacles.each), 6))  # in the last step

    def set_elements(self, elements: Elements) -> None:
        super().set_elements(elements)
        data = elements.data["what"].reshape(-1, COLUMNS)
        n = len(data)
        shapes = (4,), (2, 3), (2, 4, 3), (2,), (3,), (3,)
        arrays = [np.empty((n, *shape)) for shape in shapes]
        friction_pairs.unpack(data, *arrays)
        self._beta, self._tangents, self._gradients, self._constant, self._slip, self._contact_point = arrays
        self._obstacle = data[:, 1].astype(np.int64)
        has_vertex = (data[:, 0] != EDGE_EDGE) & (data[:, 2] == 0.0)
        self._vertex = np.where(has_vertex, self.stencil[:, 0], -1)
        self._force = self._limit = self._stiffness = data[:, FORCE].copy()
        self._weakens = np.zeros(n, dtype=np.bool_)
        if n:
            static, kinetic = self._coefficients[self._obstacle].T
            self._limit = np.where(data[:, SLID] > 0.5, kinetic, static) * self._force
            max_elastic_slip = MAX_ELASTIC_SLIP * self._contact.barrier.gap
            softness = np.where(self._obstacle < 0, SHEET_SOFTNESS, 1.0)
            stiffness = softness * HALFWAY_CURVATURE * data[:, STIFFNESS]
            self._stiffness = np.maximum(stiffness, self._limit / max_elastic_slip)
            self._weakens = weakens = kinetic < static
            self._stiffness[weakens] = static[weakens] * self._force[weakens] / max_elastic_slip
            self._limit *= data[:, FACTOR]
            self._stiffness *= data[:, FACTOR]
        self._stage_of: ObstacleMotion | None = None  # whose `_stage_data` are stored

    @property
    def n_friction_pairs(self) -> int:
        return len(self._pairs.key)

    # -- pairs -------------------------------------------------------------------------------------

    def current_elements(self) -> tuple[Ints, Array]:
        self.stale, self._element_pairs = False, self._pairs
        return self._pairs.stencil, self._pairs.data

    def _update_pairs(self, x: Array, obstacle_x: Array, old: Pairs) -> None:
        """Store the pairs in contact at x (n_local, 3) and obstacle_x (m, 3); those in ``old`` keep their
        elastic slip.
        """
        contact = self._contact
        if not contact.n_elements and not len(self._pairs.key):
            return
        beta, normal, force, pair = contact.find_contacts(x, obstacle_x, contact.n_owned)
        key = np.empty((len(pair), 10), dtype=np.int64)
        pair_data = contact.points, contact.number, contact.kind, contact.obstacle
        friction_pairs.choose_triangles(x, contact.stencil, *pair_data, beta, normal, pair)
        friction_pairs.write_keys(*pair_data, beta, pair, key)
        order = _order(key)
        key, previous, data = key[order], np.empty(len(pair), dtype=np.int64), np.empty((len(pair), COLUMNS))
        friction_pairs.match_pairs(key, old.key, old.data, previous)
        pair = pair[order]
        contacts = pair, beta[order], normal[order], force[order], contact.pair_stiffness[pair]
        friction_pairs.fill_columns(
            x, contact.stencil, contact.points, key, contacts, previous, old.data, data
        )
        self._pairs, self.stale = Pairs(key, data, contact.number[pair]), True

    def initialise_pairs(self, x: Array, frozen: ObstacleMotion) -> None:
        self._update_pairs(x, frozen.end_points, self._pairs)

    def element_state(self) -> tuple[Ints, Array]:
        """Vertices of counted pairs; their kind, obstacle and its points, elastic slip [m], and whether they
        slid.
        """
        return self._pairs.key[:, :4], self._pairs.data[:, : SLID + 1]

    @property
    def obstacle_places(self) -> Mapping[str, tuple[int, int]]:
        return self._contact.obstacles.places

    def restore_elements(
        self, vertices: Ints, values: Array, own: range, places: Mapping[str, tuple[int, int]]
    ) -> None:
        obstacle, kept = values[:, 1].copy(), np.ones(len(values), dtype=np.bool_)
        values = values.copy()
        for name, (number, first) in places.items():  # the scene's obstacles may be others, in another order
            at = np.flatnonzero(obstacle == number)
            kept[at] = name in self.obstacle_places
            values[at, 1], now = self.obstacle_places.get(name, (number, first))
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
        # `initialise_pairs` finds the zeros
        zeros = np.zeros((len(key), COLUMNS - values.shape[1]))
        rows = np.column_stack([identity, slip, values[:, 9], zeros])
        self._pairs = Pairs(key[order], rows[order], vertices[order])

    # -- a step ------------------------------------------------------------------------------------

    def freeze(self, step: UpcomingStep) -> ObstacleMotion:
        obstacles, fraction = self._contact.obstacles, 1.0
        start = step.start if self._contact_time is None else self._contact_time
        end_motions = stage_motions = obstacles.rigid_motions(start, step.end)
        if step.start < step.target_time < step.end:
            fraction = (step.target_time - step.start) / (step.end - step.start)
        elif step.target_time < step.end:
            stage_motions = obstacles.rigid_motions(start, step.target_time)
        (_, stage_points, end_points), _ = obstacles.step_positions(step.start, step.target_time, step.end)
        return ObstacleMotion(step.end, fraction, stage_motions, end_motions, stage_points, end_points)

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

    def _stage_data(self, frozen: ObstacleMotion) -> tuple[NDArray[Any], ...]:
        """Arguments of the kernels for positions of the stage.

        The stage is at a fraction a of the step. The potential is a D, with D at the positions at the end of
        the step that follow from those of the stage, so that its gradient is that of D there. Otherwise
        sticking pairs would oscillate for ever with the midpoint rule.
        """
        if self._stage_of is not frozen:
            self._stage_of, fraction = frozen, frozen.stage_fraction
            (stencil, gradients, constant, stiffness, limit), _ = self._kernel_data(frozen.stage_motions)
            if fraction != 1.0:
                constant = constant + (1.0 / fraction - 1.0) * (self._constant - self._tangential(self._slip))
                gradients, stiffness, limit = gradients / fraction, fraction * stiffness, fraction * limit
            self._stage = stencil, gradients, constant, stiffness, limit
        return self._stage

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
        friction_pairs.energies(x, *self._stage_data(frozen), out)
        return out

    def work_of_targets(
        self, ends: tuple[Array, Array], frozen: tuple[ObstacleMotion, ObstacleMotion]
    ) -> float:
        # by forces: an obstacle moves by many times the elastic slip, so that energies would not do
        if not (self._contact.obstacles.moving and self.n_elements):
            return 0.0
        n, data = self.n_owned, [self._stage_data(each) for each in frozen]
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
            friction_pairs.add_gradient(x, *self._stage_data(frozen), out)

    def add_hessian(
        self,
        x: Array,
        frozen: ObstacleMotion,
        blend: float,
        weight: Array,
        offsets: Mapping[str, Offsets],
        values: Array,
        predicted: tuple[Array, Array] | None = None,
    ) -> None:
        data = self._stage_data(frozen)
        # the potential is convex; with a secant for sliding pairs equilibria would converge only linearly
        blend = 0.0 if self._contact.static else blend
        friction_pairs.add_hessians(x, *data, weight, blend, offsets[self.name], values)

    def count_sticking(self, x: Array, frozen: ObstacleMotion) -> tuple[float, float, float]:
        """Numbers of sticking and of sliding pairs of this rank at x (n_local, 3), and the sum of their
        normal forces [N] in the step's equations.
        """
        owned, data = slice(self.n_owned), self._stage_data(frozen)
        *_, slides = self._return_map(x, data, self._slip)
        sliding = float(np.count_nonzero(slides[owned]))
        return self.n_owned - sliding, sliding, float(self._force[owned].sum())

    def force_scale(self, size: float) -> Array:
        return self._stiffness * size

    def accept(self, x: Array, frozen: ObstacleMotion) -> None:
        self._contact_time = None
        # not those of a rejected attempt
        _, owed, work = self._corrected if self._corrected[0] == frozen.time else NOTHING_CORRECTED
        self._vertex_data[:, OWED] = owed
        self._vertex_data[:, WORK] += work
        self._corrected = NOTHING_CORRECTED
        if not self.n_elements:
            self._obstacle_loads = np.zeros_like(self._obstacle_loads)
            self._update_pairs(x, frozen.end_points, self._element_pairs)
            return
        data, slip = self._kernel_data(frozen.end_motions)
        self._obstacle_loads = self._forces(x, data)
        slip, heat, slides = self._return_map(x, data, slip)
        first = self.stencil[: self.n_owned, 0]
        np.add.at(self._vertex_data[:, WORK], first, heat[: self.n_owned])
        old = self._element_pairs.data.copy()
        old[:, friction_pairs.SLIP : SLID], old[:, SLID] = slip[: self.n_owned], slides[: self.n_owned]
        self._update_pairs(x, frozen.end_points, self._element_pairs._replace(data=old))

    def friction_corrections(
        self,
        stage: Array,
        x: Array,
        v: Array,
        frozen: ObstacleMotion,
        normal_force: Array,
        dt: float,
        *,
        sheets: bool,
        last: tuple[float, float],
    ) -> FrictionCorrections:
        contact = self._contact
        *_, force, pair = contact.find_contacts(stage, frozen.stage_points, contact.n_owned)
        vertex = contact.vertex_of(pair)
        counted = (vertex >= 0) & (sheets | (contact.obstacle[pair] >= 0))
        slip, _, slides = self._return_map(x, *self._kernel_data(frozen.end_motions))
        considered = np.flatnonzero(((self._vertex >= 0) & (sheets | (self._obstacle >= 0)))[: self.n_owned])
        sliding = considered[slides[considered]]
        # normal forces of vertices: at the stage; in the step's equations; in these of sliding pairs
        acted, given, slid = (
            np.bincount(first, each, minlength=len(self._vertex_data))
            for first, each in (
                (vertex[counted], force[counted]),
                (self._vertex[considered], self._force[considered]),
                (self._vertex[sliding], self._force[sliding]),
            )
        )
        owed = self._vertex_data[:, OWED] / dt + acted + normal_force[: len(acted)] - given
        # vertices may come near after the stage, or leave
        *_, pair = contact.find_contacts(x, frozen.end_points, contact.n_owned)
        touches = np.isin(np.arange(len(acted)), contact.vertex_of(pair))
        paid = np.where(slid > 0.0, np.where(touches, PAID_FRACTION, 1.0) * owed, 0.0)
        # sticking pairs are owed nothing, new contacts get everything later
        is_owed = touches & ((slid > 0.0) | (given == 0.0))
        self._corrected = frozen.time, np.where(is_owed, dt * (owed - paid), 0.0), 0.0
        paid_fraction = paid / np.maximum(slid, np.finfo(float).tiny)
        missing = self._limit[sliding] * paid_fraction[self._vertex[sliding]]
        # sticking pairs are stopped at once: their springs would throw a sheet back that lands with a sliding
        # speed, and oscillating springs would pull with twice the static force
        owned = slice(self.n_owned)
        points = self.stencil[owned].astype(np.int64)
        beta, obstacle = self._beta[owned], self._obstacle[owned]
        # impulses act at the end of the step, when obstacles may be faster than in the mean
        motions = contact.obstacles.rigid_motions(*last)
        moved = contact.obstacles.contact_displacements(x, points, beta, obstacle, motions)
        moved *= dt / (last[1] - last[0])
        velocity = np.einsum("ecik,eik->ec", self._gradients[owned], v[points])
        velocity -= self._tangential(moved / dt, owned)
        still = STILL * MAX_ELASTIC_SLIP * contact.barrier.gap
        sticking = np.flatnonzero(~slides[owned] & (dt * np.linalg.norm(velocity, axis=1) > still))
        rows = np.concatenate([sliding, sticking])
        tangential = np.concatenate([self._tangential(slip[sliding], sliding), velocity[sticking]])
        length = np.linalg.norm(tangential, axis=1, keepdims=True)
        unit = np.divide(tangential, length, out=np.zeros_like(tangential), where=length > 0.0)
        # friction reaches its limit with what is available against the motion
        limit = np.where(self._weakens[sticking], 1.0 + OVERSHOOT, 1.0) * self._limit[sticking]
        elastic = -self._stiffness[sticking, None] * self._tangential(slip[sticking], sticking)
        along = (elastic * unit[len(sliding) :]).sum(axis=1)
        rest = along * along + limit * limit - (elastic * elastic).sum(axis=1)
        available = along + np.sqrt(np.maximum(rest, 0.0))
        return FrictionCorrections(
            points[rows],
            beta[rows],
            self._force[rows],
            np.einsum("ec,eck->ek", unit, self._tangents[rows]),
            np.einsum("ec,ecim->eim", unit, self._gradients[rows]),
            np.concatenate([missing, available]),
            obstacle[rows],
            moved[rows],
        )

    def set_impulse_work(self, vertex: Ints, work: Array) -> None:
        at_vertices = np.zeros(len(self._vertex_data))
        np.add.at(at_vertices, vertex, work)
        self._corrected = *self._corrected[:2], at_vertices

    def starting_friction(self, frozen: ObstacleMotion) -> StartingFriction:
        owned = slice(self.n_owned)
        gradients, beta = self._gradients[owned], self._beta[owned]
        # a gradient β t + (d · t) n is longest for t along d, and has the length |β| for t perpendicular to d
        size = np.sqrt(np.maximum((gradients * gradients).sum(axis=(1, 3)) - beta * beta, 0.0))
        (_, _, constant, stiffness, limit), _ = self._kernel_data(frozen.end_motions)
        elastic = -(stiffness[:, None] * self._tangential(self._slip))[owned]
        moved, force = (constant - self._constant)[owned], self._force[owned]
        points = self.stencil[owned].astype(np.int64)
        return StartingFriction(points, gradients, size, force, limit[owned], elastic, moved)

    def moments(self, x: Array, frozen: ObstacleMotion) -> tuple[Ints, Array]:
        rows = np.flatnonzero(self._obstacle[: self.n_owned] < 0)
        stencil, *state = (part[rows] for part in self._stage_data(frozen))
        moments = np.zeros((len(rows), 3))
        friction_pairs.add_moments(x, stencil, *state, moments)
        return stencil, -moments

    def accept_substep(self, x: Array, frozen: ObstacleMotion) -> None:
        self.accept(x, frozen)
        self._contact_time = frozen.time  # otherwise the obstacles' motion would count twice

    def friction_lag(self, x: Array, frozen: ObstacleMotion) -> dict[str, Array]:
        names = [*(obstacle.name for obstacle in self._contact.obstacles.each), ""]
        (slip, _, slides), count = self._return_map(x, *self._kernel_data(frozen.end_motions)), len(names)
        owned, friction = slice(self.n_owned), self._stiffness * np.linalg.norm(slip, axis=1)
        *_, force, pair = self._contact.find_contacts(x, frozen.end_points, self._contact.n_owned)

        def by_vertex(vertex: NDArray[np.int32], obstacle: Ints, each: Array) -> Array:
            bins, n_bins = vertex.astype(np.int64) * count + obstacle % count, len(self._vertex_data) * count
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
        contact, n = self._contact, len(self._vertex_data)
        obstacles, motions, owned = contact.obstacles, frozen.end_motions, slice(self.n_owned)
        beta, normal, force, pair = contact.find_contacts(x, frozen.end_points, contact.n_owned)
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

    def contact_state(self) -> tuple[Pairs, Array, Array, float | None]:
        return self._pairs, self._vertex_data.copy(), self._obstacle_loads, self._contact_time

    def restore_contacts(self, state: tuple[Pairs, Array, Array, float | None]) -> None:
        self._pairs, self._vertex_data, self._obstacle_loads, self._contact_time = state
        self.stale = True

    def _forces(self, x: Array, data: tuple[NDArray[Any], ...]) -> Array:
        """Force [N] on each obstacle and its torque [N m] about the origin by the owned pairs, (count, 6)."""
        number = self._obstacle[: self.n_owned]
        out = np.zeros((len(self._contact.obstacles.each), 6))
        for obstacle in np.unique(number[number >= 0]):
            rows, force = np.flatnonzero(number == obstacle), np.zeros_like(x)
            friction_pairs.add_gradient(x, *(part[rows] for part in data), force)
            out[obstacle] = *force.sum(axis=0), *np.cross(x, force).sum(axis=0)
        return out

    def obstacle_forces(self, x: Array, frozen: ObstacleMotion, count: int) -> Array:
        return self._obstacle_loads[:count]

    def state(self) -> dict[str, Array]:
        return {"friction_work": self._vertex_data * IS_WORK, "friction_owed": self._vertex_data * ~IS_WORK}

    def restore(self, state: Mapping[str, Array]) -> None:
        self._vertex_data = state["friction_work"] * IS_WORK + state["friction_owed"]

    def history(self, x: Array, frozen: ObstacleMotion) -> Mapping[str, float]:
        return {"friction_work": float(self._vertex_data[:, WORK].sum())}


def elements(rest: RestShape) -> None:
    """None: there are no elements before anything is in contact."""


def make(elements: None, scene: Scene, mass: Array) -> CoulombFriction:
    """The term on one rank; `CoulombFriction.set_up` must be called next."""
    return CoulombFriction(scene, len(mass))
