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
from lyra_petsc.kernels.sorting import ascending
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene, coefficients
from lyra_petsc.terms import friction_pairs
from lyra_petsc.terms.contact import HALFWAY_CURVATURE, ContactBarrier
from lyra_petsc.terms.contact_pairs import EDGE_EDGE
from lyra_petsc.terms.friction_pairs import COLUMNS, FORCE, GRIP, SLID
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Elastic, FrictionCorrections, Offsets, UpcomingStep

WORK, OWED = 0, 1
"""Columns of what is known of vertices: work of friction [J]; impulse of normal forces [N s] that friction
has not followed yet."""

HEAT = np.arange(3) == WORK
"""Which column is that of the work."""

PAID = 0.25
"""Part of that which is made up for in a step: all at once would make friction tremble."""

ELASTIC = 0.01
"""Part of the gap that a pair which sticks may go before it slides, at most. Where less holds what slides
than what sticks, all go as far: if what is pressed least, as a sheet's border, slid before the rest, the
sheet would follow long before it has to. Else light pairs go less far, as they must again whenever they part
and meet."""

BESIDE = 0.3
"""By how much more than friction may stop what sticks in a step, over that, where less holds what slides:
formulas of second order overshoot in steps longer than its springs swing."""

SOFTER = 0.25
"""Stiffness between sheets over that on obstacles, of pairs which are pressed little: springs as stiff as the
barrier halfway through the gap turn sheets by much, and take up to 1.4 times as many Newton iterations."""


class Pairs(NamedTuple):
    """Pairs in contact at an accepted state, those that this rank counts, with ascending keys.

    Attributes
    ----------
    key : (E, 10)
        Numbers of the vertices, kind, obstacle, its points (0 for vertices): what tells a pair from others.
    what : (E, 34)
        The key without the vertices; elastic part of the way so far [m]; 1 if it slid in the last step; β (0
        for obstacles' points), unit normals, Σ β_i x_i [m] and, between sheets, Σ d_i (n · x_i), where an
        obstacle is touched [m], normal force [N], the part of it that rubs, d_i of all but the first [m/m].
    stencil : (E, 4)
        Numbers of all vertices of the triangle, or of both edges.
    """

    key: Ints
    what: Array
    stencil: Ints


class ObstacleMoves(NamedTuple):
    """How obstacles move in a step.

    Attributes
    ----------
    time : float
        The end of the step [s].
    part : float
        Of the step, up to its stage; 1 also at its start.
    stage, end : list of (3, 3) and (3,)
        Rotation and translation [m] of each from where pairs were taken, the start of the step but on the way
        of a static load step, to where friction is asked, and to the end.
    now, places : (m, 3)
        Their points and normals at the stage, and at the end.
    """

    time: float
    part: float
    stage: list[tuple[Array, Array]]
    end: list[tuple[Array, Array]]
    now: Array
    places: Array


def _no_pairs() -> Pairs:
    return Pairs(np.empty((0, 10), np.int64), np.empty((0, COLUMNS)), np.empty((0, 4), np.int64))


def _order(key: Ints) -> Ints:
    """Numbers (E,) of keys (E, 10) in ascending order."""
    return ascending(np.arange(len(key)), key, key, 0)


