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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.contact import friction_pairs
from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.contact.body_motions import BodyMotions
from lyra_petsc.contact.friction_consistency import friction_lag, slip_under_changed_forces
from lyra_petsc.contact.friction_history import (
    continued_pairs,
    matching,
    restored_pairs,
    saved_pairs,
)
from lyra_petsc.contact.friction_step import (
    EndFriction,
    StartingFriction,
    StepFriction,
    moved_pairs,
    step_friction,
    work_of_obstacles,
)
from lyra_petsc.contact.pairs import Contacts, FrictionPairs, chosen, joined, no_friction_pairs
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene, coefficients
from lyra_petsc.terms.protocols import Place, Stateful, TermState
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.step_end import StepEnd
from lyra_petsc.terms.term import Assembly, UpcomingStep

STILL = 1e-8
"""Displacement in a step, over the gap, up to which a sticking pair is not stopped: without the round-off in
velocities, Newton's method would start where round-off leaves it no smaller energy."""


class ObstacleMotion(NamedTuple):
    """Motion of the obstacles in a step.

    Attributes
    ----------
    start, time : float
        Start and end of the step [s].
    times : (float, float)
        Time [s] at which the pairs were found, and that of the forces. Pairs are found at the start of the
        step, or in statics after a part of a load step.
    motions : BodyMotions
        Motions of the obstacles between these ``times``.
    end_points : (m, 3)
        Points [m] and normals of the obstacles at the end of the step.
    """

    start: float
    time: float
    times: tuple[float, float]
    motions: BodyMotions
    end_points: Array


class _EndedStep(NamedTuple):
    """What friction is after a step that is not accepted yet.

    Attributes
    ----------
    time : float
        The end of the step [s].
    pairs : FrictionPairs
        Pairs in contact there.
    loads : (obstacles, 8)
        As from `obstacle_points.obstacle_loads`.
    work : (n_vertices,)
        Heat [J] of sliding.
    """

    time: float
    pairs: FrictionPairs
    loads: Array
    work: Array


ContactState = tuple[FrictionPairs, Array, Array, float | None]
"""Pairs, heat (n_vertices,) [J] of sliding, loads of obstacles, and the time [s] at which pairs were found
after a part of a load step."""


