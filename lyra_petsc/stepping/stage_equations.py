"""The implicit equations of one step: residual, Jacobian and objective in the velocities of the stage.

Unknown v (the velocity of the integrator's stage), with its history x_h, v_h and numbers σ, c::

    F(v, v̇) = M v̇ + ∇E(x_h + c v) + D v + ∇P(v) − f,  v̇ = σ (v − v_h)       Jacobian  σ M + c K + D + ∇∇P

with the elastic energy E, damping D = γ K⁺, the wind's potential P and the loads f. It is the gradient
of ``objective``. Backward Euler has x_h = x_n, v_h = v_n, σ = 1/c = 1/Δt: the Lyra paper, eq. 10-18, as
a Newton iteration. The geometry of D, P and f is frozen during a step: at x_n for first-order integrators,
at the extrapolated stage x_n + (t_s − t_n) v_n for second-order ones.

Unknowns of edges have no mass: their part of F is ∂E/∂φ, and they are in equilibrium at the stage. Where that
is not the end of the step they are sought once more there (`StageEquations.begin_edges`).

Arrays only: no PETSc here. Collective where sums over ranks are returned.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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
from lyra_petsc.terms.prescribed_handles import Held
from lyra_petsc.terms.remembered import Remembered
from lyra_petsc.terms.term import LARGEST_TURN, Elastic, StepInterval, Term, UpcomingStep, Viscous

if TYPE_CHECKING:
    from lyra_petsc.stepping.impacts import Damped
    from lyra_petsc.terms.one_sided import Springs


FARTHEST_TURN = 0.25
"""Angle [rad] by which a Newton iteration of a static analysis may turn a director."""

SEARCHES = 40
"""For what is near, at most, on the way of a Newton iteration or of handles in a step."""

FEW = 0.3
"""Part of a way that must be known for the rest to be searched bit by bit; else all of it is at once."""

IMPACT = 0.1
"""How far vertices go in a step, over the skin of what they touch, from which on that may be an impact."""

PUSHES = 40
"""By which what has come too near is set aside, or what leaves taken back, at most."""

LEAST = 1e-10
"""Stiffness of an edge's unknown over that at rest, below which Jacobians do not go."""


class RefusedDisplacement(NamedTuple):
    """What may not be gone because something meets there.

    Attributes
    ----------
    x, ahead : (n_local, 3)
        Where it begins and how far it goes [m].
    part : StepInterval
        Of the step, in which obstacles go theirs, too.
    """

    x: Array
    ahead: Array
    part: StepInterval