class CoulombFriction(Elastic):
    """Friction in a step.

    Parameters
    ----------
    scene : Scene
    n_vertices : int
        That this rank owns.
    """

    slips = True

    def __init__(self, scene: Scene, n_vertices: int) -> None:
        assert scene.contact is not None
        self._common = coefficients(scene.contact.friction)
        self._heat = np.zeros((n_vertices, 3))
        self._pairs = self._known = _no_pairs()
        self._taken_at: float | None = None  # [s], where obstacles stood on the way of a load step
        self._owed: Array | None = None  # after the step, until that is accepted
        self.stale = False
        super().__init__(Elements(np.empty((0, 4), dtype=np.int32), {"what": np.empty((0, COLUMNS))}))

    def set_up(self, contact: ContactBarrier) -> None:
        """Know the contact whose pairs rub."""
        self._contact = contact
        each = [*(obstacle.friction for obstacle in contact.obstacles.each), self._common]
        self._coefficients = np.array(each)
        self._on_obstacles = np.zeros((len(contact.obstacles.each), 6))  # in the last step
        self._stiffest = HALFWAY_CURVATURE * contact.barrier.stiffness

    def set_elements(self, elements: Elements) -> None:
        super().set_elements(elements)
        what = elements.data["what"].reshape(-1, COLUMNS)
        n = len(what)
        self._beta, self._tangents, self._ways = np.empty((n, 4)), np.empty((n, 2, 3)), np.empty((n, 2, 4, 3))
        self._still, self._slip, self._foot = np.empty((n, 2)), np.empty((n, 3)), np.empty((n, 3))
        taken = self._beta, self._tangents, self._ways, self._still, self._slip, self._foot
        friction_pairs.unpack(what, *taken)
        self._obstacle = what[:, 1].astype(np.int64)
        of_vertex = (what[:, 0] != EDGE_EDGE) & (what[:, 2] == 0.0)
        self._vertex = np.where(of_vertex, self.stencil[:, 0], -1)
        self._force = self._limit = self._spring = what[:, FORCE].copy()
        self._drops = np.zeros(n, dtype=np.bool_)
        if n:
            static, kinetic = self._coefficients[self._obstacle].T
            self._limit = np.where(what[:, SLID] > 0.5, kinetic, static) * self._force
            longest = ELASTIC * self._contact.barrier.gap
            stiffest = np.where(self._obstacle < 0, SOFTER, 1.0) * self._stiffest
            self._spring = np.maximum(stiffest, self._limit / longest)
            self._drops = drops = kinetic < static
            self._spring[drops] = static[drops] * self._force[drops] / longest
            self._limit, self._spring = (what[:, GRIP] * each for each in (self._limit, self._spring))
        self._of: ObstacleMoves | None = None  # what is remembered of a stage

    @property
    def n_friction_pairs(self) -> int:
        return len(self._pairs.key)

    # -- pairs -------------------------------------------------------------------------------------

    def current_elements(self) -> tuple[Ints, Array]:
        self.stale, self._known = False, self._pairs
        return self._pairs.stencil, self._pairs.what

    def _renew(self, x: Array, places: Array, old: Pairs) -> None:
        """Take the pairs that touch at positions x (n_local, 3) and obstacles' points; ``old`` ones go on."""
        contact = self._contact
        if not contact.n_elements and not len(self._pairs.key):
            return
        beta, normal, force, at = contact.find_contacts(x, places, contact.n_owned)
        key = np.empty((len(at), 10), dtype=np.int64)
        pairs = contact.points, contact.number, contact.kind, contact.obstacle
        friction_pairs.choose(x, contact.stencil, *pairs, beta, normal, at)
        friction_pairs.keys(*pairs, beta, at, key)
        order = _order(key)
        key, same, what = key[order], np.empty(len(at), dtype=np.int64), np.empty((len(at), COLUMNS))
        friction_pairs.find(key, old.key, old.what, same)
        touching = at[order], beta[order], normal[order], force[order]
        friction_pairs.describe(x, contact.stencil, contact.points, key, touching, same, old.what, what)
        self._pairs, self.stale = Pairs(key, what, contact.number[at[order]]), True

    def initialise_pairs(self, x: Array, frozen: ObstacleMoves) -> None:
        self._renew(x, frozen.places, self._pairs)

    def element_state(self) -> tuple[Ints, Array]:
        """Vertices of counted pairs; their kind, obstacle, its points, slip [m], and whether they slid."""
        return self._pairs.key[:, :4], self._pairs.what[:, : SLID + 1]

    def restore_elements(self, vertices: Ints, values: Array, own: range) -> None:
        vertices, what = vertices.copy(), values[:, :6].astype(np.int64)
        slip, edges, sheets = values[:, 6:9].copy(), what[:, 0] == EDGE_EDGE, what[:, 1] < 0
        # edges are named in the order of the present numbers
        for rows, first in ((edges, 0), (edges & sheets, 2)):
            turned = rows & (vertices[:, first] > vertices[:, first + 1])
            vertices[turned, first : first + 2] = vertices[turned, first : first + 2][:, ::-1]
        vertices[edges & ~sheets, 2:] = vertices[edges & ~sheets, :1]
        swapped = edges & sheets & (vertices[:, 0] > vertices[:, 2])
        vertices[swapped], slip[swapped] = vertices[swapped][:, [2, 3, 0, 1]], -slip[swapped]
        key = np.column_stack([vertices, what])
        order = _order(key)
        # `initialise_pairs` finds the rest
        rest = np.zeros((len(key), COLUMNS - values.shape[1]))
        rows = np.column_stack([what, slip, values[:, 9], rest])
        self._pairs = Pairs(key[order], rows[order], vertices[order])

    # -- a step ------------------------------------------------------------------------------------

    def freeze(self, step: UpcomingStep) -> ObstacleMoves:
        obstacles, part = self._contact.obstacles, 1.0
        start = step.start if self._taken_at is None else self._taken_at
        end = stage = obstacles.rigid_motions(start, step.end)
        if step.start < step.target_time < step.end:
            part = (step.target_time - step.start) / (step.end - step.start)
        elif step.target_time < step.end:
            stage = obstacles.rigid_motions(start, step.target_time)
        places = obstacles.positions(step.end)
        now = obstacles.positions(step.target_time) if obstacles.moving else places
        return ObstacleMoves(step.end, part, stage, end, now, places)

    def _along(self, vectors: Array, of: Any = slice(None)) -> Array:
        """Components (n, 2) of vectors (n, 3) across the normals of some pairs."""
        found: Array = np.einsum("eck,ek->ec", self._tangents[of], vectors)
        return found

    def _state(self, moved: list[tuple[Array, Array]]) -> tuple[tuple[NDArray[Any], ...], Array]:
        """What the kernels take, with obstacles moved so, and what sticks to them; the elastic parts."""
        still, slip = self._still, self._slip
        for obstacle, (rotation, translation) in enumerate(moved):
            if not translation.any() and (rotation == np.eye(3)).all():
                continue
            if still is self._still:
                still, slip = still.copy(), slip.copy()
            mine = self._obstacle == obstacle
            side, foot, before = self._beta[mine].sum(axis=1), self._foot[mine], slip[mine]
            slip[mine] = before @ rotation.T
            way = side[:, None] * (foot @ rotation.T + translation - foot)
            still[mine] += self._along(slip[mine] - before - way, mine)
        return (self.stencil, self._ways, still, self._spring, self._limit), slip

    def _at_stage(self, frozen: ObstacleMoves) -> tuple[NDArray[Any], ...]:
        """The same for positions of the stage, a part a of the way to the end: a D, with D there, has the
        gradient of D there. What sticks would else tremble under the midpoint rule for ever.
        """
        if self._of is not frozen:
            self._of, part = frozen, frozen.part
            (stencil, ways, still, spring, limit), _ = self._state(frozen.stage)
            if part != 1.0:
                still = still + (1.0 / part - 1.0) * (self._still - self._along(self._slip))
                ways, spring, limit = ways / part, part * spring, part * limit
            self._stage = stencil, ways, still, spring, limit
        return self._stage

    def _slid(
        self, x: Array, state: tuple[NDArray[Any], ...], slip: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """The elastic parts of the ways at positions x (n_local, 3), what sliding takes [J], which slide."""
        slip, heat, slides = slip.copy(), np.empty(len(slip)), np.empty(len(slip), dtype=np.bool_)
        friction_pairs.slide(x, *state, self._tangents, slip, heat, slides)
        return slip, heat, slides

    def energies(self, x: Array, frozen: ObstacleMoves) -> Array:
        out = np.empty(self.n_owned)
        if not self.n_elements:
            return out
        friction_pairs.energies(x, *self._at_stage(frozen), out)
        return out

    def work_of_targets(
        self, ends: tuple[Array, Array], frozen: tuple[ObstacleMoves, ObstacleMoves]
    ) -> float:
        # by forces: an obstacle goes many times as far as what sticks, over which energies tell nothing
        work = 0.0
        if self._contact.obstacles.moving and self.n_elements:
            (_, _, before, *_), (_, _, after, *_) = (self._at_stage(at) for at in frozen)
            for x, at in zip(ends, frozen, strict=True):
                stencil, ways, still, spring, limit = self._at_stage(at)
                u = np.einsum("ecik,eik->ec", ways, x[stencil]) + still
                pull = np.minimum(spring, limit / np.maximum(np.linalg.norm(u, axis=1), 1e-300))[:, None] * u
                work += 0.5 * float(np.vdot(pull[: self.n_owned], (after - before)[: self.n_owned]))
        return work

    def add_gradient(self, x: Array, frozen: ObstacleMoves, out: Array) -> None:
        if self.n_elements:
            friction_pairs.add_gradient(x, *self._at_stage(frozen), out)

    def add_hessian(
        self,
        x: Array,
        frozen: ObstacleMoves,
        blend: float,
        weight: Array,
        offsets: Mapping[str, Offsets],
        values: Array,
        predicted: tuple[Array, Array] | None = None,
    ) -> None:
        state = self._at_stage(frozen)
        # it is convex as it is; a secant for what slides lets equilibria converge linearly
        blend = 0.0 if self._contact.static else blend
        friction_pairs.add_hessians(x, *state, weight, blend, offsets[self.name], values)

    def count_sticking(self, x: Array, frozen: ObstacleMoves) -> tuple[float, float, float]:
        """How many pairs that this rank counts stick and slide at positions x (n_local, 3), and the sum of
        the normal forces [N] that they are given in the step.
        """
        mine, state = slice(self.n_owned), self._at_stage(frozen)
        *_, slides = self._slid(x, state, self._slip)
        sliding = float(np.count_nonzero(slides[mine]))
        return self.n_owned - sliding, sliding, float(self._force[mine].sum())

    def force_scale(self, size: float) -> Array:
        return self._spring * size

    def accept(self, x: Array, frozen: ObstacleMoves) -> None:
        self._taken_at = None
        self._heat[:, OWED], self._owed = (0.0 if self._owed is None else self._owed), None
        if not self.n_elements:
            self._on_obstacles = np.zeros_like(self._on_obstacles)
            self._renew(x, frozen.places, self._known)
            return
        state, slip = self._state(frozen.end)
        self._on_obstacles = self._forces(x, state)
        slip, heat, slides = self._slid(x, state, slip)
        first = self.stencil[: self.n_owned, 0]
        np.add.at(self._heat[:, WORK], first, heat[: self.n_owned])
        old = self._known.what.copy()
        old[:, friction_pairs.SLIP : SLID], old[:, SLID] = slip[: self.n_owned], slides[: self.n_owned]
        self._renew(x, frozen.places, self._known._replace(what=old))

    def friction_corrections(
        self,
        stage: Array,
        x: Array,
        v: Array,
        frozen: ObstacleMoves,
        damping: Array,
        dt: float,
        *,
        sheets: bool,
    ) -> FrictionCorrections:
        contact = self._contact
        *_, force, at = contact.find_contacts(stage, frozen.now, contact.n_owned)
        vertex = contact.vertex_of(at)
        on = (vertex >= 0) & (sheets | (contact.obstacle[at] >= 0))
        slip, _, slides = self._slid(x, *self._state(frozen.end))
        led = np.flatnonzero(((self._vertex >= 0) & (sheets | (self._obstacle >= 0)))[: self.n_owned])
        rub = led[slides[led]]
        # normal forces on vertices: that acted, that pairs were given, and those among them that slide
        acted, given, rubs = (
            np.bincount(first, each, minlength=len(self._heat))
            for first, each in (
                (vertex[on], force[on]),
                (self._vertex[led], self._force[led]),
                (self._vertex[rub], self._force[rub]),
            )
        )
        owed = self._heat[:, OWED] / dt + acted + damping[: len(acted)] - given
        pays = np.where(rubs > 0.0, np.where(acted > 0.0, PAID, 1.0) * owed, 0.0)
        # what sticks is owed nothing, what has just come is given all later
        goes_on = (acted > 0.0) & ((rubs > 0.0) | (given == 0.0))
        self._owed = np.where(goes_on, dt * (owed - pays), 0.0)
        lacks = self._limit[rub] * (pays / np.maximum(rubs, np.finfo(float).tiny))[self._vertex[rub]]
        # what sticks comes to rest at once: swinging, its springs would pull by twice what holds it still
        held = np.flatnonzero((self._drops & ~slides)[: self.n_owned])
        pull = self._spring[held] * np.linalg.norm(slip[held], axis=1)
        room = (1.0 + BESIDE) * self._limit[held] - pull
        these = np.concatenate([rub, held])
        points, beta, obstacle, ways = (
            of[these] for of in (self.stencil, self._beta, self._obstacle, self._ways)
        )
        moved = contact.obstacles.contact_displacements(x, points, beta, obstacle, frozen.end)
        rate = np.einsum("ecik,eik->ec", ways, v[points]) - self._along(moved / dt, these)
        rate[: len(rub)] = self._along(slip[rub], rub)
        length = np.linalg.norm(rate, axis=1, keepdims=True)
        rate = np.divide(rate, length, out=np.zeros_like(rate), where=length > 0.0)
        along, ways = (
            np.einsum("ec,eck->ek", rate, self._tangents[these]),
            np.einsum("ec,ecim->eim", rate, ways),
        )
        return FrictionCorrections(points, beta, along, ways, np.concatenate([lacks, room]), obstacle, moved)

    def moments(self, x: Array, frozen: ObstacleMoves) -> tuple[Ints, Array]:
        of = np.flatnonzero(self._obstacle[: self.n_owned] < 0)
        stencil, *state = (part[of] for part in self._at_stage(frozen))
        moments = np.zeros((len(of), 3))
        friction_pairs.add_moments(x, stencil, *state, moments)
        return stencil, -moments

    def accept_substep(self, x: Array, frozen: ObstacleMoves) -> None:
        self.accept(x, frozen)
        self._taken_at = frozen.time  # else what obstacles take along would go that way twice

    def friction_lag(self, x: Array, frozen: ObstacleMoves) -> dict[str, Array]:
        names = [*(obstacle.name for obstacle in self._contact.obstacles.each), ""]
        (slip, _, slides), count = self._slid(x, *self._state(frozen.end)), len(names)
        mine, pull = slice(self.n_owned), self._spring * np.linalg.norm(slip, axis=1)
        *_, force, at = self._contact.find_contacts(x, frozen.places, self._contact.n_owned)

        def by_vertex(vertex: NDArray[np.int32], obstacle: Ints, each: Array) -> Array:
            places, size = vertex.astype(np.int64) * count + obstacle % count, len(self._heat) * count
            return np.bincount(places, each, size).reshape(-1, count).astype(np.float64)

        acting = by_vertex(self._contact.stencil[at, 0], self._contact.obstacle[at], force)
        given, limit, pull, sliding = (
            by_vertex(self.stencil[mine, 0], self._obstacle[mine], each[mine])
            for each in (self._force, self._limit, pull, np.where(slides, pull, 0.0))
        )
        more = acting / np.maximum(given, np.finfo(float).tiny)
        wrong = np.maximum(pull - more * limit, np.maximum(more - 1.0, 0.0) * sliding)
        sums = np.stack([wrong.sum(axis=0), pull.sum(axis=0), (more * limit).sum(axis=0)], axis=1)
        return dict(zip(names, sums, strict=True))

    def contact_state(self) -> tuple[Pairs, Array, Array, float | None]:
        return self._pairs, self._heat.copy(), self._on_obstacles, self._taken_at

    def restore_contacts(self, touched: tuple[Pairs, Array, Array, float | None]) -> None:
        self._pairs, self._heat, self._on_obstacles, self._taken_at = touched
        self.stale = True

    def _forces(self, x: Array, state: tuple[NDArray[Any], ...]) -> Array:
        """Force [N] on each obstacle and its torque [N m] about the origin by the owned pairs, (count, 6)."""
        number = self._obstacle[: self.n_owned]
        out = np.zeros((len(self._contact.obstacles.each), 6))
        for obstacle in np.unique(number[number >= 0]):
            of, pull = np.flatnonzero(number == obstacle), np.zeros_like(x)
            friction_pairs.add_gradient(x, *(part[of] for part in state), pull)
            out[obstacle] = *pull.sum(axis=0), *np.cross(x, pull).sum(axis=0)
        return out

    def obstacle_forces(self, x: Array, frozen: ObstacleMoves, count: int) -> Array:
        return self._on_obstacles

    def state(self) -> dict[str, Array]:
        # older ones had something else in the place of what is owed
        return {"friction_work": self._heat * HEAT, "friction_owed": self._heat * ~HEAT}

    def restore(self, state: Mapping[str, Array]) -> None:
        self._heat = state["friction_work"] * HEAT + state.get("friction_owed", 0.0)

    def history(self, x: Array, frozen: ObstacleMoves) -> Mapping[str, float]:
        return {"friction_work": float(self._heat[:, WORK].sum())}


def elements(rest: RestShape) -> None:
    """There are none before anything touches."""


def make(elements: None, scene: Scene, mass: Array) -> CoulombFriction:
    """The term on one rank; `CoulombFriction.set_up` must follow."""
    return CoulombFriction(scene, len(mass))