class CoulombFriction(Stateful):
    """Friction of all pairs in contact during a step.

    Parameters
    ----------
    scene : Scene
    n_vertices : int
        Number of vertices that this rank owns.

    Attributes
    ----------
    obstacle_loads : (obstacles, 8)
        In the last step, as from `obstacle_points.obstacle_loads`.
    pairs_have_changed : bool
        Whether the equations of the next solve have other `equation_pairs` than the last.
    """

    def __init__(self, scene: Scene, n_vertices: int) -> None:
        assert scene.contact is not None
        self._sheet_friction = coefficients(scene.contact.friction)
        self._work = np.zeros(n_vertices)  # of friction [J]
        self._pairs = no_friction_pairs()  # of the accepted state
        self._pairs_of_solve: FrictionPairs | None = None  # in the present step, instead of these
        self._contact_time: float | None = None  # [s], of the last part of a load step
        self._ended: _EndedStep | None = None  # until that step is accepted
        self.pairs_have_changed = False
        super().__init__(Elements(np.empty((0, 4), dtype=np.int32)))

    def set_up(self, contact: ContactBarrier) -> None:
        """Take the contact term whose pairs have friction."""
        self._contact = contact
        of_obstacles = [obstacle.friction for obstacle in contact.obstacles.bodies]
        self._coefficients = np.array([*of_obstacles, self._sheet_friction])
        self.obstacle_loads = np.zeros((len(of_obstacles), 8))
        self.set_pairs(self._pairs, self.stencil, 0)

    def set_pairs(self, pairs: FrictionPairs, stencil: NDArray[np.int32], n_counted: int) -> None:
        """Take the pairs in contact with a vertex of this rank, in local rows ``stencil`` (E, 4); this rank
        counts the first ``n_counted``.
        """
        self.set_elements(Elements(stencil, n_owned=n_counted))
        gap = self._contact.barrier.gap
        self._step = step_friction(self.stencil, pairs, n_counted, self._coefficients, gap)
        self._moved: tuple[tuple[float, float] | None, StepFriction] = None, self._step

    def _friction(self, frozen: ObstacleMotion) -> StepFriction:
        """The friction of the step after the motion of the obstacles."""
        if self._moved[0] != frozen.times:
            self._moved = frozen.times, self._step.moved(frozen.motions)
        return self._moved[1]

    def active_elements(self, x: Array, frozen: ObstacleMotion) -> NDArray[np.bool_]:
        """Which pairs (E,) have a non-zero Hessian at positions x (n_local, 3): all."""
        return np.ones(self.n_elements, dtype=np.bool_)

    def hold(self, step: StepEnd, acceleration: Array, frozen: ObstacleMotion) -> Array:
        """Accelerations (n_owned, 3) [m/s²] at the start of a step with the friction that opposes motion."""
        from lyra_petsc.contact import impacts  # needed only if something is near

        return impacts.hold_by_friction(step, self, frozen, acceleration)

    @property
    def n_friction_pairs(self) -> int:
        """Number of pairs in contact that may stick or slide in the next step."""
        return len(self._pairs.key)

    # -- pairs -------------------------------------------------------------------------------------

    @property
    def equation_pairs(self) -> FrictionPairs:
        """The pairs that this rank counts in the equations of the step."""
        return self._pairs if self._pairs_of_solve is None else self._pairs_of_solve

    def take_equation_pairs(self) -> FrictionPairs:
        """The `equation_pairs`, which the caller gives to the ranks that need them."""
        self.pairs_have_changed = False
        return self.equation_pairs

    def _set_pairs(self, pairs: FrictionPairs, of_solve: FrictionPairs | None = None) -> None:
        """Take the pairs of the accepted state, and those of a solve in the present step."""
        before = self.equation_pairs
        self._pairs, self._pairs_of_solve = pairs, of_solve
        self.pairs_have_changed |= len(before.key) > 0 or len(self.equation_pairs.key) > 0

    def begin_step(self) -> None:
        """Prepare for an attempt at a step from the accepted state."""
        if self._pairs_of_solve is not None:
            self._set_pairs(self._pairs)

    def changed_contacts(
        self, x: Array, start: Array, frozen: ObstacleMotion
    ) -> tuple[FrictionPairs, float, float]:
        """The pairs in contact at a Newton iterate x of a step from ``start``, (n_local, 3) each, the change
        of this rank's normal forces since they were last taken, and their sum [N].
        """
        contacts = self._contact.find_contacts(x, frozen.end_points)
        pairs = continued_pairs(self._contact, contacts, x, start, self._pairs).pairs
        before = self.equation_pairs
        force = np.bincount(matching(pairs.key, before) + 1, pairs.force, len(before.key) + 1)
        change = force[0] + np.abs(force[1:] - before.force).sum()  # the first continue none
        return pairs, float(change), float(force.sum())

    def take_contacts(self, pairs: FrictionPairs) -> None:
        """Take pairs from `changed_contacts` for the step's equations."""
        self._set_pairs(self._pairs, pairs)

    def _pairs_at(self, x: Array, frozen: ObstacleMotion, old: FrictionPairs) -> FrictionPairs:
        """The pairs in contact at x (n_local, 3) at the end of the step; those in ``old`` keep their slip."""
        if not self._contact.n_elements:
            return no_friction_pairs()
        contacts = self._contact.find_contacts(x, frozen.end_points)
        return continued_pairs(self._contact, contacts, x, x, old).pairs

    def initialise_pairs(self, x: Array, frozen: ObstacleMotion) -> None:
        """Store the pairs in contact at positions x (n_local, 3), where a run begins or is resumed."""
        self._set_pairs(self._pairs_at(x, frozen, self._pairs))

    def restore_pairs(
        self, vertices: Ints, saved: Mapping[str, Array], places: Mapping[str, tuple[int, int]]
    ) -> None:
        """Restore the pairs of a `state` with a vertex of this rank; ``places`` are the numbers and first
        points that the obstacles had.
        """
        self._set_pairs(restored_pairs(vertices, saved, places, self._contact.obstacles.places))

    # -- energy ------------------------------------------------------------------------------------

    def freeze(self, step: UpcomingStep) -> ObstacleMotion:
        obstacles = self._contact.obstacles
        times = step.start if self._contact_time is None else self._contact_time, step.target_time
        motions, points = obstacles.motions(*times), obstacles.positions(step.end)
        return ObstacleMotion(step.start, step.end, times, motions, points)

    def energies(self, x: Array, frozen: ObstacleMotion) -> Array:
        out = np.empty(self.n_owned)
        if self.n_elements:
            friction_pairs.energies(x, *self._friction(frozen).kernel_data, out)
        return out

    def add_gradient(self, x: Array, frozen: ObstacleMotion, out: Array) -> None:
        if self.n_elements:
            friction_pairs.add_gradient(x, *self._friction(frozen).kernel_data, out)

    def add_hessian(self, x: Array, frozen: ObstacleMotion, into: Assembly) -> None:
        data = self._friction(frozen).kernel_data
        # the potential is convex; with a secant for sliding pairs equilibria would converge only linearly
        convexity = 0.0 if self._contact.barrier.static else into.convexity
        to = into.offsets[self.name], into.values
        friction_pairs.add_hessians(x, *data, into.weight, convexity, *to)

    def force_scale(self, size: float) -> Array:
        return self._step.stiffness * size

    def work_of_targets(
        self, ends: tuple[Array, Array], frozen: tuple[ObstacleMotion, ObstacleMotion]
    ) -> float:
        """Work [J] of moving obstacles on this rank's pairs between the positions ``ends`` (n_local, 3)."""
        if not (self._contact.obstacles.moving and self.n_elements):
            return 0.0
        first, last = (self._friction(at).counted() for at in frozen)
        return work_of_obstacles(ends, (first, last))

    def count_sticking(self, x: Array, frozen: ObstacleMotion) -> tuple[float, float, float]:
        """Numbers of sticking and of sliding pairs of this rank at x (n_local, 3), and the sum of their
        normal forces [N] in the step's equations.
        """
        pairs = self._friction(frozen).counted().slid(x)[0].pairs
        sliding = float(np.count_nonzero(pairs.slides))
        return self.n_owned - sliding, sliding, float(pairs.force.sum())

    # -- the start and the end of a step -----------------------------------------------------------

    def starting_friction(self, frozen: ObstacleMotion) -> StartingFriction:
        """Friction at the start of the step."""
        step, moved = self._step.counted(), self._friction(frozen).counted()
        return StartingFriction(step, step.elastic_force(), moved.offset - step.offset)

    def set_starting_friction(self, friction: Array) -> None:
        """Set the friction (m, 2) [N] of the pairs of `starting_friction`."""
        step = self._step.counted()
        slip = np.einsum("eck,ec->ek", step.pairs.tangents, -friction / step.stiffness[:, None])
        self._set_pairs(self._pairs._replace(slip=slip))

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
        normal forces in the step are ``normal_force`` (m,) [N]. The velocities of obstacles are means between
        the two times ``last`` [s].
        """
        before = self._friction(frozen).counted().slid(x)[0]
        new, rows, order, previous = continued_pairs(self._contact, contacts, x, x, before.pairs)
        loads = np.zeros_like(self.obstacle_loads)
        number, load = before.loads(x)
        np.add.at(loads[:, :7], number, load[:, :7])  # the sizes are those of `set_end_friction`
        self._ended = _EndedStep(frozen.time, new, loads, np.zeros_like(self._work))
        # several pairs that continue one share its friction in proportion to their normal forces; the last
        # row of these arrays, −1, is for those that continue none
        normal_force, n, n_before = normal_force[order], len(order), len(before.rows)
        total = np.bincount(previous % (n_before + 1), normal_force, n_before + 1)[previous]
        share = np.divide(normal_force, total, out=np.zeros(n), where=normal_force > 0.0)
        slip = np.concatenate([-before.stiffness[:, None] * before.pairs.slip, np.zeros((1, 3))])
        ended = before.pairs._replace(force=np.zeros(n_before), slides=np.ones(n_before, dtype=np.bool_))
        pairs = joined([new._replace(force=normal_force), ended])
        force = pairs.along(np.concatenate([share[:, None] * slip[previous], slip[:-1]]))
        applied = force.copy()
        applied[:n] = 0.0
        static, kinetic = pairs.factor * pairs.force * self._coefficients[pairs.obstacle].T
        # a spring that still yields less than its limit need not stop the pair within the step
        continues = np.concatenate([~new.slides & (previous >= 0), np.zeros(n_before, dtype=np.bool_)])
        holds = continues & (np.linalg.norm(force, axis=1) <= static)
        rows, obstacles = np.concatenate([rows, before.rows]), self._contact.obstacles
        velocity = obstacles.contact_velocities(
            x, v, rows, pairs.beta, pairs.obstacle, pairs.body_points, last
        )
        still, velocity = STILL * self._contact.barrier.gap, pairs.along(velocity)
        return EndFriction(rows, pairs, force, applied, static, kinetic, holds, velocity, still)

    def set_end_friction(self, friction: EndFriction, force: Array, sticks: Mask, work: Array) -> None:
        """Set friction (m, 2) [N] of the step in the pairs of an `end_friction`, which of them stick, and the
        heat (m,) [J] of sliding.
        """
        assert self._ended is not None
        pairs, n = self._ended.pairs, len(self._ended.pairs.key)
        size, before = (np.linalg.norm(forces, axis=1) for forces in (force, friction.force))
        limit = np.where(sticks, friction.static, friction.kinetic)
        less = np.divide(limit, before, out=np.ones_like(size), where=before > limit)
        pairs = pairs._replace(slip=less[:n, None] * pairs.slip, slides=~sticks[:n])
        on = np.flatnonzero(friction.pairs.obstacle >= 0)
        np.add.at(self._ended.loads[:, 7], friction.pairs.obstacle[on], size[on])
        np.add.at(self._ended.work, friction.rows[:, 0], work)
        self._ended = self._ended._replace(pairs=pairs)

    def accept(self, x: Array, frozen: ObstacleMotion) -> None:
        self._contact_time = None
        ended, self._ended = self._ended, None
        if not (self.n_elements or self._contact.n_elements):
            self.obstacle_loads = np.zeros_like(self.obstacle_loads)
            self._set_pairs(no_friction_pairs())
            return
        if ended is None or ended.time != frozen.time:  # that of a rejected attempt
            step, heat = self._friction(frozen).counted().slid(x)
            pairs, loads = self._pairs_at(x, frozen, step.pairs), np.zeros_like(self.obstacle_loads)
            ended = _EndedStep(frozen.time, pairs, loads, np.zeros_like(self._work))
            np.add.at(loads, *step.loads(x))
            np.add.at(ended.work, step.rows[:, 0], heat)
        self.obstacle_loads = ended.loads
        self._work += ended.work
        self._set_pairs(ended.pairs)

    # -- equilibria --------------------------------------------------------------------------------

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
        barrier, pairs = self._contact, self._pairs
        contacts = barrier.find_contacts(x, frozen.end_points)
        # the same pairs as now, with slip from the start
        again, rows, _, previous = continued_pairs(barrier, contacts, x, start_x, old)
        begin = frozen.start if time is None else time
        again = moved_pairs(again, barrier.obstacles.motions(begin, frozen.time))
        continues = previous >= 0
        n = len(previous)
        self._pairs = chosen(joined([again, pairs]), np.where(continues, 0, n) + np.arange(n))
        vertices = rows[continues, 0]
        self._work[vertices] = work[vertices]
        force = self._pairs.force
        return np.array([(self._work - work).sum(), force[~continues].sum(), force.sum()])

    def friction_lag(self, x: Array, frozen: ObstacleMotion) -> dict[str, Array]:
        """The rows of `friction_consistency.friction_lag` at positions x (n_local, 3), by the names of
        obstacles; that between sheets is empty.
        """
        names = [*(obstacle.name for obstacle in self._contact.obstacles.bodies), ""]
        contacts = self._contact.find_contacts(x, frozen.end_points)
        step = self._friction(frozen).counted().slid(x)[0]
        return dict(zip(names, friction_lag(step, contacts, len(self._work), len(names)), strict=True))

    def slip_under_changed_forces(self, x: Array, dx: Array, frozen: ObstacleMotion) -> tuple[float, float]:
        """As `friction_consistency.slip_under_changed_forces`, in a solve by dx to x (n_local, 3)."""
        contacts = self._contact.find_contacts(x, frozen.end_points)
        moving = self._contact.obstacles, frozen.motions, len(self._work)
        return slip_under_changed_forces(x, dx, self._step.counted(), contacts, *moving)

    def contact_state(self) -> ContactState:
        """The contacts of the accepted state, for `restore_contacts`."""
        return self._pairs, self._work.copy(), self.obstacle_loads, self._contact_time

    def restore_contacts(self, state: ContactState) -> None:
        """Return to a `contact_state`."""
        pairs, self._work, self.obstacle_loads, self._contact_time = state
        self._set_pairs(pairs)

    # -- state -------------------------------------------------------------------------------------

    def initialise(self, x: Array) -> None:
        """No pairs are in contact before the first step."""

    def state(self) -> dict[str, TermState]:
        work = {"friction_work": TermState(Place.VERTEX, np.outer(self._work, [1.0, 0.0, 0.0]))}
        vertices, arrays = self._pairs.key[:, :4], saved_pairs(self._pairs)
        pairs = {name: TermState(Place.ELEMENT, values, vertices) for name, values in arrays.items()}
        return work | pairs

    def restore(self, values: Mapping[str, Array], x: Array) -> None:
        self._work = values["friction_work"][:, 0].copy()

    def history(self, x: Array, frozen: ObstacleMotion) -> Mapping[str, float]:
        return {"friction_work": float(self._work.sum())}


def elements(rest: RestShape) -> None:
    """None: there are no elements before anything is in contact."""


def make(elements: None, scene: Scene, mass: Array) -> CoulombFriction:
    """The term on one rank; `CoulombFriction.set_up` must be called next."""
    return CoulombFriction(scene, len(mass))
