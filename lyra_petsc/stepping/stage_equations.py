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

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.linear.block_rows import squared_norm_without
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.mesh.points import Layout
from lyra_petsc.stepping.active_terms import ActiveTerms
from lyra_petsc.stepping.applied_loads import AppliedLoads
from lyra_petsc.stepping.damping import Damping
from lyra_petsc.stepping.integrators.integrator import Integrator, NeedsAcceleration, Stage
from lyra_petsc.stepping.objective import Objective
from lyra_petsc.stepping.prescribed import Prescribed
from lyra_petsc.stepping.reference_positions import ReferencePositions
from lyra_petsc.stepping.state import State, resized
from lyra_petsc.terms.handles.prescribed_handles import ExactHandles
from lyra_petsc.terms.remembered import Remembered
from lyra_petsc.terms.term import LARGEST_ROTATION, Elastic, StepInterval, Term, UpcomingStep, Viscous

if TYPE_CHECKING:
    from lyra_petsc.stepping.impacts import ContactImpulses
    from lyra_petsc.terms.contact.one_sided import Springs


MAX_TURN = 0.25
"""Largest angle [rad] by which a Newton iteration of a static analysis may turn a director."""

MAX_SEARCHES = 40
"""Largest number of searches for near pairs along one displacement."""

MIN_KNOWN = 0.3
"""If the near pairs are known on less than this fraction of a displacement, the search covers all of it."""

IMPACT_STEP = 0.1
"""Displacement of a vertex in a step, over the skin of contact, from which on there may be an impact."""

MAX_SEPARATIONS = 40
"""Largest number of iterations that separate pairs which come too near."""

MIN_EDGE_STIFFNESS = 1e-10
"""Lower bound of the Jacobian's stiffness for an edge's unknown, over its stiffness at rest."""


