"""The implicit equations of one step: residual, Jacobian and objective in the velocities of the stage.

Unknown v (the velocity of the integrator's stage), with its history x_h, v_h and numbers σ, c::

    F(v, v̇) = M v̇ + ∇E(x_h + c v) + D v + ∇P(v) − f,  v̇ = σ (v − v_h)       Jacobian  σ M + c K + D + ∇∇P

with the elastic energy E, damping D = γ K⁺, the wind's potential P and the loads f. F is the gradient of
``objective``. Backward Euler has x_h = x_n, v_h = v_n, σ = 1/c = 1/Δt: the Lyra paper, eq. 10-18, as a Newton
iteration. The geometry of D, P and f is frozen during a step: at x_n for first-order integrators, at the
extrapolated stage x_n + (t_s − t_n) v_n for second-order ones.

Unknowns of edges have no mass: their rows of F are ∂E/∂φ, and they are in equilibrium at the stage. Where the
stage is not the end of the step, a second solve finds their equilibrium at the end
(`StageEquations.begin_edge_solve`).

This module works on arrays only, without PETSc. Methods that return sums over ranks are collective.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.linear.block_rows import squared_norm_without
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.mesh.points import Layout
from lyra_petsc.stepping.active_terms import ActiveTerms
from lyra_petsc.stepping.applied_loads import AppliedLoads
from lyra_petsc.stepping.damping import Damping
from lyra_petsc.stepping.directors import Directors
from lyra_petsc.stepping.evaluation import Evaluation
from lyra_petsc.stepping.integrators.integrator import Integrator, Stage
from lyra_petsc.stepping.predicted_stress import PredictedStress
from lyra_petsc.stepping.prescribed import Prescribed
from lyra_petsc.stepping.reference_positions import ReferencePositions
from lyra_petsc.stepping.start_acceleration import StartAcceleration
from lyra_petsc.stepping.state import State, kinetic_energy
from lyra_petsc.terms.handles.prescribed_handles import ExactHandles
from lyra_petsc.terms.protocols import FollowsHandles, LimitsStep
from lyra_petsc.terms.term import Elastic, Term, UpcomingStep, Viscous

if TYPE_CHECKING:
    from lyra_petsc.contact.impacts import ContactImpulses, StepEnd
    from lyra_petsc.contact.scene_contact import SceneContact


Energy = TypeVar("Energy", bound=Elastic)

MAX_TURN = 0.25
"""Largest angle [rad] by which a Newton iteration of a static analysis may turn a director."""


class StageEquations:
    """One rank's part of the equations, and the state (x_n, v_n) that a step starts from.

    Parameters
    ----------
    discretisation : Discretisation
    mass : (n_owned,) [kg]
        Mass of each block row: the lumped mass of a vertex, 0 for an edge.
    terms : sequence of Term
    held : ExactHandles
    integrator : Integrator
    contact : SceneContact or None
    starts : list of float
        Times [s] at which handles start to act.
    events : list of float
        Times [s] at which forces may jump.

    Attributes
    ----------
    state : State
    history : (n_owned, 3)
        The stage's v_h [m/s].
    reference : ReferencePositions
    prescribed : Prescribed
        The prescribed unknowns of the step.
    moving_energy_before : float
        Energy [J] of this rank's terms with moving targets: positions at the start of the step, targets at
        its stage.
    t0, t1 : float
        Start and end of the step [s].
    version : int
        Number that changes whenever the equations do: with a step, its data, or its ghosts.
    evaluated : Evaluation
        The last one; after a step that of its stage.
    start_acceleration : StartAcceleration
    active : ActiveTerms
    applied : AppliedLoads
    directors : Directors
    predicted_stress : PredictedStress
        That of the Jacobian.
    solving_edges : bool
        Whether the edges' unknowns are being solved for at the end of the step.
    usual, in_contact : Integrator
        The scene's integrator, and the one that takes the steps in which something touches.
    nears_limit : bool
        Whether a term that limits steps acts at the positions of the state; contact is apart.
    has_active_pairs : bool
        Whether any pair of a term with changing stencils acted when the block rows were last renewed.
    prescribed_force : (n_owned, 3) or None
        Change [N] of F by the motion of prescribed unknowns, in steps of one linear solve; set by `jacobian`.
    """

    prescribed_force: Array | None = None
    has_active_pairs = solving_edges = False
    _start_velocity: Array | None = None  # found by `find_start`
    _past_velocity: Array | None = None  # (n_owned, 3) before the last step, if there is contact

    def __init__(
        self,
        discretisation: Discretisation,
        mass: Array,
        terms: Sequence[Term],
        held: ExactHandles,
        *,
        integrator: Integrator,
        contact: SceneContact | None,
        starts: list[float],
        events: list[float],
    ) -> None:
        self.discretisation, self.mass, self.integrator = discretisation, mass, integrator
        moves = contact is not None and contact.obstacles_move
        self.active = active = ActiveTerms(terms, contact.barrier if contact and moves else None)
        self.contact = contact
        self.usual = self.in_contact = integrator
        if contact is not None or active.limiting:
            self.in_contact = integrator.for_contact()
        discretisation.when_ghosts_change(self._follow_ghosts)
        self.held = held
        following = [term.reference_rows for term in terms if isinstance(term, FollowsHandles)]
        rows = np.concatenate([held.reference_rows, *following])
        self.reference = ReferencePositions(self.points, rows, starts)
        self.prescribed = Prescribed(discretisation, held, self.reference)
        self.applied = AppliedLoads(active.loads, self.points)
        self.damping = Damping(
            discretisation,
            active.elastic,
            dynamic=integrator.dynamic,
            single_assembly=integrator.lagged_loads,
        )
        self.state = State(discretisation)
        self.version = 0
        self.evaluated = Evaluation(np.zeros_like(self.x), np.zeros_like(self.x))
        self._xh, self.history = self.x, self.v[: self.points.n_owned]
        self.stage = Stage(1.0, 1.0, 1.0)
        self.t0 = self.t1 = self.moving_energy_before = self._size = 0.0
        self._squares: list[float] = []
        self.start_acceleration = StartAcceleration(self, events)
        self.directors = Directors(self)
        self.predicted_stress = PredictedStress()

    @property
    def points(self) -> Layout:
        """Layout of the local rows, with the ghosts that the present stencils need."""
        return self.discretisation.layout

    @property
    def dt(self) -> float:
        """Length of the step [s]."""
        return self.t1 - self.t0

    @property
    def x(self) -> Array:
        """Positions (n_local, 3) [m] of the state."""
        return self.state.x

    @property
    def v(self) -> Array:
        """Velocities (n_local, 3) [m/s] of the state."""
        return self.state.v

    def set_references(self, time: float) -> None:
        """Take the present positions as reference of handles that start to act by ``time`` [s]."""
        self.reference.record_starts(time, self.x)

    def hold_targets(self, time: float) -> None:
        """Put moving targets at their positions at ``time`` [s], between two steps; collective."""
        self.t0 = self.t1 = time
        step = UpcomingStep(time, time, time, self.x, self.reference.at)
        self.active.freeze(step)
        self.update_stencils(self.x)  # energies at the start of a run need all stencils
        if self.contact is not None:
            self.contact.initialise(self.x, self.active.frozen)
        self.nears_limit = self.limits_act(self.x)

    # -- a step ------------------------------------------------------------------------------------

    def begin_step(self, t0: float, t1: float) -> None:
        """Set up the equations of the step from t0 to t1 [s], and freeze its data; collective."""
        self.t0, self.t1 = t0, t1
        self._start_velocity = None
        self.predicted_stress.forget()
        after = self.integrator.stage_offset(self.dt)
        self.prescribed.begin_step(t0, t1, self.x)
        if self.contact is not None:
            self.contact.begin_step()
            self.contact.update(self.x, self.expected_displacement(), self.expected_displacement)
        self._freeze(t0 + after)
        if self.contact is not None and self.contact.obstacles_move:  # they may have come near
            self.contact.update(self.x, self.expected_displacement(), self.expected_displacement)
        self.start_acceleration.begin_step(t0 + after)
        n = self.points.n_owned
        self.stage = stage = self.integrator.stage(self.x[:n], self.v[:n], self.dt)
        self.history = self.v[:n] if stage.v is None else stage.v
        self._set_history(stage, t0 + after)
        self.moving_energy_before = self.active.moving_energy(self.x)

    def expected_displacement(self, steps: int = 1) -> Array:
        """Displacements (n_local, 3) [m] of the step at constant velocities, of handles exactly.

        Those of several ``steps`` are with the accelerations of the last step.
        """
        displacement, n = steps * self.dt * self.v, self.points.n_owned
        if steps > 1 and self._past_velocity is not None:
            displacement[:n] += 0.5 * steps**2 * self.dt * (self.v[:n] - self._past_velocity)
        x = self.x[:n].take(self.prescribed.indices)
        self.prescribed.overwrite(displacement[:n], float(steps) * (self.prescribed.goal - x))
        self.points.update_ghosts(displacement)
        return displacement

    def _freeze(self, at: float) -> None:
        """Freeze geometry, targets and loads at the time ``at`` [s] of the stage."""
        x = self.frozen_positions(at)
        self.active.freeze(UpcomingStep(self.t0, self.t1, at, x, self.reference.at))
        if self.directors.begin_step() and self.integrator.dynamic:
            self.state.evaluation = None
        self.change()
        self._size = float(np.abs(self.x).max(initial=0.0))
        if self.integrator.dynamic or self.applied.override is None:
            lagged = self.active.viscous and self.integrator.lagged_loads
            wind = self._sum(self.active.viscous, self.v) if lagged else None
            self.applied.freeze(self.t0, self.t1, x, wind)
        else:
            self.applied.force = self.applied.override
        if self.damping.active:
            self.damping.freeze(x, self.active.frozen)

    def frozen_positions(self, at: float) -> Array:
        """Positions (n_local, 3) [m] whose geometry is frozen during the step."""
        if not self.integrator.centred:
            return self.x
        x = self.x + (at - self.t0) * self.v
        if self.points.n_edges_global:  # unknowns of edges are never extrapolated
            edges = ~self.points.are_vertices(self.points.global_number)
            x[edges] = self.x[edges]
        return x

    def _set_history(self, stage: Stage, at: float) -> None:
        """Set x_h with its ghosts, and the velocities of the prescribed unknowns."""
        n = self.points.n_owned
        given = bool(self.held) and self.integrator.handles_at_stage
        if stage.x is None and not given:
            self._xh = self.x
            self.prescribed.set_velocity_to_goal(self.x[:n], stage.c)
            return
        self._xh = np.empty_like(self.x)
        self._xh[:n] = self.x[:n] if stage.x is None else stage.x
        if given:
            self.prescribed.set_motion_at(at, self._xh[:n], stage.c)
        else:
            self.prescribed.set_velocity_to_goal(self._xh[:n], stage.c)
        self.points.update_ghosts(self._xh)

    def out_of_balance(self, v: Array | None = None) -> Array:
        """Force (n_owned, 3) [N] on the free unknowns, with the state's velocities or v (n_local, 3)."""
        v = self.v if v is None else v
        total = self._total(Evaluation(self.x, v), np.zeros_like(self.history), np.empty_like(self.history))
        return np.where(self.prescribed.free, -total, 0.0)

    def forces_now(self) -> Iterator[tuple[str, Array]]:
        """The parts of F at the start of the step without inertia, each (n_owned, 3) [N]."""
        return self._parts(Evaluation(self.x, self.v), np.zeros_like(self.history))

    @property
    def stage_velocity(self) -> Array:
        """Velocities (n_owned, 3) [m/s] of the stage of the step just accepted."""
        return self.evaluated.v[: self.points.n_owned]

    def prescribe(self, v: Array) -> None:
        """Overwrite the prescribed unknowns of v (n_owned, 3) by their velocities at the stage."""
        self.prescribed.overwrite(v, self.prescribed.velocity)

    def stationary_velocity(self) -> Array:
        """Velocities (n_owned, 3) [m/s] with which the stage is at the positions where the step starts."""
        return ((self.x - self._xh) / self.stage.c)[: self.points.n_owned]

    def evaluate_at_start(self) -> None:
        """Evaluate the stage at the positions where the step starts; collective."""
        self.evaluate(self.stationary_velocity())

    def accept(self, solution: Evaluation) -> None:
        """Set the state at the end of the step from the stage that solves it; collective."""
        n, given, free = self.points.n_owned, self.integrator.handles_at_stage, self.prescribed.free
        self.evaluated, v = solution, solution.v[:n]
        before, rate_before = self.x[:n], self.v[:n]
        moved, rate = self.integrator.end(before, rate_before, v, self.dt)
        followers = {self.in_contact} if self.integrator is self.usual else set()
        for integrator in {self.integrator} | followers:
            integrator.record_step(before, rate_before, free, self.dt)
        self.prescribed.overwrite(moved, self.prescribed.goal)
        if given:
            self.prescribed.overwrite_with_end_velocity(rate)
        self.state.set(moved, rate)
        if not self.evaluates_iterates and not self.active.moving:
            # the stage is at the end, and the next step is linearised there
            self.evaluated = self.state.evaluation = Evaluation(self.x, solution.v)
        if not self.integrator.dynamic:
            return
        self.nears_limit = self.limits_act(self.x)
        if self.contact is None:
            return
        if self.stage.offset < self.dt:  # pairs that come near between the stage and the end
            self.update_stencils(self.evaluated.x, self.x - self.evaluated.x)
        self._past_velocity = rate_before
        step = self._step_end(self.v)
        impulses = self.contact.finish(step, self.active.frozen, damps=self.suits_contact)
        if impulses is not None:
            self.state.set(self.x[:n], self.v[:n] + impulses.change)
            self.in_contact.shift_past_velocities(impulses.change)

    def _step_end(self, v: Array) -> StepEnd:
        """The step's end with velocities v (n_local, 3), for contact."""
        from lyra_petsc.contact.impacts import StepEnd

        free, held, order = self.prescribed.free, self.prescribed.indices, self.integrator.order
        return StepEnd(self.points, self.mass, free, held, self.x, v, self.t0, self.t1, order)

    def held_by_friction(self, v: Array, acceleration: Array) -> Array:
        """The accelerations (n_owned, 3) [m/s²] at the start of a step with velocities v (n_local, 3) and the
        friction that opposes motion; collective.
        """
        if self.contact is None:
            return acceleration
        return self.contact.hold(self._step_end(v), acceleration, self.active.frozen)

    @property
    def contact_impulses(self) -> ContactImpulses | None:
        """The impulses of contact at the end of the step just accepted."""
        return None if self.contact is None else self.contact.impulses

    @property
    def near(self) -> bool:
        """Whether any parts are near each other."""
        return self.contact is not None and self.contact.near

    @property
    def touches(self) -> bool:
        """Whether anything touches, or a term acts that limits steps, at the positions of the state."""
        return self.nears_limit or (self.contact is not None and self.contact.touches)

    @property
    def suits_contact(self) -> bool:
        """Whether the integrator of the step is one for steps in which something touches."""
        return self.integrator is not self.usual or self.usual is self.in_contact

    @property
    def touches_at_stage(self) -> bool:
        """Whether anything touches, or a term acts that limits steps, at the stage of the step just accepted,
        or its end is beyond such a limit; collective.
        """
        if self.limits_act(self.evaluated.x) or not self.is_within_limits(self.x):
            return True
        return self.contact is not None and self.contact.is_touching(self.evaluated.x, self.active.frozen)

    def resolves_contact(self) -> bool:
        """Whether the step's integrator can follow the changes of the normal forces in it; collective."""
        return self.integrator.order == 1 or self.contact is None or self.contact.resolved(self.dt)

    def saved_histories(self) -> tuple[dict[str, Array], dict[str, float]]:
        """Arrays (n_owned, 3) and numbers of the histories of both integrators."""
        (arrays, numbers), (more, others) = self.in_contact.saved_state(), self.usual.saved_state()
        return arrays | more, numbers | others

    def restore_histories(self, arrays: Mapping[str, Array], numbers: Mapping[str, float]) -> None:
        """Return to `saved_histories`."""
        for each in {self.usual, self.in_contact}:
            each.restore(arrays, numbers)

    def follow_step(self, v_before: Array) -> None:
        """Let the integrators that did not take the step just accepted, from velocities v_before (n_owned,
        3), go on from its end.
        """
        if self.contact is not None:
            self.contact.accept()
        if self.integrator is self.usual:
            return
        rate = (self.stage_velocity - v_before) / self.dt
        moves = self.prescribed.free & (self.mass[:, None] > 0.0)
        for each in {self.usual, self.in_contact} - {self.integrator}:
            each.restart()
            if self.integrator.order == 1:  # velocities after an impact would give stiff damping huge forces
                each.set_acceleration(np.where(moves, rate, 0.0))
        self.integrator = self.usual

    def initial_edge_moments(self) -> float:
        """Norm [N] of the moments on free edges at the start of a run, handles set; collective."""
        self.prescribed.begin_step(self.t0, self.t0, self.x)
        moments = np.where(self.prescribed.free, self._sum(self.active.sheet, self.x), 0.0)[
            self.points.n_vertices :
        ]
        return float(np.sqrt(self.points.global_sum(float(np.vdot(moments, moments)))[0]))

    # -- unknowns of edges ---------------------------------------------------------------------------

    @property
    def solves_edges_at_end(self) -> bool:
        """Whether the edges' unknowns need a solve of their own at the end of the step."""
        return bool(self.points.n_edges_global) and self.integrator.dynamic and self.stage.offset < self.dt

    def begin_edge_solve(self, x_before: Array) -> None:
        """Set up the equilibrium of the edges' unknowns at the end of the step just accepted; collective.

        It is a stage of backward Euler from x_before (n_owned, 3) with the vertices' present positions
        prescribed. Before the first step it starts at these positions, after `initial_edge_moments`.
        """
        n, dt = self.points.n_owned, self.dt or 1.0
        velocity, frozen = self.stage_velocity.copy(), self.active.frozen
        self._stage_before_edges = self.stage, self.history, self._xh, velocity, frozen
        self.predicted_stress.forget()
        self.change()
        self.stage = Stage(1.0 / dt, dt, dt)
        self.history = np.zeros((n, 3))
        self._xh = self.points.extended(x_before)
        self.active.move_targets(UpcomingStep(self.t0, self.t1, self.t1, self.x, self.reference.at))
        self.prescribed.hold_vertices(self.x[:n])
        self.solving_edges = True
        self.prescribed.set_velocity_to_goal(self._xh[:n], dt)

    def end_edge_solve(self, solution: Evaluation | None) -> None:
        """Set the edges' unknowns from the stage that solves their equations, unless None, and restore the
        stage; collective.
        """
        n = self.points.n_owned
        moved = None if solution is None else solution.x[:n]
        self.stage, self.history, self._xh, stage_velocity, self.active.frozen = self._stage_before_edges
        self.prescribed.release_vertices()
        self.solving_edges = False
        self.change()
        self.predicted_stress.forget()
        if moved is not None:
            rows = slice(self.points.n_vertices, n)
            self.x[rows] = moved[rows]
            self.state.update_ghosts()
        self.evaluate(stage_velocity)

    # -- terms -------------------------------------------------------------------------------------

    def output_velocity(self) -> Array:
        """Velocities (n_owned, 3) [m/s] for output: those of prescribed unknowns are ẋ*(t)."""
        self.prescribed.overwrite_with_end_velocity(velocity := self.v[: self.points.n_owned].copy())
        return velocity

    def gradient_of(self, terms: Sequence[Elastic], x: Array) -> Array:
        """Gradient (n_owned, 3) [N] at x (n_local, 3) of the energy of ``terms``."""
        return self._sum(terms, x)

    def obstacle_work(self) -> float:
        """Work [J] of moving obstacles on this rank's elements in the step, by their forces at the stage."""
        if self.contact is None or not self.contact.obstacles_move:
            return 0.0
        at = self.t0 + self.stage.offset if self.integrator.dynamic else self.t1
        work = self.contact.barrier.work(self.evaluated.x, at, self.t0, self.t1)
        return work + (self.contact.impulses.work if self.contact.impulses else 0.0)

    def move_targets_to_end(self) -> float:
        """Put moving targets at the end of the step; the change [J] of the energy of this rank's terms."""
        if self.stage.offset == self.dt or not (self.active.moving or self.active.constraints):
            return 0.0
        before = self.active.moving_energy(self.x)
        self.active.move_targets(UpcomingStep(self.t0, self.t1, self.t1, self.x, self.reference.at))
        return self.active.moving_energy(self.x) - before

    def displacement(self, v: Array, increment: Array) -> tuple[Array, Array]:
        """Stage positions at velocities v (n_owned, 3), and displacements from there, both (n_local, 3) [m].

        ``increment`` (n_owned, 3) [m/s] is added to the velocities; collective.
        """
        return self.evaluate(v).x, self.points.extended(increment * self.stage.c)

    # -- limits of motion --------------------------------------------------------------------------

    def _stage_positions_of(self, v: Array) -> Array:
        """Positions (n_owned, 3) [m] of the stage at velocities v (n_owned, 3), without ghosts."""
        return self.stage.c * v + self._xh[: len(v)]

    @property
    def limits_steps(self) -> bool:
        """Whether `largest_step` may be less than 1.

        So it is with contact, and in statics with directors, which would else reach a distant equilibrium.
        """
        turns = bool(self.active.with_edges) and not self.integrator.dynamic
        return self.contact is not None or bool(self.active.limiting) or turns

    def largest_step(self, v: Array, increment: Array) -> float:
        """Largest fraction of an increment (n_owned, 3) [m/s] from v that may be taken; collective."""
        turn = 0.0 if self.integrator.dynamic else self.directors.largest_turn(increment * self.stage.c)
        return self._free_fraction(v, increment, MAX_TURN / turn if turn > MAX_TURN else 1.0)

    def moves_freely(self, v: Array, increment: Array) -> bool:
        """Whether no collision limits an increment (n_owned, 3) [m/s] from v; collective."""
        return self._free_fraction(v, increment, 1.0) == 1.0

    def _free_fraction(self, v: Array, increment: Array, maximum: float) -> float:
        if self.active.limiting:
            x, displacement = self.displacement(v, increment)
            frozen = self.active.frozen
            allowed = [term.largest_step(x, displacement, frozen[term]) for term in self.active.limiting]
            maximum = -self.points.global_max(-min(maximum, *allowed))[0]
        if self.contact is None:
            return maximum
        obstacles = self.active.frozen[self.contact.barrier]
        x, dx = self._stage_positions_of(v), self.stage.c * increment
        return self.contact.collisions.limit(x, dx, obstacles, maximum)

    def separated(self, v: Array, increment: Array) -> Array | None:
        """The increment (n_owned, 3) [m/s] from v, changed to separate the parts that it brings too near;
        None if there are none; collective.
        """
        if self.contact is None:
            return None
        obstacles = self.active.frozen[self.contact.barrier]
        x, dx = self._stage_positions_of(v), self.stage.c * increment
        moved = self.contact.collisions.separate(x, dx, obstacles, self.prescribed.free)
        return None if moved is None else moved / self.stage.c

    def contact_at(self, v: Array) -> tuple[SceneContact, Discretisation, Array, float, Mask, Any]:
        """What Newton's model of contact takes from the equations at velocities v (n_owned, 3)."""
        assert self.contact is not None
        obstacles, x = self.active.frozen[self.contact.barrier], self._stage_positions_of(v)
        return self.contact, self.discretisation, x, self.stage.c, self.prescribed.free, obstacles

    def find_start(self) -> bool:
        """Find velocities from which the step's solve can start without a collision; whether there are any.

        Free vertices stay, or keep their velocities, or obstacles push them; obstacles and prescribed
        unknowns move as they must; collective.
        """
        if self.contact is None:
            return True
        still, c, n = self.stationary_velocity(), self.stage.c, self.points.n_owned
        driven = np.zeros_like(still)
        self.prescribe(driven)
        driven = np.where(self.prescribed.free, 0.0, c * (driven - still))
        if not any(self.points.global_max(self.contact.obstacles_move or bool(driven.any()))):
            return True
        guesses = [np.zeros_like(still)]
        if not self.integrator.starts_at_rest:
            guesses.append(c * (self.v[:n] - still))
        obstacles = self.active.frozen[self.contact.barrier]
        free, pushes = self.prescribed.free, len(guesses) > 1
        found = self.contact.collisions.start(self.x[:n], guesses, driven, free, obstacles, pushes=pushes)
        self._start_velocity = None if found is None else still + found / c
        return found is not None

    def start_velocity(self) -> Array:
        """Collision-free velocities (n_owned, 3) [m/s] for the first guess, with the prescribed ones.

        They are those that `find_start` found, else `stationary_velocity`.
        """
        found = self._start_velocity
        v = self.stationary_velocity() if found is None or self.solving_edges else found.copy()
        self.prescribe(v)
        return v

    def end_is_free(self, v: Array) -> bool:
        """Whether the sheet moves from the stage with velocities v (n_owned, 3) to the end of the step
        without a collision; collective.
        """
        iterates = self.integrator.iterates
        if self.contact is None or (self.stage.offset == self.dt and iterates):
            return True
        from lyra_petsc.contact.obstacle_points import StepInterval

        x = self.x[: len(v)]
        end = self.integrator.end(x, self.v[: len(v)], v, self.dt)[0]
        # Newton's method has checked the displacement to the stage, a single linear solve has not
        here = self._stage_positions_of(v) if iterates else x
        obstacles = self.active.frozen[self.contact.barrier]
        return self.contact.collisions.is_free(here, end - here, obstacles, StepInterval(1.0, 2.0))

    def may_collide(self, approach: float) -> bool:
        """Whether parts may collide in the step, approaching by more than ``approach`` [m]; collective."""
        if not self.near or not self.integrator.dynamic or self.solving_edges:
            return False
        assert self.contact is not None
        return self.contact.may_collide(self.x, self.expected_displacement(), self.active.frozen, approach)

    @property
    def may_impact(self) -> bool:
        """Whether parts that are near move by a notable part of the gap in the step; collective."""
        if self.contact is None:
            return False
        return self.contact.may_impact(self.stage.c * self.evaluated.v[: self.points.n_vertices])

    # -- residual and Jacobian -----------------------------------------------------------------------

    def update_stencils(self, x: Array, displacement: Array | None = None) -> None:
        """Update the near pairs to positions x (n_local, 3), or to all along a displacement, and all arrays
        to their ghosts; collective.
        """
        if self.contact is not None:
            self.contact.update(x, displacement)

    def _follow_ghosts(self) -> None:
        """Resize all arrays to the layout's present ghosts; collective."""
        self.state.resize()
        self._xh = self.points.extended(self._xh)
        self.change()
        now = self.evaluated
        self.evaluated = Evaluation(self.points.extended(now.x), self.points.extended(now.v))
        self.prescribed.resize()

    def evaluate(self, v: Array) -> Evaluation:
        """The stage at velocities v (n_owned, 3); collective."""
        rates = self.points.extended(v)
        self.evaluated = Evaluation(self.stage.c * rates + self._xh, rates)
        self.update_stencils(self.evaluated.x)
        return self.evaluated

    def linearised(self, v: Array) -> Evaluation:
        """The stage at which F and its Jacobian are evaluated for velocities v (n_owned, 3); collective.

        One linear solve takes them where the step starts, also if handles move: elements at a handle would be
        stretched by its whole motion.
        """
        if self.evaluates_iterates:
            return self.evaluate(v)
        known = self.state.evaluation
        self.evaluated = Evaluation(self._xh, np.zeros_like(self._xh), known.internal if known else None)
        self.update_stencils(self._xh)
        return self.evaluated

    def revisit(self, evaluation: Evaluation) -> Evaluation:
        """An evaluation of the present equations again, with the pairs that are near there; collective."""
        self.evaluated = evaluation
        self.update_stencils(evaluation.x)
        return self.evaluated

    def change(self) -> None:
        """The equations have changed: nothing that has been evaluated holds any longer."""
        self.version += 1

    def forces_at_stage(self) -> Iterator[tuple[str, Array]]:
        """The parts of F at the stage of the step just accepted, each (n_owned, 3) [N]."""
        n, at = self.points.n_owned, self.prescribed.indices
        rate = self.stage.sigma * (self.evaluated.v[:n] - self.history)
        if self.stage.offset < self.dt and len(at):  # handles do not have the integrator's accelerations
            mean = (self.v[:n].take(at) - self.history.take(at)) / self.dt
            self.prescribed.overwrite(rate, mean)
        return self._parts(self.evaluated, rate)

    def _parts(self, at: Evaluation, vdot: Array) -> Iterator[tuple[str, Array]]:
        """Names and values (n_owned, 3) [N] of the parts of F.

        They are generated one by one, because all of them together take much memory. Internal forces come
        last, because terms keep data of them, which take memory, too.
        """
        self._squares = []
        yield self._with_square("inertia", self.mass[:, None] * vdot)
        del vdot
        constraints = self.present(self.active.constraints)
        friction = [term for term in constraints if term.registration.of_contact]
        springs = [term for term in constraints if term not in friction]
        for name, terms in (("springs", springs), ("friction", friction)):
            if terms:
                yield self._with_square(name, self._sum(terms, at.x))
        yield self._with_square("loads", -self.applied.force_at(at.x))
        if self.damping.active:
            yield self._with_square("damping", self._damping(at))
        if self.active.viscous and not self.integrator.lagged_loads:
            yield self._with_square("wind", self._sum(self.active.viscous, at.v))
        if at.internal is None:
            at.internal = self._sum(self.active.sheet, at.x)
        yield self._with_square("internal", at.internal)

    def _damping(self, at: Evaluation) -> Array:
        """The damping's part of F, (n_owned, 3) [N]."""
        if at.damping is not None:
            return at.damping
        found = self.damping.product(at.v)
        if self.integrator.iterates:  # else there is no second evaluation
            at.damping = found
        return found

    def _with_square(self, name: str, part: Array) -> tuple[str, Array]:
        """The part of F, after its square is kept for `largest_force`."""
        self._squares.append(squared_norm_without(part.reshape(-1), self.prescribed.not_counted))
        return name, part

    def present(self, terms: Sequence[Energy]) -> list[Energy]:
        """Those of ``terms`` that have elements on any rank: all while something is near."""
        near = self.near
        return [term for term in terms if near or not term.registration.of_contact]

    def _sum(self, terms: Sequence[Elastic | Viscous], at: Array) -> Array:
        return self.active.gradient(terms, at, self.points)

    def _total(self, at: Evaluation, vdot: Array, out: Array) -> Array:
        """F (n_owned, 3) [N], written to ``out``."""
        out[:] = 0.0
        for _, part in self._parts(at, vdot):
            out += part
            del part
        return out

    @property
    def evaluates_iterates(self) -> bool:
        """Whether F is evaluated where Newton's method is; else it is linear in v, from the positions where
        the step starts.
        """
        return self.integrator.iterates or self.solving_edges

    def residual(self, v: Array, at: Evaluation, out: Array) -> None:
        """Write F (n_owned, 3) [N] at velocities v (n_owned, 3), whose stage is `linearised` ``at``, to
        ``out``, in rows of prescribed unknowns σ m (v − v*); collective.
        """
        sigma, prescribed = self.stage.sigma, self.prescribed.indices
        self._total(at, sigma * (v - self.history), out)
        wrong = v.take(prescribed) - self.prescribed.velocity
        self.prescribed.overwrite(out, sigma * self.mass[prescribed // 3] * wrong)

    def residual_at(self, v: Array) -> Array:
        """F (n_owned, 3) [N] at velocities v (n_owned, 3); collective."""
        self.residual(v, self.linearised(v), out := np.empty_like(v))
        return out

    def objective(self, at: Evaluation) -> tuple[float, float]:
        """Value of the function whose gradient F is, and the scale to which its round-off is relative, both
        [W]; collective.

        The scale is the sum of the absolute summands and of the geometric mean of each elastic energy and the
        energy at which strains are of order one: small strains are small differences of large coordinates.
        """
        if at.objective is None:
            at.objective = self._objective(at)
        return at.objective

    def _objective(self, at: Evaluation) -> tuple[float, float]:
        n, rate, v = self.points.n_owned, 1.0 / self.stage.c, at.v[: self.points.n_owned]
        parts, square = [self.stage.sigma * kinetic_energy(self.mass, v - self.history)], 0.0
        for term in self.active.elastic:
            if not term.n_elements:
                continue
            each = term.energies(at.x, self.active.frozen[term])
            parts.append(rate * float(each.sum()))
            of_size: float | Array = rate * self._size
            if isinstance(term, LimitsStep):
                stiffness = term.stiffness(at.x, self.active.frozen[term])[: term.n_owned]
                sizes = term.coordinate_scale(self._size)
                of_size = rate * (sizes if isinstance(sizes, float) else sizes[: term.n_owned])
            elif term in self.stiffnesses:
                stiffness = self.stiffnesses[term]
            else:
                stiffness = term.force_scale(1.0)[: term.n_owned]
            # `**` would raise an error where the square is infinite
            square += 2.0 * float(np.vdot(each, stiffness * (of_size * of_size)))
        parts.append(-rate * float(np.vdot(self.applied.force, at.x[:n] - self.x[:n])))
        if self.applied.following is not None:
            parts.append(rate * self.applied.following.energy(at.x))
        if self.damping.active:
            parts.append(0.5 * float(np.vdot(v, self._damping(at))))
        if not self.integrator.lagged_loads:
            frozen = self.active.frozen
            parts += [float(wind.potentials(at.v, frozen[wind]).sum()) for wind in self.active.viscous]
        value, size, square = self.points.global_sum(sum(parts), sum(abs(part) for part in parts), square)
        return float(value), float(size) + float(np.sqrt(square))

    @cached_property
    def stiffnesses(self) -> dict[Term, Array]:
        """Force over displacement [N/m] of the owned elements of each term for which it is constant."""
        elastic = self.active.elastic
        constant = [t for t in elastic if not (t.registration.of_contact or isinstance(t, LimitsStep))]
        return {term: term.force_scale(1.0)[: term.n_owned] for term in constant}

    def largest_force(self) -> float:
        """Norm [N] of the largest part of F last evaluated, over the free unknowns; collective."""
        return float(np.sqrt(self.points.global_sum(*self._squares).max(initial=0.0)))

    def block_summary(self) -> list[str]:
        """Lines of text on the elements with changing stencils and the blocks that they add to the matrix;
        collective.

        The list is empty without such elements.
        """
        if self.contact is None:
            return []
        patterns = self.discretisation.fixed.pattern, self.discretisation.rows.pattern
        numbers = self.points.global_sum(*(pattern.n_couplings for pattern in patterns))
        fixed, every = numbers.astype(np.int64)
        pairs = self.contact.summary(self.evaluated.x, self.active.frozen)
        return [f"blocks: {fixed} of the mesh, {every - fixed} of pairs that act ({pairs})"]

    def limits_act(self, x: Array) -> bool:
        """Whether any term that limits steps acts at positions x (n_local, 3): its forces change too abruptly
        for one linear solve; collective.
        """
        terms, frozen = self.active.limiting, self.active.frozen
        acts = any(term.energies(x, frozen[term]).any() for term in terms)
        return bool(terms) and any(self.points.global_max(acts))

    def is_within_limits(self, x: Array) -> bool:
        """Whether positions x (n_local, 3) are within the limits of all terms; collective."""
        terms, frozen = self.active.limiting, self.active.frozen
        beyond = any(term.overrun(x, frozen[term])[1] for term in terms)
        return not terms or not any(self.points.global_max(beyond))

    def update_pattern(self) -> bool:
        """Update the pattern of the block rows to the pairs that act at the positions last evaluated.

        Returns whether the pattern changed; collective.
        """
        acting = (
            self.contact.acting(self.evaluated.x, self.active.frozen) if self.contact and self.near else {}
        )
        if acting:
            number = sum(int(np.count_nonzero(mask)) for mask in acting.values())
            self.has_active_pairs = any(self.points.global_max(number))
        else:
            self.has_active_pairs = False
        return self.discretisation.update_pattern(acting)

    @property
    def has_friction_pairs(self) -> bool:
        """Whether there are friction pairs; collective."""
        return self.contact is not None and self.contact.has_friction_pairs

    def follow_contacts(self, solution: Evaluation) -> bool:
        """Give friction the contacts of the stage that solves the equations, where these differ notably from
        theirs; returns whether they do; collective.
        """
        if not self.near or not self.integrator.dynamic or self.solving_edges:
            return False
        assert self.contact is not None
        if not self.contact.follow(solution.x, self.x, self.active.frozen):
            return False
        self.change()
        return True

    def forget_rows(self) -> None:
        """Drop all references to the rows that `jacobian` was given, so that their owner can free them."""
        self.damping.release_values()

    def jacobian(self, at: Evaluation, blend: float, values: Array) -> None:
        """Write σ M + c K + D + ∇∇P to block rows (n_blocks, 3, 3), prescribed unknowns decoupled.

        ``at`` is the `linearised` stage, ``blend`` the weight of the regularised elastic Hessian: 0 takes the
        exact one.
        """
        x, vs = at.x, at.v
        # may have other ghosts than x, but of contact only: those of fixed stencils are the first
        rows, predicted = self.discretisation.rows, self.predicted_stress.positions
        lagged = self.integrator.lagged_loads
        if not self.evaluates_iterates:  # the linear solve needs the memory
            at.internal = self.state.evaluation = None
        reach = self.stage.c
        inertia = self.stage.sigma * self.mass
        if self.active.with_edges:
            inertia[self.points.n_vertices :] += reach * self.directors.min_stiffness
        constrained = self.prescribed.constrained
        changing = constrained.changed
        if not (
            not self.evaluates_iterates
            and blend == 1.0
            and self.damping.assemble_with_stiffness(reach, inertia, values, changing)
        ):
            self.damping.assemble(values, inertia)
            for term in self.active.elastic:
                rows.add_stiffness(term, x, self.active.frozen[term], blend, reach, values, predicted)
        if not lagged:
            for wind in self.active.viscous:
                wind.add_hessian(vs, self.active.frozen[wind], rows.pattern.offsets, values)
        if self.applied.following is not None and blend < 1.0:
            self.applied.following.add_hessian((1.0 - blend) * reach, rows.pattern, values)
        self.prescribed_force = None if self.evaluates_iterates else self._force_of_prescribed(values)
        if len(changing):
            rows.constrain(values, self.prescribed.mask, constrained)

    def _force_of_prescribed(self, values: Array) -> Array | None:
        """The product (n_owned, 3) [N] of the Jacobian ``values``, before prescribed unknowns are decoupled,
        with the velocities of these; 0 in their rows. None if none moves; collective.
        """
        if not self.held:
            return None
        n, prescribed = self.points.n_owned, self.prescribed
        increment = np.zeros((self.points.n_local, 3))
        prescribed.overwrite(increment[:n], prescribed.velocity)
        if not any(self.points.global_max(bool(increment.any()))):
            return None
        self.points.update_ghosts(increment)
        return np.where(prescribed.free, self.discretisation.rows.product(values, increment), 0.0)