class StageEquations:
    """One rank's part of the equations, and the state (x_n, v_n) a step starts from.

    Parameters
    ----------
    discretisation : Discretisation
    mass : (n_owned,) [kg]
        Of block rows: the lumped mass of vertices, 0 of edges.
    terms : sequence of Term
    held : Held
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
        Unknowns that are held in the step.
    moving_energy_before : float
        Energy [J] of this rank's terms with moving targets at the start of the step, with these where they
        stand at its stage.
    dt, t0, t1 : float
        Length, start and end of the step [s].
    objective : Objective
        The function whose gradient F is.
    followers : list of NeedsAcceleration
        Who must hear of jumps and of the accelerations after them, as the integrator does: an error estimate.
    active : ActiveTerms
    applied : AppliedLoads
    touches : bool
        Whether anything acted that changes its stencils, where the block rows were last renewed.
    refused_way : RefusedDisplacement or None
        What the present step may not go.
    """

    refused_way: RefusedDisplacement | None = None
    touches = False
    _frozen_before: Mapping[Term, Any] | None = None
    _may_begin: Array | None = None  # where ``may_move`` found a way to

    def __init__(
        self,
        discretisation: Discretisation,
        mass: Array,
        terms: Sequence[Term],
        held: Held,
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
        self._least = self._least_stiffness()
        internal, once = partial(self._sum, active.sheet), integrator.lagged_loads
        # moving targets change the forces at one and the same place
        self._internal = internal if active.moving else Remembered(internal)
        self._frames: dict[Term, Any] = {}  # by which these are known at the end of a step
        self.damping = Damping(
            discretisation, active.elastic, dynamic=integrator.dynamic, single_assembly=once
        )
        last = (self._internal, self.damping.product) if once else ()
        self._asked_once = [each for each in last if isinstance(each, Remembered)]
        self.state = State(discretisation)
        n_local = self.points.n_local
        self._xs, self._vs = np.zeros((n_local, 3)), np.zeros((n_local, 3))
        self._xh, self.history = self.x, self.v[: self.points.n_owned]
        self.stage = Stage(1.0, 1.0, 1.0)
        self.objective = Objective(self)
        self.dt = self.t0 = self.t1 = self.moving_energy_before = 0.0
        self.followers: list[NeedsAcceleration] = []
        self._at_end = False  # the stage that ``begin_edges`` makes, after which its frames are in use again
        self._iterate: Array | None = None
        self._predicted: tuple[Array, Array] | None = None
        self._leaps = False
        self._uncorrected: Array | None = None
        self._squares: list[float] = []
        self.damped: Damped | None = None

    @property
    def points(self) -> Layout:
        """The layout of the rows, with the ghosts of the present stencils."""
        return self.discretisation.layout

    @property
    def x(self) -> Array:
        """Positions (n_local, 3) [m] of the state."""
        return self.state.x

    @property
    def v(self) -> Array:
        """Velocities (n_local, 3) [m/s] of the state."""
        return self.state.v

    def _least_stiffness(self) -> Array:
        """What Jacobians add to the diagonal of block rows of edges (n,) [N/m]: where their triangles have
        lost their area nothing else is left.
        """
        least = np.zeros((self.points.n_local, 3))
        for term in self.active.with_edges:
            least.reshape(-1)[term.edge_indices] = LEAST * term.edge_stiffness
        return least[self.points.n_vertices : self.points.n_owned].max(axis=1)

    def begin(self, time: float) -> None:
        """Take the present positions as reference of everything that starts to act by ``time`` [s]."""
        self.reference.until(time, self.x)

    def rest_at(self, time: float) -> None:
        """Let moving targets stand where they are at ``time`` [s], between two steps; collective."""
        self.t0 = self.t1 = time
        step = UpcomingStep(time, time, time, self.x, self.reference.at)
        self.active.freeze(step)
        self._follow(self.x)  # energies at the start of a run are those of all stencils
        for term in self.active.changing:
            term.initialise_pairs(self.x, self.active.frozen[term])

    # -- a step ------------------------------------------------------------------------------------

    def begin_step(self, t0: float, t1: float) -> None:
        """Freeze what stays fixed during the step from t0 to t1 [s]; collective."""
        self.t0, self.t1, self.dt = t0, t1, t1 - t0
        self.refused_way = self._may_begin = None
        self.new_iterate(None)
        after = self.integrator.stage_offset(self.dt)
        changed = self.prescribed.begin_step(t0, t1, self.x)
        ahead = self._expected() if self.discretisation.limits_motion else None
        stops = () if ahead is None else (after / self.dt, 1.0) if after < self.dt else (1.0,)
        self._follow(self.x, ahead, stops)
        self._freeze(t0 + after)
        if self.active.pushing:  # obstacles may have come near
            ahead = None if ahead is None else self._expected()  # with the ghosts that there are now
            self._follow(self.x, ahead, stops)
        # a step may begin where a state was written, a rounding beside the event
        if changed or any(abs(t0 - event) <= 1e-6 * self.dt for event in self._events):
            for follower in (self.integrator, *self.followers):
                follower.restart()
        asking = [each for each in (self.integrator, *self.followers) if each.needs_acceleration]
        acceleration = self._accelerations(t0 + after) if asking else self.history
        for follower in asking:
            follower.set_acceleration(acceleration)
        n = self.points.n_owned
        self.stage = stage = self.integrator.stage(self.x[:n], self.v[:n], self.dt)
        if self.watches_impacts:
            terms = self.active.limiting
            self._stored = sum(float(t.energies(self.x, self.active.frozen[t]).sum()) for t in terms)
        self.history = self.v[:n] if stage.v is None else stage.v
        self._set_history(stage, t0 + after)
        self.moving_energy_before = self.active.moving_energy(self.x)

    def _expected(self) -> Array:
        """How far (n_local, 3) [m] points would go in the step if they went on as they do."""
        ahead, n = self.dt * self.v, self.points.n_owned
        self.prescribed.overwrite(ahead[:n], self.prescribed.goal - self.x[:n].take(self.prescribed.indices))
        self.points.update_ghosts(ahead)
        return ahead

    def _accelerations(self, at: float) -> Array:
        """Of the free unknowns (n_owned, 3) [m/s²] at the start of the step, with its stage at ``at`` [s]."""
        v = self.v.copy()
        self.prescribed.overwrite_with_start_velocity(v[: self.points.n_owned])
        self.points.update_ghosts(v)
        x, turns = self._frozen_positions(at), bool(self.active.pushing)
        if turns:  # by the stage an obstacle may be where the sheet is yet
            self.active.turn_targets(UpcomingStep(self.t0, self.t1, self.t0, x, self.reference.at))
        total = self._total(self.x, v, np.zeros_like(self.history), np.empty_like(self.history))
        if turns:
            self.active.turn_targets(UpcomingStep(self.t0, self.t1, at, x, self.reference.at))
        force, mass = np.where(self.prescribed.free, -total, 0.0), self.mass[:, None]
        return np.divide(force, mass, out=np.zeros_like(force), where=mass > 0.0)

    def _freeze(self, at: float) -> None:
        """Geometry, targets and loads that stay as they are at time ``at`` [s], the stage's."""
        x = self._frozen_positions(at)
        self.active.freeze(UpcomingStep(self.t0, self.t1, at, x, self.reference.at))
        frozen, moves, self._frozen_before = self.active.frozen, self.integrator.dynamic, None
        if moves and any(frozen[term] is not self._frames.get(term) for term in self.active.with_edges):
            self.forget_forces()  # by frames that have followed, they are others
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
        """Positions (n_local, 3) whose geometry stays as it is during the step."""
        if not self.integrator.centred:
            return self.x
        x = self.x + (at - self.t0) * self.v
        if self.points.n_edges_global:  # unknowns of edges are never extrapolated
            edges = ~self._vertex_rows
            x[edges] = self.x[edges]
        return x

    @cached_property
    def _vertex_rows(self) -> NDArray[np.bool_]:
        """Which local rows (n_local,) are vertices; ghosts that contact adds are."""
        return self.points.are_vertices(self.points.global_number)

    def _set_history(self, stage: Stage, at: float) -> None:
        """x_h with its ghosts, and the velocities of the prescribed unknowns."""
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

    def out_of_balance(self) -> tuple[Array, float]:
        """Force (n_owned, 3) [N] on the free unknowns now, norm [N] of its largest part; collective."""
        total = self._total(self.x, self.v, np.zeros_like(self.history), np.empty_like(self.history))
        return np.where(self.prescribed.free, -total, 0.0), self.largest_force()

    def forces_now(self) -> Iterator[tuple[str, Array]]:
        """The parts of F at the start of the step, each (n_owned, 3) [N]; nothing is accelerated."""
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

    def velocity_of_staying(self) -> Array:
        """Velocities (n_owned, 3) [m/s] whose stage is where the step starts."""
        return ((self.x - self._xh) / self.stage.c)[: self.points.n_owned]

    def beginning(self) -> Array:
        """Velocities (n_owned, 3) [m/s] of staying, or going on where only that leads past what is near; what
        is prescribed goes where it shall.
        """
        if self._may_begin is not None and not self._at_end:
            return self._may_begin.copy()
        self.prescribe(v := self.velocity_of_staying())
        return v

    def stay(self) -> None:
        """Let the stage be where the step starts; collective."""
        self.evaluate_at(self.velocity_of_staying())

    def accept(self, v: Array) -> None:
        """Take v (n_owned, 3) as the velocity of the stage and go to the end of the step; collective."""
        n, given, free = self.points.n_owned, self.integrator.handles_at_stage, self.prescribed.free
        self.evaluate_at(v)  # what the step's forces are taken at afterwards
        before, rate_before = self.x[:n], self.v[:n]
        moved, rate = self.integrator.end(before, rate_before, v, self.dt)
        self.integrator.record_step(before, rate_before, free, self.dt)
        self.prescribed.overwrite(moved, self.prescribed.goal)
        if given:
            self.prescribed.overwrite_with_end_velocity(rate)
        self.state.set(moved, rate)
        if self.active.limiting and self.integrator.dynamic:
            from lyra_petsc.stepping import impacts  # of no use elsewhere

            if self.stage.offset < self.dt:  # what is met behind the stage has its energy from here on
                self._follow(self._xs, self.x - self._xs, (1.0,))
            if not self.discretisation.has_near_elements:
                self.integrator.surplus, self.damped = max(self.integrator.surplus, 0.0), None
                return
            if self.watches_impacts:
                left = self.integrator.surplus
                self.integrator.surplus = impacts.surplus(self, self._stored, before, left)
            self.damped = impacts.damp_impacts(self)
            for term in self.active.changing:
                if term.slips:
                    self.damped = impacts.make_up_friction(self, term, self.damped)

    def reopen(self, x_before: Array) -> None:
        """Let the step just accepted, from x_before (n_owned, 3), be asked again; collective."""
        if self._xh is self.x:
            self._xh = resized(x_before, self.points.n_owned, self.points.n_local)
            self.points.update_ghosts(self._xh)

    def begin_at_rest(self) -> float:
        """Let handles hold what they do at the start; norm [N] of the moments on free edges; collective."""
        self.prescribed.begin_step(self.t0, self.t0, self.x)
        moments = np.where(self.prescribed.free, self._internal(self.x), 0.0)[self.points.n_vertices :]
        return float(np.sqrt(self.points.global_sum(float(np.vdot(moments, moments)))[0]))

    # -- unknowns of edges at the end of a step ----------------------------------------------------

    def end_frames(self) -> None:
        """Let frames of edges follow to the end of a step that is one linear solve: so the forces there are
        those that the next one begins with.
        """
        edged, frozen = self.active.with_edges, self.active.frozen
        if edged and self.integrator.lagged_loads and self.integrator.dynamic:
            self.active.refreeze({term: term.frames_at_end(self.x, frozen[term]) for term in edged})
            self._frozen_before = frozen
            self.forget_forces()
            self._frames = {term: self.active.frozen[term] for term in edged}

    @property
    def frozen_in_step(self) -> Mapping[Term, Any]:
        """What terms had frozen in the step, before frames of edges followed to its end."""
        return self.active.frozen if self._frozen_before is None else self._frozen_before

    def turn_frames(self) -> bool:
        """Let the frames of edges that have turned far follow to where the equations were last evaluated;
        whether any did, and the vertices' forces are others; collective.
        """
        found: dict[Term, Any] = {}
        for term in () if self._at_end else self.active.with_edges:
            nearer = term.nearer(self._xs, self.active.frozen[term], self.prescribed.mask)
            found |= {} if nearer is None else {term: nearer}
        if not self.points.comm.allreduce(len(found), MPI.MAX):
            return False
        self.active.refreeze(found)
        self.forget_forces()
        return True

    def follow_triangles(self, v: Array, way: Array) -> bool:
        """Let unknowns of edges that go far on the way from v by ``way`` (n_owned, 3) [m/s] turn with their
        triangles; whether any does; collective.

        On the tangent at v the vertices go beside their circles, and directors far beyond.
        """
        if not self.active.with_edges or self.stage.c * self.farthest_turn(way) <= LARGEST_TURN:
            return False
        x, ahead = self.ahead(v, way)
        changed = 0
        for term in self.active.with_edges:
            changed += self._follow_in(way, *term.followed(x, ahead, self.active.frozen[term]))
        return bool(self.points.comm.allreduce(changed, MPI.MAX))

    def let_directors_follow(self, v: Array, way: Array, bent: Array) -> None:
        """Let all unknowns of edges go, on the way from v that vertices go by ``bent`` (n_owned, 3) [m/s], so
        that triangles are bent as on the tangent, by ``way``; collective.
        """
        along = self.ahead(v, bent)[1]
        x, ahead = self.ahead(v, way)
        for term in self.active.with_edges:
            self._follow_in(bent, *term.followed(x, ahead, self.active.frozen[term], along))

    def _follow_in(self, way: Array, places: Ints, values: Array) -> bool:
        """Put ways (m,) [m] of the free unknowns at ``places`` (m,) into way (n_owned, 3) [m/s]; if any."""
        own = places < way.size
        own[own] = self.prescribed.free.ravel()[places[own]]
        way.reshape(-1)[places[own]] = values[own] / self.stage.c
        return bool(own.any())

    @property
    def edges_lag(self) -> bool:
        """Whether unknowns of edges are in equilibrium elsewhere than at the end of the step."""
        return bool(self.points.n_edges_global) and self.integrator.dynamic and self.stage.offset < self.dt

    def begin_edges(self, x_before: Array) -> None:
        """Seek the edges' unknowns at the end of the step just accepted, from x_before (n_owned, 3);
        collective.

        A stage of backward Euler in which the vertices go where they are now. Before the first step it begins
        there, too, after `begin_at_rest`.
        """
        n, dt = self.points.n_owned, self.dt or 1.0
        self._kept = self.stage, self.history, self._xh, self.stage_velocity.copy(), self.active.frozen
        self.new_iterate(None)
        self.objective.forget()
        self.stage = Stage(1.0 / dt, dt, dt)
        self.history = np.zeros((n, 3))
        self._xh = resized(x_before, n, self.points.n_local)
        self.points.update_ghosts(self._xh)
        self.active.turn_targets(UpcomingStep(self.t0, self.t1, self.t1, self.x, self.reference.at))
        self.prescribed.hold_vertices(self.x[:n])
        self._at_end = True
        self.prescribed.set_velocity_to_goal(self._xh[:n], dt)

    def end_edges(self, v: Array | None) -> None:
        """Take what their rates v (n_owned, 3) lead to, if any, and go back to the stage; collective."""
        n = self.points.n_owned
        moved = None if v is None else self._xh[:n] + self.stage.c * v
        self.stage, self.history, self._xh, stage_velocity, self.active.frozen = self._kept
        self.prescribed.release_vertices()
        self._at_end = False
        self.objective.forget()
        self.new_iterate(None)
        if moved is not None:
            rows = slice(self.points.n_vertices, n)
            self.x[rows] = moved[rows]
            self.state.update_ghosts()
        self.evaluate_at(stage_velocity)

    # -- terms -------------------------------------------------------------------------------------

    def written_velocity(self) -> Array:
        """Velocities (n_owned, 3) to write out: those of prescribed unknowns are ẋ*(t)."""
        self.prescribed.overwrite_with_end_velocity(velocity := self.v[: self.points.n_owned].copy())
        return velocity

    def pull_of(self, terms: Sequence[Elastic], x: Array) -> Array:
        """Gradient (n_owned, 3) [N] of the energy of ``terms``, all without targets, at x (n_local, 3)."""
        return self._sum(terms, x) if self.active.moving else self._internal(x)

    def pushed(self) -> float:
        """Work [J] in the step of what pushes this rank's elements, by its forces at the stage."""
        at = self.t0 + self.stage.offset if self.integrator.dynamic else self.t1
        work = sum(term.work(self._xs, at, self.t0, self.t1) for term in self.active.pushing)
        return work + (self.damped.work if self.damped else 0.0)

    def turn_targets_to_end(self) -> float:
        """Let moving targets stand where the step ends; energy [J] that this gives this rank's terms."""
        if self.stage.offset == self.dt or not (self.active.moving or self.active.constraints):
            return 0.0
        before = self.active.moving_energy(self.x)
        self.active.turn_targets(UpcomingStep(self.t0, self.t1, self.t1, self.x, self.reference.at))
        return self.active.moving_energy(self.x) - before

    @property
    def watches_impacts(self) -> bool:
        """Whether what contact adds to the energy is known and taken back; not so where obstacles move."""
        return self.integrator.exact_work and bool(self.active.limiting) and not self.active.pushing

    @property
    def limits_steps(self) -> bool:
        """Whether `largest_step` may be less than 1: also in statics with directors, which would else go to
        quite another equilibrium.
        """
        return bool(self.active.limiting) or (bool(self.active.with_edges) and not self.integrator.dynamic)

    def largest_step(self, v: Array, way: Array) -> float:
        """Largest fraction of the way from v by ``way`` (n_owned, 3) [m/s] that terms allow; collective."""
        turn = 0.0 if self.integrator.dynamic else self.farthest_turn(way * self.stage.c)
        most, gone = (FARTHEST_TURN / turn if turn > FARTHEST_TURN else 1.0), 0.0
        for _ in range(SEARCHES):
            whole = gone == 0.0 and most == 1.0  # mostly
            x, ahead, seen = self._look(*((v, way) if whole else (v + gone * way, (most - gone) * way)))
            fraction = seen
            if self.discretisation.has_near_elements:
                frozen = self.active.frozen
                parts = [term.largest_step(x, ahead, frozen[term]) for term in self.active.limiting]
                fraction = self._least_of(min([fraction, *parts]))
            if fraction == 1.0:
                return most
            gone += fraction * (most - gone)
            if fraction < seen:
                break
        return gone

    def _look(self, v: Array, way: Array, least: float = FEW) -> tuple[Array, Array, float]:
        """What `ahead` gives for the way from v by ``way`` (n_owned, 3) [m/s], and the part of it on which
        stencils are known; where that is less than ``least``, they are searched all along it; collective.
        """
        x, ahead = self.ahead(v, way)
        seen = self.discretisation.searched_fraction(x, ahead)
        if seen >= least:
            return x, ahead, seen
        self._follow(x, ahead)
        x, ahead = self.ahead(v, way)
        return x, ahead, self.discretisation.searched_fraction(x, ahead)

    def pushed_apart(self, v: Array, way: Array) -> Array | None:
        """The way from v by ``way`` (n_owned, 3) [m/s], but that what would then be too near goes aside; None
        if nothing is; collective.

        On tangents sheets that turn come nearer to what they touch, or pass it, by the square of their turn.
        (A second-order correction: Nocedal & Wright, Numerical Optimization, 2nd ed., sec. 15.6.)
        """
        if not self.active.limiting:
            return None
        x, ahead, _ = self._look(v, way, 1.0)
        if not self.discretisation.has_near_elements:
            return None
        n, frozen, pushed = len(way), self.active.frozen, False
        targets = {term: term.target_distances(x, ahead, frozen[term]) for term in self.active.limiting}
        for _ in range(PUSHES):
            out, count = np.zeros_like(x), np.zeros((len(x), 1))
            found = [
                term.add_corrections(x, ahead, frozen[term], target, out, count)
                for term, target in targets.items()
            ]
            if not self.points.comm.allreduce(any(found), MPI.LOR):
                break
            aside = np.divide(out[:n], count[:n], out=np.zeros((n, 3)), where=count[:n] > 0.0)
            ahead[:n] += np.where(self.prescribed.free, aside, 0.0)
            self.points.update_ghosts(ahead)
            pushed = True
        return ahead[:n] / self.stage.c if pushed else None

    def springs(self, v: Array, way: Array) -> dict[Elastic, Springs]:
        """What may touch on the way from v by ``way`` (n_owned, 3) [m/s], until `release`; collective."""
        x, ahead, _ = self._look(v, way, 1.0)
        frozen = self.active.frozen
        found = {term: term.springs(x, ahead, frozen[term]) for term in self.active.limiting}
        return {term: springs for term, springs in found.items() if springs is not None}

    def add_springs(
        self, springs: Mapping[Elastic, Springs], stiffness: Mapping[Elastic, Array], values: Array
    ) -> None:
        """Add springs of this stiffness [N/m] to the Jacobian's block rows (n_blocks, 3, 3)."""
        rows, beside = self.discretisation.rows, self.prescribed.beside
        for term, each in springs.items():
            reach = self.stage.c
            each.add_stiffness(reach * stiffness[term], rows.pattern.offsets[term.name], values)
        if len(beside.changing):
            rows.constrain(values, self.prescribed.mask, beside)

    def release(self, length: Mapping[Elastic, Array]) -> None:
        """Let `springs` go, of a ``length`` [m] where the step leads, without one if it is another."""
        for term in self.active.limiting:
            term.release_springs(length.get(term))

    def farthest_turn(self, way: Array) -> float:
        """Largest angle [rad] by which directors turn on a way (n_owned, 3); collective."""
        turn = max((term.largest_turn(way) for term in self.active.with_edges), default=0.0)
        return float(self.points.comm.allreduce(turn, MPI.MAX))

    def _least_of(self, number: float) -> float:
        """The least of all ranks; collective."""
        return -self.points.global_max(-number)[0]

    def ahead(self, v: Array, way: Array) -> tuple[Array, Array]:
        """Positions (n_local, 3) at velocities v (n_owned, 3), and how far ``way`` leads from there [m]."""
        x = self.evaluate_at(v)[0]
        ahead = resized(way * self.stage.c, len(way), self.points.n_local)
        self.points.update_ghosts(ahead)
        return x, ahead

    def may_move(self) -> bool:
        """Whether the sheet can go where the step's solve may start, while obstacles go theirs; collective.

        What is prescribed goes where it shall; all else stays, or goes on as it did; at last also but for
        what obstacles take along.
        """
        here = self.velocity_of_staying()
        goes = self.prescribed.velocity != here.take(self.prescribed.indices)
        if not any(self.points.global_max(bool(self.active.pushing) or bool(goes.any()))):
            return True
        rests, refused = self.integrator.starts_at_rest, None
        ways = [here] if rests else [here, self.v[: len(here)]]
        tried = [(v, False) for v in ways]
        if self.active.pushing and not rests:
            tried += [(v, True) for v in ways]
        for v, carried in tried:
            there = here + self._carried(here, v - here) if carried else v.copy()
            self.prescribe(there)
            if self._may_go(here, there - here):
                self.refused_way, self._may_begin = None, there
                return True
            refused = refused or self.refused_way  # of staying: then what moves is in the way
        self.refused_way = refused
        return False

    def _carried(self, v: Array, way: Array) -> Array:
        """Ways (n_owned, 3) [m/s] from v like ``way``, but that obstacles take along what is in their way;
        collective.
        """
        n = len(way)
        for _ in range(SEARCHES):
            x, ahead = self.ahead(v, way)
            taken = ahead
            for term in self.active.pushing:
                taken = term.moved_with_obstacles(x, taken, self.active.frozen[term])
            change = taken[:n] != ahead[:n]
            if not self.points.comm.allreduce(bool(change.any()), MPI.LOR):
                break
            way = np.where(change, taken[:n] / self.stage.c, way)
        return way

    def _may_go(self, v: Array, way: Array, *, after: bool = False) -> bool:
        """Whether the sheet can go from velocities v by ``way`` (n_owned, 3) while obstacles go theirs.

        To the stage, or ``after`` it to the end of the step.
        """
        gone, begin = 0.0, float(after)
        for _ in range(SEARCHES):
            x, ahead, seen = self._look(v + gone * way, (1.0 - gone) * way)
            ahead *= seen
            part = StepInterval(begin + gone, begin + (1.0 if seen == 1.0 else gone + seen * (1.0 - gone)))
            free = [
                term.is_collision_free(x, ahead, self.active.frozen[term], part)
                for term in self.active.limiting
            ]
            if not self._least_of(float(all(free))):
                break
            if seen == 1.0:
                return True
            gone = part.end - begin
        self.refused_way = RefusedDisplacement(x.copy(), ahead, part)
        return False

    def may_end(self, v: Array) -> bool:
        """Whether the sheet can go from the stage with velocities v (n_owned, 3) to the end of the step;
        collective.
        """
        if self.stage.offset == self.dt and self.integrator.iterates:
            return True
        n = self.points.n_owned
        end = self.integrator.end(self.x[:n], self.v[:n], v, self.dt)[0]
        # one linear solve has found it, or Newton's method has looked at the way to the stage
        x = self.evaluate_at(v)[0] if self.integrator.iterates else self.x
        way = end - x[:n]
        if not self.discretisation.has_near_elements and self.discretisation.searched_fraction(x, way) == 1.0:
            return True
        v = v if self.integrator.iterates else self.velocity_of_staying()
        return self._may_go(v, way / self.stage.c, after=True)

    # -- what Newton asks for ----------------------------------------------------------------------

    def _follow(self, x: Array, ahead: Array | None = None, stops: Sequence[float] = ()) -> None:
        """Let stencils be those at positions x (n_local, 3), and make room for their ghosts."""
        if not self.discretisation.stencils_change or not self.discretisation.update_stencils(
            x, ahead, stops
        ):
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
        self._follow(self._xs)
        return self._xs, self._vs

    @property
    def evaluated(self) -> tuple[Array, Array]:
        """What ``evaluate_at`` last returned."""
        return self._xs, self._vs

    def forces_at_stage(self) -> Iterator[tuple[str, Array]]:
        """The parts of F at the stage of the step just accepted, each (n_owned, 3) [N]."""
        rate = self.stage.sigma * (self._vs[: self.points.n_owned] - self.history)
        return self._parts(self._xs, self._vs, rate)

    def _parts(self, x: Array, vs: Array, vdot: Array) -> Iterator[tuple[str, Array]]:
        """One part of F after the other: there is no room for all of them. What the internal forces are
        computed from is remembered, so that these come last.
        """
        self._squares = []
        yield self._counted("inertia", self.mass[:, None] * vdot)
        del vdot
        if self.active.constraints:
            yield self._counted("springs", self._sum(self.active.constraints, x))
        yield self._counted("loads", -self.applied.force_at(x))
        if self.damping.active:
            yield self._counted("damping", self.damping.product(vs))
            if self.integrator.lagged_loads:  # nobody asks again
                self.damping.product.forget()
        if self.active.viscous and not self.integrator.lagged_loads:
            yield self._counted("wind", self._sum(self.active.viscous, vs))
        yield self._counted("internal", self._internal(x))

    def _counted(self, name: str, part: Array) -> tuple[str, Array]:
        """A part of F, whose square goes into `largest_force`."""
        self._squares.append(squared_norm_without(part.reshape(-1), self.prescribed.not_counted))
        return name, part

    def _sum(self, terms: Sequence[Elastic | Viscous], at: Array) -> Array:
        return self.active.gradient(terms, at, self.points)

    def _total(self, x: Array, vs: Array, vdot: Array, out: Array) -> Array:
        """F (n_owned, 3) [N] into ``out``."""
        out[:] = 0.0
        for _, part in self._parts(x, vs, vdot):
            out += part
            del part
        return out

    def residual(self, v: Array, vdot: Array, out: Array) -> None:
        """F (n_owned, 3) [N]; in prescribed unknowns σ m (v − v*); collective."""
        self._total(*self.evaluate_at(v), vdot, out)
        at, velocity = self.prescribed.indices, self.prescribed.velocity
        self.prescribed.overwrite(out, self.stage.sigma * self.mass[at // 3] * (v.take(at) - velocity))

    def largest_force(self) -> float:
        """Norm [N] of the largest part of F last evaluated, over the unknowns that count; collective."""
        return float(np.sqrt(self.points.global_sum(*self._squares).max(initial=0.0)))

    def block_summary(self) -> list[str]:
        """Lines on the elements with changing stencils and the blocks they add to the matrix, none without;
        collective.
        """
        near, frozen = self.active.changing, self.active.frozen
        if not near:
            return []
        acting = [np.count_nonzero(t.active_elements(self._xs, frozen[t])[: t.n_owned]) for t in near]
        patterns = self.discretisation.fixed.pattern, self.discretisation.rows.pattern
        fixed, every, *numbers = self.points.global_sum(
            *(pattern.n_couplings for pattern in patterns), *acting, *(t.n_owned for t in near)
        ).astype(np.int64)
        pairs = [
            f"{t.name} {acts} of {known}"
            for t, acts, known in zip(near, numbers, numbers[len(near) :], strict=False)
        ]
        return [f"blocks: {fixed} of the mesh, {every - fixed} of pairs that act ({', '.join(pairs)})"]

    def update_pattern(self) -> bool:
        """Let block rows have all blocks of the Jacobian where it was last evaluated; whether they are
        others; collective.
        """
        x, frozen = self._xs, self.active.frozen
        if not self.discretisation.has_near_elements:
            self.touches = False
            return self.discretisation.update_pattern({})
        acting = {term: term.active_elements(x, frozen.get(term)) for term in self.active.changing}
        if acting:
            number = sum(int(np.count_nonzero(acts)) for acts in acting.values())
            self.touches = any(self.points.global_max(number))
        return self.discretisation.update_pattern(acting)

    @property
    def slips(self) -> bool:
        """Whether there is anything of which one linear solve cannot tell whether it sticks or slides;
        collective.
        """
        number = sum(term.n_friction_pairs for term in self.active.changing)
        return self.discretisation.has_near_elements and any(self.points.global_max(number))

    @property
    def may_impact(self) -> bool:
        """Whether anything is near anything, and vertices go a part of its gap in the step; collective."""
        limiting = self.active.limiting
        if not (limiting and self.discretisation.has_near_elements):
            return False
        way = self.stage.c * np.abs(self._vs[: self.points.n_vertices]).max(initial=0.0)
        return self.points.global_max(float(way))[0] > IMPACT * min(term.skin for term in limiting)

    def collides(self, far: float) -> bool:
        """Whether anything may meet in the step by coming nearer by more than ``far`` [m]; collective."""
        limiting = self.active.limiting
        if not self.discretisation.has_near_elements or not self.integrator.dynamic or self._at_end:
            return False
        x, ahead, frozen = self.x, self._expected(), self.active.frozen
        return any(self.points.global_max(any(t.may_collide(x, ahead, frozen[t], far) for t in limiting)))

    def new_iterate(self, v: Array | None) -> None:
        """Let Jacobians be those of Newton's iterate v, linearised from the one before; None: of the first.

        Their stress is then as independent as in a mixed method, and stiff sheets converge as soft ones do.
        """
        before, self._predicted = self._iterate, None
        self._iterate = None if v is None else self.evaluate_at(v)[0].copy()
        if before is not None and self._iterate is not None:
            there = self._iterate if self._uncorrected is None else self._uncorrected
            self._predicted = before, before if self._leaps else there
        self._uncorrected = None
        self._leaps = False

    def linearise_to(self, v: Array) -> None:
        """Let the next Jacobian be linearised to velocities v (n_owned, 3), whatever corrected them."""
        self._uncorrected = self.evaluate_at(v)[0].copy()

    def leap(self) -> None:
        """Newton's method starts far from the state, whose stress the first Jacobian takes."""
        self._iterate, self._leaps = self.x.copy(), True

    def forget_forces(self) -> None:
        """Energies and forces remembered are no longer those at hand."""
        if isinstance(self._internal, Remembered):
            self._internal.forget()
        self.objective.forget()

    def forget_directors(self) -> None:
        """Keep none while a linear system is solved, which needs the room: next they are elsewhere."""
        for term in self.active.with_edges:
            term.forget()

    def forget_rows(self) -> None:
        """Work no longer with the rows that ``jacobian`` was given, which their owner may free now."""
        self.damping.release_values()

    def jacobian(self, v: Array, blend: float, values: Array) -> None:
        """Let block rows (n_blocks, 3, 3) be σ M + c K + D + ∇∇P, prescribed unknowns decoupled.

        ``blend`` 0 takes the exact elastic Hessian, 1 the regularised one, between them a mixture.
        """
        x, vs = self.evaluate_at(v)
        rows, predicted = self.discretisation.rows, self._predicted
        if predicted is not None and len(predicted[0]) != len(x):
            predicted = None  # of an iterate with other ghosts
        lagged = self.integrator.lagged_loads
        for remembered in self._asked_once:  # the linear solve needs the room
            remembered.forget()
        reach = self.stage.c
        inertia = self.stage.sigma * self.mass
        if self.active.with_edges:
            inertia[self.points.n_vertices :] += reach * self._least
        beside = self.prescribed.beside
        changing = beside.changing
        if blend < 1.0 or not self.damping.assemble_with_stiffness(x, reach, inertia, values, changing):
            self.damping.assemble(values, inertia)
            for term in self.active.elastic:
                rows.add_stiffness(term, x, self.active.frozen[term], blend, reach, values, predicted)
        if not lagged:
            for wind in self.active.viscous:
                wind.add_hessian(vs, self.active.frozen[wind], rows.pattern.offsets, values)
        if self.applied.following is not None and blend < 1.0:
            self.applied.following.add_hessian((1.0 - blend) * reach, rows.pattern, values)
        if len(changing):
            rows.constrain(values, self.prescribed.mask, beside)