class RefusedDisplacement(NamedTuple):
    """A displacement that is not free of collisions.

    Attributes
    ----------
    x, displacement : (n_local, 3)
        Start positions and displacements [m].
    part : StepInterval
        The part of the step in which the obstacles move meanwhile.
    """

    x: Array
    displacement: Array
    part: StepInterval


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
    dt, t0, t1 : float
        Length, start and end of the step [s].
    objective : Objective
        The function whose gradient F is.
    followers : list of NeedsAcceleration
        Objects besides the integrator (an error estimate) that need to know of jumps of the forces and of the
        accelerations after a jump.
    active : ActiveTerms
    applied : AppliedLoads
    has_active_pairs : bool
        Whether any pair of a term with changing stencils acted when the block rows were last renewed.
    starts_anew : bool
        Whether the integrator began the step from accelerations computed at its start.
    refused_displacement : RefusedDisplacement or None
        The displacement of the present step that was found to collide.
    prescribed_force : (n_owned, 3) or None
        Change [N] of F by the motion of prescribed unknowns, in steps of one linear solve; set by `jacobian`.
    """

    refused_displacement: RefusedDisplacement | None = None
    prescribed_force: Array | None = None
    has_active_pairs = starts_anew = False
    _frozen_before: Mapping[Term, Any] | None = None
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
        starts: list[float],
        events: list[float],
    ) -> None:
        self.discretisation, self.mass, self.integrator = discretisation, mass, integrator
        self.active = active = ActiveTerms(terms)
        self.held, self._events = held, events
        rows = np.concatenate([held.reference_rows, *(term.reference_rows for term in terms)])
        self.reference = ReferencePositions(self.points, rows, starts)
        self.prescribed = Prescribed(discretisation, held, self.reference)
        self.applied = AppliedLoads(active.loads, self.points)
        self._min_stiffness = self._min_edge_stiffness()
        internal, once = partial(self._sum, active.sheet), integrator.lagged_loads
        # with moving targets, forces at the same positions change
        self._internal = internal if active.moving else Remembered(internal)
        self._end_frames: dict[Term, Any] = {}  # frames of edges at the end of the last step
        self.damping = Damping(
            discretisation, active.elastic, dynamic=integrator.dynamic, single_assembly=once
        )
        last = (self._internal, self.damping.product) if once else ()
        self._evaluated_once = [each for each in last if isinstance(each, Remembered)]
        self.state = State(discretisation)
        n_local = self.points.n_local
        self._xs, self._vs = np.zeros((n_local, 3)), np.zeros((n_local, 3))
        self._xh, self.history = self.x, self.v[: self.points.n_owned]
        self.stage = Stage(1.0, 1.0, 1.0)
        self.objective = Objective(self)
        self.dt = self.t0 = self.t1 = self.moving_energy_before = 0.0
        self.followers: list[NeedsAcceleration] = []
        self._solving_edges = False  # between `begin_edge_solve` and `end_edge_solve`
        self._iterate: Array | None = None
        self._predicted: tuple[Array, Array] | None = None
        self._linearises_at_state = False
        self._uncorrected: Array | None = None
        self._squares: list[float] = []
        self.contact_impulses: ContactImpulses | None = None

    @property
    def points(self) -> Layout:
        """Layout of the local rows, with the ghosts that the present stencils need."""
        return self.discretisation.layout

    @property
    def x(self) -> Array:
        """Positions (n_local, 3) [m] of the state."""
        return self.state.x

    @property
    def v(self) -> Array:
        """Velocities (n_local, 3) [m/s] of the state."""
        return self.state.v

    def _min_edge_stiffness(self) -> Array:
        """Stiffness (n,) [N/m] that Jacobians add to the diagonal of the block rows of edges.

        Without it the rows of edges whose triangles have lost their area would be zero.
        """
        stiffness = np.zeros((self.points.n_local, 3))
        for term in self.active.with_edges:
            stiffness.reshape(-1)[term.edge_indices] = MIN_EDGE_STIFFNESS * term.edge_stiffness
        return stiffness[self.points.n_vertices : self.points.n_owned].max(axis=1)

    def set_references(self, time: float) -> None:
        """Take the present positions as reference of handles that start to act by ``time`` [s]."""
        self.reference.record_starts(time, self.x)

    def hold_targets(self, time: float) -> None:
        """Put moving targets at their positions at ``time`` [s], between two steps; collective."""
        self.t0 = self.t1 = time
        step = UpcomingStep(time, time, time, self.x, self.reference.at)
        self.active.freeze(step)
        self._update_stencils(self.x)  # energies at the start of a run need all stencils
        for term in self.active.changing:
            term.initialise_pairs(self.x, self.active.frozen[term])

    # -- a step ------------------------------------------------------------------------------------

    def begin_step(self, t0: float, t1: float) -> None:
        """Set up the equations of the step from t0 to t1 [s], and freeze its data; collective."""
        self.t0, self.t1, self.dt = t0, t1, t1 - t0
        self.refused_displacement = self._start_velocity = None
        self.set_iterate(None)
        after = self.integrator.stage_offset(self.dt)
        changed = self.prescribed.begin_step(t0, t1, self.x)
        displacement = self._expected_displacement() if self.discretisation.limits_motion else None
        self._update_stencils(self.x, displacement, self._expected_displacement)
        self._freeze(t0 + after)
        if self.active.pushing:  # obstacles may have come near
            # again, with the ghosts of now
            displacement = None if displacement is None else self._expected_displacement()
            self._update_stencils(self.x, displacement, self._expected_displacement)
        # the start of a step may differ from the time of an event by round-off
        if changed or any(abs(t0 - event) <= 1e-6 * self.dt for event in self._events):
            for follower in (self.integrator, *self.followers):
                follower.restart()
        self.starts_anew = self.integrator.needs_acceleration
        asking = [each for each in (self.integrator, *self.followers) if each.needs_acceleration]
        acceleration = self._accelerations(t0 + after) if asking else self.history
        for follower in asking:
            follower.set_acceleration(acceleration)
        n = self.points.n_owned
        self.stage = stage = self.integrator.stage(self.x[:n], self.v[:n], self.dt)
        if self.removes_contact_surplus:
            terms = self.active.limiting
            self._contact_energy = sum(float(t.energies(self.x, self.active.frozen[t]).sum()) for t in terms)
        self.history = self.v[:n] if stage.v is None else stage.v
        self._set_history(stage, t0 + after)
        self.moving_energy_before = self.active.moving_energy(self.x)

    def _expected_displacement(self, steps: int = 1) -> Array:
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

    def _accelerations(self, at: float) -> Array:
        """Accelerations (n_owned, 3) [m/s²] of the free unknowns at the start of the step.

        ``at`` [s] is the time of the step's stage.
        """
        v = self.v.copy()
        self.prescribed.overwrite_with_start_velocity(v[: self.points.n_owned])
        self.points.update_ghosts(v)
        x, turns = self._frozen_positions(at), bool(self.active.moving or self.active.constraints)
        if turns:  # at the stage targets are farther, and an obstacle may be where the sheet still is now
            self.active.move_targets(UpcomingStep(self.t0, self.t1, self.t0, x, self.reference.at))
        total = self._total(self.x, v, np.zeros_like(self.history), np.empty_like(self.history))
        if turns:
            self.active.move_targets(UpcomingStep(self.t0, self.t1, at, x, self.reference.at))
        force, mass = np.where(self.prescribed.free, -total, 0.0), self.mass[:, None]
        acceleration = np.divide(force, mass, out=np.zeros_like(force), where=mass > 0.0)
        if self.discretisation.has_near_elements:
            from lyra_petsc.stepping import impacts  # needed only if something is near

            for term in self.active.changing:
                if term.slips:
                    acceleration = impacts.hold_by_friction(self, term, v, acceleration)
        return acceleration

    def _freeze(self, at: float) -> None:
        """Freeze geometry, targets and loads at the time ``at`` [s] of the stage."""
        x = self._frozen_positions(at)
        self.active.freeze(UpcomingStep(self.t0, self.t1, at, x, self.reference.at))
        frozen, moves, self._frozen_before = self.active.frozen, self.integrator.dynamic, None
        if moves and any(frozen[term] is not self._end_frames.get(term) for term in self.active.with_edges):
            self.forget_forces()  # the frames of edges have changed
        self.objective.begin_step()
        if self.integrator.dynamic or self.applied.override is None:
            lagged = self.active.viscous and self.integrator.lagged_loads
            wind = self._sum(self.active.viscous, self.v) if lagged else None
            self.applied.freeze(self.t0, self.t1, x, wind)
        else:
            self.applied.force = self.applied.override
        if self.damping.active:
            self.damping.freeze(x, self.active.frozen)

    def _frozen_positions(self, at: float) -> Array:
        """Positions (n_local, 3) [m] whose geometry is frozen during the step."""
        if not self.integrator.centred:
            return self.x
        x = self.x + (at - self.t0) * self.v
        if self.points.n_edges_global:  # unknowns of edges are never extrapolated
            edges = ~self._vertex_rows
            x[edges] = self.x[edges]
        return x

    @cached_property
    def _vertex_rows(self) -> NDArray[np.bool_]:
        """Mask (n_local,) of the local rows of vertices; ghosts that contact adds are vertices."""
        return self.points.are_vertices(self.points.global_number)

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

    def out_of_balance(self) -> Array:
        """Force (n_owned, 3) [N] on the free unknowns."""
        total = self._total(self.x, self.v, np.zeros_like(self.history), np.empty_like(self.history))
        return np.where(self.prescribed.free, -total, 0.0)

    def forces_now(self) -> Iterator[tuple[str, Array]]:
        """The parts of F at the start of the step without inertia, each (n_owned, 3) [N]."""
        return self._parts(self.x, self.v, np.zeros_like(self.history))

    @property
    def stage_velocity(self) -> Array:
        """Velocities (n_owned, 3) [m/s] of the stage of the step just accepted."""
        return self._vs[: self.points.n_owned]

    @property
    def stage_positions(self) -> Array:
        """Positions (n_local, 3) [m] of the stage of the step just accepted."""
        return self._xs

    def prescribe(self, v: Array) -> None:
        """Overwrite the prescribed unknowns of v (n_owned, 3) by their velocities at the stage."""
        self.prescribed.overwrite(v, self.prescribed.velocity)

    def stationary_velocity(self) -> Array:
        """Velocities (n_owned, 3) [m/s] with which the stage is at the positions where the step starts."""
        return ((self.x - self._xh) / self.stage.c)[: self.points.n_owned]

    def start_velocity(self) -> Array:
        """Collision-free velocities (n_owned, 3) [m/s] for the first guess, with the prescribed ones.

        They are those that `find_start` found, else `stationary_velocity`.
        """
        if self._start_velocity is not None and not self._solving_edges:
            return self._start_velocity.copy()
        self.prescribe(v := self.stationary_velocity())
        return v

    def evaluate_at_start(self) -> None:
        """Evaluate the stage at the positions where the step starts; collective."""
        self.evaluate_at(self.stationary_velocity())

    def accept(self, v: Array) -> None:
        """Set the state at the end of the step from velocities v (n_owned, 3) of its stage; collective."""
        n, given, free = self.points.n_owned, self.integrator.handles_at_stage, self.prescribed.free
        self.evaluate_at(v)  # for the forces that are asked for after the step
        before, rate_before = self.x[:n], self.v[:n]
        moved, rate = self.integrator.end(before, rate_before, v, self.dt)
        self.integrator.record_step(before, rate_before, free, self.dt)
        self.prescribed.overwrite(moved, self.prescribed.goal)
        if given:
            self.prescribed.overwrite_with_end_velocity(rate)
        self.state.set(moved, rate)
        if self.active.limiting and self.integrator.dynamic:
            self._past_velocity = rate_before
            if self.stage.offset < self.dt:  # pairs that come near between the stage and the end
                self._update_stencils(self._xs, self.x - self._xs)
            if not self.discretisation.has_near_elements:
                self.integrator.surplus, self.contact_impulses = max(self.integrator.surplus, 0.0), None
                return
            from lyra_petsc.stepping import impacts  # needed only if something is near

            normal_force = np.zeros(n)
            if self.removes_contact_surplus:
                left = self.integrator.surplus
                self.integrator.surplus, normal_force = impacts.remove_surplus(
                    self, self._contact_energy, before, left
                )
            self.contact_impulses = impacts.damp_impacts(self, normal_force)
            for term in self.active.changing:
                if term.slips:
                    self.contact_impulses = impacts.correct_friction(self, term, self.contact_impulses)

    def go_on_with(self, integrator: Integrator, v_before: Array) -> None:
        """Change the integrator after a step from velocities v_before (n_owned, 3) that another one took."""
        by_end = self.integrator.order == 1
        self.integrator = integrator
        integrator.restart()
        if by_end:  # from stage velocities: those after an impact would give stiff damping huge forces
            rate = (self.stage_velocity - v_before) / self.dt
            moves = self.prescribed.free & (self.mass[:, None] > 0.0)
            integrator.set_acceleration(np.where(moves, rate, 0.0))

    def reopen(self, x_before: Array) -> None:
        """Let the equations of the step just accepted, from x_before (n_owned, 3), be evaluated again;
        collective.
        """
        if self._xh is self.x:
            self._xh = resized(x_before, self.points.n_owned, self.points.n_local)
            self.points.update_ghosts(self._xh)

    def initial_edge_moments(self) -> float:
        """Norm [N] of the moments on free edges at the start of a run, handles set; collective."""
        self.prescribed.begin_step(self.t0, self.t0, self.x)
        moments = np.where(self.prescribed.free, self._internal(self.x), 0.0)[self.points.n_vertices :]
        return float(np.sqrt(self.points.global_sum(float(np.vdot(moments, moments)))[0]))

    # -- unknowns of edges ---------------------------------------------------------------------------

    def move_frames_to_end(self) -> None:
        """Update the frames of edges at the end of a step that is one linear solve.

        The forces at the end are then those with which the next step begins.
        """
        edged, frozen = self.active.with_edges, self.active.frozen
        if edged and self.integrator.lagged_loads and self.integrator.dynamic:
            self.active.refreeze({term: term.frames_at_end(self.x, frozen[term]) for term in edged})
            self._frozen_before = frozen
            self.forget_forces()
            self._end_frames = {term: self.active.frozen[term] for term in edged}

    @property
    def frozen_in_step(self) -> Mapping[Term, Any]:
        """Frozen data of terms in the step, before `move_frames_to_end`."""
        return self.active.frozen if self._frozen_before is None else self._frozen_before

    def update_frames(self) -> bool:
        """Update the frames of edges that have turned far from theirs to the positions last evaluated.

        Returns whether any changed, and with them the forces on vertices; collective.
        """
        found: dict[Term, Any] = {}
        for term in () if self._solving_edges else self.active.with_edges:
            updated = term.updated_frames(self._xs, self.active.frozen[term], self.prescribed.mask)
            found |= {} if updated is None else {term: updated}
        if not self.points.comm.allreduce(len(found), MPI.MAX):
            return False
        self.active.refreeze(found)
        self.forget_forces()
        return True

    def turn_directors(self, v: Array, increment: Array) -> bool:
        """Turn directors with their triangles where an increment (n_owned, 3) [m/s] from v turns them far.

        Changes ``increment``; returns whether it did; collective. The linear increment leads vertices off
        their circles, and directors much too far.
        """
        if not self.active.with_edges or self.stage.c * self.largest_turn(increment) <= LARGEST_ROTATION:
            return False
        x, displacement = self.displacement(v, increment)
        changed, frozen = 0, self.active.frozen
        for term in self.active.with_edges:
            changed += self._set_increments(increment, *term.edge_increments(x, displacement, frozen[term]))
        return bool(self.points.comm.allreduce(changed, MPI.MAX))

    def match_directors(self, v: Array, increment: Array, curved: Array) -> None:
        """Set the edges' unknowns in ``curved`` (n_owned, 3) [m/s], an increment from v along arcs.

        Each director gets the same angle to its triangles as by the linear ``increment``; collective.
        """
        along = self.displacement(v, curved)[1]
        x, displacement = self.displacement(v, increment)
        for term in self.active.with_edges:
            self._set_increments(
                curved, *term.edge_increments(x, displacement, self.active.frozen[term], along)
            )

    def _set_increments(self, increment: Array, indices: Ints, values: Array) -> bool:
        """Put displacements (m,) [m] of the free unknowns ``indices`` (m,) into ``increment`` (n_owned, 3).

        Returns whether there were any.
        """
        own = indices < increment.size
        own[own] = self.prescribed.free.ravel()[indices[own]]
        increment.reshape(-1)[indices[own]] = values[own] / self.stage.c
        return bool(own.any())

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
        self.set_iterate(None)
        self.objective.forget()
        self.stage = Stage(1.0 / dt, dt, dt)
        self.history = np.zeros((n, 3))
        self._xh = resized(x_before, n, self.points.n_local)
        self.points.update_ghosts(self._xh)
        self.active.move_targets(UpcomingStep(self.t0, self.t1, self.t1, self.x, self.reference.at))
        self.prescribed.hold_vertices(self.x[:n])
        self._solving_edges = True
        self.prescribed.set_velocity_to_goal(self._xh[:n], dt)

    def end_edge_solve(self, v: Array | None) -> None:
        """Set the edges' unknowns from their rates v (n_owned, 3), unless None, and restore the stage;
        collective.
        """
        n = self.points.n_owned
        moved = None if v is None else self._xh[:n] + self.stage.c * v
        self.stage, self.history, self._xh, stage_velocity, self.active.frozen = self._stage_before_edges
        self.prescribed.release_vertices()
        self._solving_edges = False
        self.objective.forget()
        self.set_iterate(None)
        if moved is not None:
            rows = slice(self.points.n_vertices, n)
            self.x[rows] = moved[rows]
            self.state.update_ghosts()
        self.evaluate_at(stage_velocity)

    # -- terms -------------------------------------------------------------------------------------

    def output_velocity(self) -> Array:
        """Velocities (n_owned, 3) [m/s] for output: those of prescribed unknowns are ẋ*(t)."""
        self.prescribed.overwrite_with_end_velocity(velocity := self.v[: self.points.n_owned].copy())
        return velocity

    def gradient_of(self, terms: Sequence[Elastic], x: Array) -> Array:
        """Gradient (n_owned, 3) [N] at x (n_local, 3) of the energy of ``terms``: all without targets."""
        return self._sum(terms, x) if self.active.moving else self._internal(x)

    def obstacle_work(self) -> float:
        """Work [J] of moving obstacles on this rank's elements in the step, by their forces at the stage."""
        at = self.t0 + self.stage.offset if self.integrator.dynamic else self.t1
        work = sum(term.work(self._xs, at, self.t0, self.t1) for term in self.active.pushing)
        return work + (self.contact_impulses.work if self.contact_impulses else 0.0)

    def move_targets_to_end(self) -> float:
        """Put moving targets at the end of the step; the change [J] of the energy of this rank's terms."""
        if self.stage.offset == self.dt or not (self.active.moving or self.active.constraints):
            return 0.0
        before = self.active.moving_energy(self.x)
        self.active.move_targets(UpcomingStep(self.t0, self.t1, self.t1, self.x, self.reference.at))
        return self.active.moving_energy(self.x) - before

    @property
    def removes_contact_surplus(self) -> bool:
        """Whether the energy that contact adds is known and removed; not so with moving obstacles."""
        return self.integrator.exact_work and bool(self.active.limiting) and not self.active.pushing

    @property
    def limits_steps(self) -> bool:
        """Whether `largest_step` may be less than 1.

        So it is with contact, and in statics with directors, which would else reach a distant equilibrium.
        """
        return bool(self.active.limiting) or (bool(self.active.with_edges) and not self.integrator.dynamic)

    def largest_step(self, v: Array, increment: Array) -> float:
        """Largest fraction of an increment (n_owned, 3) [m/s] from v that all terms allow; collective."""
        turn = 0.0 if self.integrator.dynamic else self.largest_turn(increment * self.stage.c)
        return self._free_fraction(v, increment, MAX_TURN / turn if turn > MAX_TURN else 1.0)

    def moves_freely(self, v: Array, increment: Array) -> bool:
        """Whether no collision limits an increment (n_owned, 3) [m/s] from v; collective."""
        return not self.active.limiting or self._free_fraction(v, increment, 1.0) == 1.0

    def _free_fraction(self, v: Array, increment: Array, maximum: float) -> float:
        """Largest fraction, at most ``maximum``, of an increment from v without a collision; collective."""
        done = 0.0
        for _ in range(MAX_SEARCHES):
            start, rest = v, increment
            if done > 0.0 or maximum < 1.0:
                start, rest = v + done * increment, (maximum - done) * increment
            x, displacement, known = self._known_displacement(start, rest)
            fraction = known
            if self.discretisation.has_near_elements:
                frozen = self.active.frozen
                allowed = [term.largest_step(x, displacement, frozen[term]) for term in self.active.limiting]
                fraction = self._global_minimum(min([fraction, *allowed]))
            if fraction == 1.0:
                return maximum
            done += fraction * (maximum - done)
            if fraction < known:
                break
        return done

    def _known_displacement(
        self, v: Array, increment: Array, minimum: float = MIN_KNOWN
    ) -> tuple[Array, Array, float]:
        """`displacement`, and the fraction of it on which all near pairs are known; collective.

        Where the fraction is less than ``minimum``, pairs are searched along the whole displacement.
        """
        x, displacement = self.displacement(v, increment)
        known = self.discretisation.searched_fraction(x, displacement)
        if known >= minimum:
            return x, displacement, known
        self._update_stencils(x, displacement)
        x, displacement = self.displacement(v, increment)
        return x, displacement, self.discretisation.searched_fraction(x, displacement)

    def second_order_correction(self, v: Array, increment: Array) -> Array | None:
        """The increment (n_owned, 3) [m/s] from v, changed to separate the pairs that it brings too near.

        None if no pair comes too near; collective. Along a linear increment a sheet that rotates comes nearer
        to its contacts, or passes them, by the square of its rotation.
        (Nocedal & Wright, Numerical Optimization, 2nd ed., sec. 15.6.)
        """
        if not self.active.limiting:
            return None
        x, displacement, _ = self._known_displacement(v, increment, 1.0)
        if not self.discretisation.has_near_elements:
            return None
        n, frozen, changed = len(increment), self.active.frozen, False
        targets = {t: t.target_distances(x, displacement, frozen[t]) for t in self.active.limiting}
        for _ in range(MAX_SEPARATIONS):
            out, count = np.zeros_like(x), np.zeros((len(x), 1))
            found = [t.add_corrections(x, displacement, frozen[t], targets[t], out, count) for t in targets]
            if not self.points.comm.allreduce(any(found), MPI.LOR):
                break
            change = np.divide(out[:n], count[:n], out=np.zeros((n, 3)), where=count[:n] > 0.0)
            displacement[:n] += np.where(self.prescribed.free, change, 0.0)
            self.points.update_ghosts(displacement)
            changed = True
        return displacement[:n] / self.stage.c if changed else None

    def contact_springs(self, v: Array, increment: Array) -> dict[Elastic, Springs]:
        """Springs of the pairs that touch at v, or may touch along an increment (n_owned, 3) [m/s] from v.

        Collective. Their blocks are part of the matrix until `release_contact_springs`.
        """
        x, displacement, _ = self._known_displacement(v, increment, 1.0)
        frozen = self.active.frozen
        moved = np.linalg.norm(displacement[: self.points.n_vertices], axis=1).max(initial=0.0)
        approach = 2.0 * self.points.global_max(float(moved))[0]
        found = {term: term.springs(x, approach, frozen[term]) for term in self.active.limiting}
        return {term: springs for term, springs in found.items() if springs is not None}

    def add_contact_springs(
        self, springs: Mapping[Elastic, Springs], stiffness: Mapping[Elastic, Array], values: Array
    ) -> None:
        """Add springs with these stiffnesses [N/m] to the Jacobian's block rows (n_blocks, 3, 3)."""
        rows, constrained = self.discretisation.rows, self.prescribed.constrained
        for term, each in springs.items():
            reach = self.stage.c
            each.add_stiffness(reach * stiffness[term], rows.pattern.offsets[term.name], values)
        if len(constrained.changed):
            rows.constrain(values, self.prescribed.mask, constrained)

    def release_contact_springs(self, length: Mapping[Elastic, Array]) -> None:
        """End the use of `contact_springs`; ``length`` [m] is theirs after the increment taken.

        It is empty where another increment is taken.
        """
        for term in self.active.limiting:
            term.release_springs(length.get(term))

    def largest_turn(self, displacement: Array) -> float:
        """Largest angle [rad] by which directors turn in a displacement (n_owned, 3) [m]; collective."""
        turn = max((term.largest_rotation(displacement) for term in self.active.with_edges), default=0.0)
        return float(self.points.comm.allreduce(turn, MPI.MAX))

    def _global_minimum(self, number: float) -> float:
        """Minimum over all ranks; collective."""
        return -self.points.global_max(-number)[0]

    def displacement(self, v: Array, increment: Array) -> tuple[Array, Array]:
        """Stage positions at velocities v (n_owned, 3), and displacements from there, both (n_local, 3) [m].

        ``increment`` (n_owned, 3) [m/s] is added to the velocities; collective.
        """
        x = self.evaluate_at(v)[0]
        displacement = resized(increment * self.stage.c, len(increment), self.points.n_local)
        self.points.update_ghosts(displacement)
        return x, displacement

    def find_start(self) -> bool:
        """Find velocities from which the step's solve can start without a collision; whether there are any.

        Tried in this order: all free vertices stay, all keep their velocities, and the same with vertices
        moved by the obstacles that would hit them. Obstacles and prescribed unknowns move as they must;
        collective.
        """
        still = self.stationary_velocity()
        moves = self.prescribed.velocity != still.take(self.prescribed.indices)
        if not any(self.points.global_max(bool(self.active.pushing) or bool(moves.any()))):
            return True
        at_rest, refused = self.integrator.starts_at_rest, None
        candidates = [still] if at_rest else [still, self.v[: len(still)]]
        tried = [(v, False) for v in candidates]
        if self.active.pushing and not at_rest:
            tried += [(v, True) for v in candidates]
        for v, pushed in tried:
            start = still + self._moved_with_obstacles(still, v - still) if pushed else v.copy()
            self.prescribe(start)
            if self._is_collision_free(still, start - still):
                self.refused_displacement, self._start_velocity = None, start
                return True
            # keep the first one: with the sheet at rest it shows what moves into the sheet
            refused = refused or self.refused_displacement
        self.refused_displacement = refused
        return False

    def _moved_with_obstacles(self, v: Array, increment: Array) -> Array:
        """The ``increment`` (n_owned, 3) [m/s] from v, with vertices in the path of obstacles moved by them;
        collective.
        """
        n = len(increment)
        for _ in range(MAX_SEARCHES):
            x, displacement = self.displacement(v, increment)
            moved = displacement
            for term in self.active.pushing:
                moved = term.moved_with_obstacles(x, moved, self.active.frozen[term])
            change = moved[:n] != displacement[:n]
            if not self.points.comm.allreduce(bool(change.any()), MPI.LOR):
                break
            increment = np.where(change, moved[:n] / self.stage.c, increment)
        return increment

    def _is_collision_free(self, v: Array, increment: Array, *, after: bool = False) -> bool:
        """Whether the sheet moves from velocities v by ``increment`` (n_owned, 3) [m/s] without a collision.

        Obstacles move to the stage meanwhile, or with ``after`` from the stage to the end of the step. Sets
        `refused_displacement` on a collision; collective.
        """
        done, begin = 0.0, float(after)
        for _ in range(MAX_SEARCHES):
            x, displacement, known = self._known_displacement(v + done * increment, (1.0 - done) * increment)
            displacement *= known
            part = StepInterval(begin + done, begin + (1.0 if known == 1.0 else done + known * (1.0 - done)))
            frozen, limiting = self.active.frozen, self.active.limiting
            free = [term.is_collision_free(x, displacement, frozen[term], part) for term in limiting]
            if not self._global_minimum(float(all(free))):
                break
            if known == 1.0:
                return True
            done = part.end - begin
        self.refused_displacement = RefusedDisplacement(x.copy(), displacement, part)
        return False

    def end_is_collision_free(self, v: Array) -> bool:
        """Whether the sheet moves from the stage with velocities v (n_owned, 3) to the end of the step
        without a collision; collective.
        """
        if self.stage.offset == self.dt and self.integrator.iterates:
            return True
        n = self.points.n_owned
        end = self.integrator.end(self.x[:n], self.v[:n], v, self.dt)[0]
        # Newton's method has checked the displacement to the stage, a single linear solve has not
        x = self.evaluate_at(v)[0] if self.integrator.iterates else self.x
        displacement = end - x[:n]
        discretisation = self.discretisation
        if not discretisation.has_near_elements and discretisation.searched_fraction(x, displacement) == 1.0:
            return True
        v = v if self.integrator.iterates else self.stationary_velocity()
        return self._is_collision_free(v, displacement / self.stage.c, after=True)

    # -- residual and Jacobian -----------------------------------------------------------------------

    def _update_stencils(
        self, x: Array, displacement: Array | None = None, ahead: Callable[[int], Array] | None = None
    ) -> None:
        """Update changing stencils to positions x (n_local, 3), and all arrays to their ghosts; collective.

        ``displacement`` and ``ahead`` are as in `Discretisation.update_stencils`.
        """
        discretisation = self.discretisation
        if not discretisation.stencils_change or not discretisation.update_stencils(x, displacement, ahead):
            return
        layout = self.points
        n, n_local = layout.n_owned, layout.n_local
        same = self._xh is self.x
        self.state.resize()
        self._xh = self.x if same else resized(self._xh, n, n_local)
        self._xs, self._vs = resized(self._xs, n, n_local), resized(self._vs, n, n_local)
        for values in (self._xh, self._xs, self._vs):
            layout.update_ghosts(values)
        self.__dict__.pop("_vertex_rows", None)
        self.prescribed.resize()

    def evaluate_at(self, v: Array) -> tuple[Array, Array]:
        """Positions and velocities (n_local, 3) of the stage, ghosts up to date; collective."""
        self._vs[: self.points.n_owned] = v
        self.points.update_ghosts(self._vs)
        np.multiply(self._vs, self.stage.c, out=self._xs)
        self._xs += self._xh
        self._update_stencils(self._xs)
        return self._xs, self._vs

    @property
    def evaluated(self) -> tuple[Array, Array]:
        """The positions and velocities that `evaluate_at` last returned."""
        return self._xs, self._vs

    def forces_at_stage(self) -> Iterator[tuple[str, Array]]:
        """The parts of F at the stage of the step just accepted, each (n_owned, 3) [N]."""
        n, at = self.points.n_owned, self.prescribed.indices
        rate = self.stage.sigma * (self._vs[:n] - self.history)
        if self.stage.offset < self.dt and len(at):  # handles do not have the integrator's accelerations
            mean = (self.v[:n].take(at) - self.history.take(at)) / self.dt
            self.prescribed.overwrite(rate, mean)
        return self._parts(self._xs, self._vs, rate)

    def _parts(self, x: Array, vs: Array, vdot: Array) -> Iterator[tuple[str, Array]]:
        """Names and values (n_owned, 3) [N] of the parts of F.

        They are generated one by one, because all of them together take much memory. Internal forces come
        last, because their remembered data take memory, too.
        """
        self._squares = []
        yield self._with_square("inertia", self.mass[:, None] * vdot)
        del vdot
        constraints = self._present(self.active.constraints)
        for name, slips in (("springs", False), ("friction", True)):
            if terms := [term for term in constraints if term.slips is slips]:
                yield self._with_square(name, self._sum(terms, x))
        yield self._with_square("loads", -self.applied.force_at(x))
        if self.damping.active:
            yield self._with_square("damping", self.damping.product(vs))
            if self.integrator.lagged_loads:  # there is no second evaluation
                self.damping.product.forget()
        if self.active.viscous and not self.integrator.lagged_loads:
            yield self._with_square("wind", self._sum(self.active.viscous, vs))
        yield self._with_square("internal", self._internal(x))

    def _with_square(self, name: str, part: Array) -> tuple[str, Array]:
        """The part of F, after its square is kept for `largest_force`."""
        self._squares.append(squared_norm_without(part.reshape(-1), self.prescribed.not_counted))
        return name, part

    def _present(self, terms: Sequence[Elastic]) -> list[Elastic]:
        """Those of ``terms`` that have elements on any rank: all while something is near."""
        near = self.discretisation.has_near_elements
        return [term for term in terms if near or not term.registration.neighbours]

    def _sum(self, terms: Sequence[Elastic | Viscous], at: Array) -> Array:
        return self.active.gradient(terms, at, self.points)

    def _total(self, x: Array, vs: Array, vdot: Array, out: Array) -> Array:
        """F (n_owned, 3) [N], written to ``out``."""
        out[:] = 0.0
        for _, part in self._parts(x, vs, vdot):
            out += part
            del part
        return out

    def _linearised_at(self, v: Array) -> Array:
        """Velocities (n_owned, 3) at which F and its Jacobian are evaluated for v.

        One linear solve takes them where the step starts, also if handles move: elements at a handle would be
        stretched by its whole motion.
        """
        return np.zeros_like(v) if self._from_start else v

    @property
    def _from_start(self) -> bool:
        """Whether F is linear in v, from the positions where the step starts."""
        return not (self.integrator.iterates or self._solving_edges)

    def residual(self, v: Array, vdot: Array, out: Array) -> None:
        """Write F (n_owned, 3) [N] to ``out``, in rows of prescribed unknowns σ m (v − v*); collective."""
        self._total(*self.evaluate_at(self._linearised_at(v)), vdot, out)
        at, velocity = self.prescribed.indices, self.prescribed.velocity
        self.prescribed.overwrite(out, self.stage.sigma * self.mass[at // 3] * (v.take(at) - velocity))

    def largest_force(self) -> float:
        """Norm [N] of the largest part of F last evaluated, over the free unknowns; collective."""
        return float(np.sqrt(self.points.global_sum(*self._squares).max(initial=0.0)))

    def block_summary(self) -> list[str]:
        """Lines of text on the elements with changing stencils and the blocks that they add to the matrix;
        collective.

        The list is empty without such elements.
        """
        near = self.active.changing
        if not near:
            return []
        acting = [np.count_nonzero(mask[: t.n_owned]) for t, mask in self._acting_elements().items()]
        patterns = self.discretisation.fixed.pattern, self.discretisation.rows.pattern
        fixed, every, *numbers = self.points.global_sum(
            *(pattern.n_couplings for pattern in patterns), *acting, *(t.n_owned for t in near)
        ).astype(np.int64)
        pairs = [
            f"{t.name} {acts} of {known}"
            for t, acts, known in zip(near, numbers, numbers[len(near) :], strict=False)
        ]
        return [f"blocks: {fixed} of the mesh, {every - fixed} of pairs that act ({', '.join(pairs)})"]

    def _acting_elements(self) -> dict[Elastic, NDArray[np.bool_]]:
        """Which elements of each term with changing stencils act at the positions last evaluated."""
        x, frozen = self._xs, self.active.frozen
        return {term: term.active_elements(x, frozen.get(term)) for term in self.active.changing}

    def update_pattern(self) -> bool:
        """Update the pattern of the block rows to the pairs that act at the positions last evaluated.

        Returns whether the pattern changed; collective.
        """
        if not self.discretisation.has_near_elements:
            self.has_active_pairs = False
            return self.discretisation.update_pattern({})
        acting = self._acting_elements()
        if acting:
            number = sum(int(np.count_nonzero(mask)) for mask in acting.values())
            self.has_active_pairs = any(self.points.global_max(number))
        return self.discretisation.update_pattern(acting)

    @property
    def has_friction_pairs(self) -> bool:
        """Whether there are friction pairs: one linear solve cannot decide whether they stick or slide.

        Collective.
        """
        if not self.discretisation.has_near_elements:
            return False
        return any(self.points.global_max(sum(term.n_friction_pairs for term in self.active.changing)))

    @property
    def touches(self) -> bool:
        """Whether anything touches at the positions last evaluated: the forces of contact and friction change
        too abruptly for one linear solve.

        Collective.
        """
        if not self.discretisation.has_near_elements:
            return False
        return any(self.points.global_max(any(mask.any() for mask in self._acting_elements().values())))

    @property
    def may_impact(self) -> bool:
        """Whether parts are near each other, and vertices move by a notable part of the gap in the step;
        collective.
        """
        limiting = self.active.limiting
        if not (limiting and self.discretisation.has_near_elements):
            return False
        largest = self.stage.c * np.abs(self._vs[: self.points.n_vertices]).max(initial=0.0)
        return self.points.global_max(float(largest))[0] > IMPACT_STEP * min(term.skin for term in limiting)

    def may_collide(self, approach: float) -> bool:
        """Whether parts may collide in the step, approaching by more than ``approach`` [m]; collective."""
        limiting = self.active.limiting
        if not self.discretisation.has_near_elements or not self.integrator.dynamic or self._solving_edges:
            return False
        x, displacement, frozen = self.x, self._expected_displacement(), self.active.frozen
        found = any(t.may_collide(x, displacement, frozen[t], approach) for t in limiting)
        return any(self.points.global_max(found))

    def set_iterate(self, v: Array | None) -> None:
        """Set Newton's iterate v; the Jacobian takes the stress predicted from the iterate before it.

        The predicted stress is the strain's linearisation at the iterate before, as in a mixed method: stiff
        sheets then converge as fast as soft ones. None forgets the iterates.
        """
        before, self._predicted = self._iterate, None
        self._iterate = None if v is None else self.evaluate_at(v)[0].copy()
        if before is not None and self._iterate is not None:
            reached = self._iterate if self._uncorrected is None else self._uncorrected
            self._predicted = before, before if self._linearises_at_state else reached
        self._uncorrected = None
        self._linearises_at_state = False

    def linearise_to(self, v: Array) -> None:
        """Predict the stress of the next Jacobian at velocities v (n_owned, 3): the iterate uncorrected."""
        self._uncorrected = self.evaluate_at(v)[0].copy()

    def linearise_at_state(self) -> None:
        """Let the first Jacobian take the stress of the state, from which Newton's first iterate is far."""
        self._iterate, self._linearises_at_state = self.x.copy(), True

    def forget_forces(self) -> None:
        """Discard the remembered energies and forces."""
        if isinstance(self._internal, Remembered):
            self._internal.forget()
        self.objective.forget()

    def transport_frames(self, frozen: Mapping[Term, Any] | None = None) -> None:
        """Transport the frames of directors, those in use or in ``frozen``, to the present positions."""
        for term in self.active.with_edges:
            term.accept(self.x, (frozen or self.active.frozen)[term])
        if self.active.with_edges:
            self.forget_forces()  # where directors are loaded, those on vertices depend on the frames

    def forget_directors(self) -> None:
        """Discard the remembered directors, whose memory the linear solve needs."""
        for term in self.active.with_edges:
            term.clear_cache()

    def forget_rows(self) -> None:
        """Drop all references to the rows that `jacobian` was given, so that their owner can free them."""
        self.damping.release_values()

    def jacobian(self, v: Array, blend: float, values: Array) -> None:
        """Write σ M + c K + D + ∇∇P to block rows (n_blocks, 3, 3), prescribed unknowns decoupled.

        ``blend`` is the weight of the regularised elastic Hessian: 0 takes the exact one.
        """
        x, vs = self.evaluate_at(self._linearised_at(v))
        # may have other ghosts than x, but of contact only: those of fixed stencils are the first
        rows, predicted = self.discretisation.rows, self._predicted
        lagged = self.integrator.lagged_loads
        for remembered in self._evaluated_once:  # the linear solve needs the memory
            remembered.forget()
        reach = self.stage.c
        inertia = self.stage.sigma * self.mass
        if self.active.with_edges:
            inertia[self.points.n_vertices :] += reach * self._min_stiffness
        constrained = self.prescribed.constrained
        changing = constrained.changed
        if blend < 1.0 or not self.damping.assemble_with_stiffness(x, reach, inertia, values, changing):
            self.damping.assemble(values, inertia)
            for term in self.active.elastic:
                rows.add_stiffness(term, x, self.active.frozen[term], blend, reach, values, predicted)
        if not lagged:
            for wind in self.active.viscous:
                wind.add_hessian(vs, self.active.frozen[wind], rows.pattern.offsets, values)
        if self.applied.following is not None and blend < 1.0:
            self.applied.following.add_hessian((1.0 - blend) * reach, rows.pattern, values)
        self.prescribed_force = self._force_of_prescribed(values) if self._from_start else None
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
