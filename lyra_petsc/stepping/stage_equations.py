"""The state (x_n, v_n) of a motion, the step that starts from it, and the equations of its stage (`forces`).

This module works on arrays only, without PETSc. Methods that return sums over ranks are collective.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.mesh.points import Layout
from lyra_petsc.stepping.active_terms import ActiveTerms
from lyra_petsc.stepping.applied_loads import LoadCase, StepLoads
from lyra_petsc.stepping.damping import Damping
from lyra_petsc.stepping.directors import Directors
from lyra_petsc.stepping.forces import StageForces
from lyra_petsc.stepping.integrators.in_use import IntegratorsInUse
from lyra_petsc.stepping.integrators.integrator import Integrator, Stage
from lyra_petsc.stepping.predicted_stress import PredictedStress
from lyra_petsc.stepping.prescribed import Prescriptions
from lyra_petsc.stepping.reference_positions import ReferencePositions
from lyra_petsc.stepping.start_acceleration import StartAcceleration
from lyra_petsc.stepping.state import State
from lyra_petsc.stepping.time_step import Evaluation, TimeStep
from lyra_petsc.terms.handles.prescribed_handles import ExactHandles
from lyra_petsc.terms.protocols import FollowsHandles
from lyra_petsc.terms.term import Elastic, Term, UpcomingStep

if TYPE_CHECKING:
    from lyra_petsc.contact.impacts import ContactImpulses, StepEnd
    from lyra_petsc.contact.scene_contact import SceneContact


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
    step : TimeStep
        The present one, or the last.
    evaluated : Evaluation
        The last one; after a step that of its stage.
    forces : StageForces
    reference : ReferencePositions
    prescriptions : Prescriptions
    start_acceleration : StartAcceleration
    active : ActiveTerms
    damping : Damping
    load_case : LoadCase
    directors : Directors
    predicted_stress : PredictedStress
        That of the Jacobian.
    integrators : IntegratorsInUse
    nears_limit : bool
        Whether a term that limits steps acts at the positions of the state; contact is apart.
    has_active_pairs : bool
        Whether any pair of a term with changing stencils acted when the block rows were last renewed.
    """

    has_active_pairs = nears_limit = False
    past_velocity: Array | None = None
    """(n_owned, 3) before the last step, if there is contact."""

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
        self.discretisation, self.mass = discretisation, mass
        moves = contact is not None and contact.obstacles_move
        self.active = active = ActiveTerms(terms, contact.barrier if contact and moves else None)
        self.contact = contact
        limited = contact is not None or bool(active.limiting)
        self.integrators = IntegratorsInUse(integrator, limited=limited)
        discretisation.when_ghosts_change(self._follow_ghosts)
        self.held = held
        following = [term.reference_rows for term in terms if isinstance(term, FollowsHandles)]
        rows = np.concatenate([held.reference_rows, *following])
        self.reference = ReferencePositions(self.points, rows, starts)
        self.prescriptions = Prescriptions(discretisation, held, self.reference)
        self.load_case = LoadCase()
        once = integrator.lagged_loads
        self.damping = Damping(
            discretisation, active.elastic, dynamic=integrator.dynamic, single_assembly=once
        )
        self.directors = Directors(active.with_edges, self.points)
        edges = self.directors.min_stiffness
        self.forces = StageForces(discretisation, mass, active, self.damping, edges)
        self.state = State(discretisation)
        nothing = StepLoads(np.zeros((len(mass), 3)))
        none, frozen = self.prescriptions.none, dict.fromkeys(terms)
        rest = Stage(1.0, 1.0, 1.0)
        zero = self.v[: len(mass)]
        self.step = TimeStep(0.0, 0.0, rest, self.x, self.x, zero, none, nothing, frozen, lagged=once)
        self.evaluated = self.at(self.x, self.v)
        self.start_acceleration = StartAcceleration(events)
        self.predicted_stress = PredictedStress()

    @property
    def points(self) -> Layout:
        """Layout of the local rows, with the ghosts that the present stencils need."""
        return self.discretisation.layout

    @property
    def integrator(self) -> Integrator:
        """That of the step."""
        return self.integrators.present

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

    def take_loads(self, **changes: Any) -> None:
        """Change entries of the load case of the next step."""
        self.load_case = replace(self.load_case, **changes)

    def targets_at(self, time: float, x: Array | None = None) -> UpcomingStep:
        """The step as terms receive it to freeze their data at a time [s] of it."""
        step, x = self.step, self.x if x is None else x
        return UpcomingStep(step.start, step.end, time, x, self.reference.at)

    def change(self, **changes: Any) -> None:
        """Go on with another step, with these entries changed: what has been evaluated holds no longer."""
        self.step = replace(self.step, **changes)

    def return_to(self, step: TimeStep) -> None:
        """Go on with a step that another has interrupted."""
        self.step = step

    def refreeze(self, changed: Mapping[Any, Any]) -> None:
        """Go on with other frozen data of some terms."""
        self.change(frozen=self.active.refreeze(self.step.frozen, changed))

    def refreeze_end(self, changed: Mapping[Any, Any]) -> None:
        """End the step just accepted with other frozen data of some terms."""
        self.refreeze(changed)
        self.evaluated = self.at(self.evaluated.x, self.evaluated.v)
        if self.state.evaluation is not None:
            self.state.evaluation = self.evaluated

    def hold_targets(self, time: float) -> None:
        """Put moving targets at their positions at ``time`` [s], between two steps; collective."""
        self.change(start=time, end=time)
        self.change(frozen=self.active.freeze(self.targets_at(time)))
        self.update_stencils(self.x)  # energies at the start of a run need all stencils
        if self.contact is not None:
            self.contact.initialise(self.x, self.step.frozen)
        self.nears_limit = self.active.limits_act(self.x, self.step.frozen, self.points)

    # -- a step ------------------------------------------------------------------------------------

    def begin_step(self, t0: float, t1: float) -> None:
        """Set up the equations of the step from t0 to t1 [s], and freeze its data; collective."""
        self.predicted_stress.forget()
        at = t0 + self.integrator.stage_offset(t1 - t0)
        self.change(start=t0, end=t1, prescribed=self.prescriptions.of_step(t0, t1, self.x))
        if self.contact is not None:
            self.contact.begin_step()
            self.contact.update(self.x, self.expected_displacement(), self.expected_displacement)
        self._freeze(at)
        if self.contact is not None and self.contact.obstacles_move:  # they may have come near
            self.contact.update(self.x, self.expected_displacement(), self.expected_displacement)
        self.start_acceleration.begin_step(self, at)
        self._set_stage(at)

    def expected_displacement(self, steps: int = 1) -> Array:
        """Displacements (n_local, 3) [m] of the step at constant velocities, of handles exactly.

        Those of several ``steps`` are with the accelerations of the last step.
        """
        held, n = self.step.prescribed, len(self.mass)
        displacement = steps * self.step.dt * self.v
        if steps > 1 and self.past_velocity is not None:
            displacement[:n] += 0.5 * steps**2 * self.step.dt * (self.v[:n] - self.past_velocity)
        held.overwrite(displacement[:n], float(steps) * (held.goal - self.x[:n].take(held.indices)))
        self.points.update_ghosts(displacement)
        return displacement

    def _freeze(self, at: float) -> None:
        """Freeze geometry, targets and loads at the time ``at`` [s] of the stage."""
        x, lagged = self.frozen_positions(at), self.integrator.lagged_loads
        frozen = self.active.freeze(self.targets_at(at, x))
        if self.directors.frames_differ(frozen) and self.integrator.dynamic:
            self.state.evaluation = None
        viscous = self.active.viscous if lagged else []
        wind = self.forces.sum(viscous, self.v, frozen) if viscous else None
        times = self.step.start, self.step.end
        self.change(
            frozen=frozen,
            loads=self.load_case.loads(self.active.loads, *times, x, len(self.mass), wind),
            x=self.x,
            size=float(np.abs(self.x).max(initial=0.0)),
            linear=not self.integrator.iterates,
            lagged=lagged,
        )
        if self.damping.active:
            self.damping.freeze(x, frozen)

    def frozen_positions(self, at: float) -> Array:
        """Positions (n_local, 3) [m] whose geometry is frozen during the step."""
        if not self.integrator.centred:
            return self.x
        x = self.x + (at - self.step.start) * self.v
        if self.points.n_edges_global:  # unknowns of edges are never extrapolated
            edges = ~self.points.are_vertices(self.points.global_number)
            x[edges] = self.x[edges]
        return x

    def _set_stage(self, at: float) -> None:
        """Set the stage at the time ``at`` [s], its histories, and the velocities of prescribed unknowns."""
        step, n, held = self.step, len(self.mass), self.step.prescribed
        stage = self.integrator.stage(self.x[:n], self.v[:n], step.dt)
        x_h = self.x if stage.x is None else self.points.extended(stage.x)
        if self.held and self.integrator.handles_at_stage:
            span, x_h = (step.start, step.end), x_h.copy()
            held, fitting = self.prescriptions.at_stage(held, span, at, self.x, stage.c)
            held.overwrite(x_h[:n], fitting)
            self.points.update_ghosts(x_h)
        else:
            held = held.reaching(x_h[:n], stage.c)
        self.change(
            stage=stage,
            x_h=x_h,
            v_h=self.v[:n] if stage.v is None else stage.v,
            prescribed=held,
            moving_energy=self.active.moving_energy(self.x, step.frozen),
        )

    def prescribe(self, v: Array) -> None:
        """Overwrite the prescribed unknowns of v (n_owned, 3) by their velocities at the stage."""
        self.step.prescribed.overwrite(v, self.step.prescribed.velocity)

    def stationary_velocity(self) -> Array:
        """Velocities (n_owned, 3) [m/s] with which the stage is at the positions where the step starts."""
        return ((self.x - self.step.x_h) / self.step.stage.c)[: len(self.mass)]

    def accept(self, solution: Evaluation) -> None:
        """Set the state at the end of the step from the stage that solves it; collective."""
        n, step, held = len(self.mass), self.step, self.step.prescribed
        self.evaluated, v = solution, solution.v[:n]
        before, rate_before = self.x[:n], self.v[:n]
        moved, rate = self.integrator.end(before, rate_before, v, step.dt)
        self.integrators.record_step(before, rate_before, held.free, step.dt)
        held.overwrite(moved, held.goal)
        if self.integrator.handles_at_stage:
            self._set_end_rates(rate)
        self.state.set(moved, rate)
        if step.linear and not self.active.moving:
            # the stage is at the end, and the next step is linearised there
            self.evaluated = self.state.evaluation = self.at(self.x, solution.v)
        if self.integrator.dynamic:
            self.nears_limit = self.active.limits_act(self.x, step.frozen, self.points)
        if not self.integrator.dynamic or self.contact is None:
            return
        if not step.ends_at_stage:  # pairs that come near between the stage and the end
            self.update_stencils(self.evaluated.x, self.x - self.evaluated.x)
        self.past_velocity = rate_before
        end = self.step_end(self.v)
        impulses = self.contact.finish(end, step.frozen, damps=self.integrators.suits_contact)
        if impulses is not None:
            self.state.set(self.x[:n], self.v[:n] + impulses.change)
            self.integrators.in_contact.shift_past_velocities(impulses.change)

    def _set_end_rates(self, velocity: Array) -> None:
        """Overwrite prescribed unknowns of ``velocity`` (n_owned, 3) by those of handles at the end."""
        step = self.step
        if self.held and step.end > step.start:
            rates = self.prescriptions.rates(step.prescribed, step.start, step.end, step.end)
            step.prescribed.overwrite(velocity, rates)

    def output_velocity(self) -> Array:
        """Velocities (n_owned, 3) [m/s] for output: those of prescribed unknowns are ẋ*(t)."""
        self._set_end_rates(velocity := self.v[: len(self.mass)].copy())
        return velocity

    # -- evaluations -------------------------------------------------------------------------------

    def at(self, x: Array, v: Array, known: Array | None = None) -> Evaluation:
        """An evaluation of the present step at positions and velocities x, v (n_local, 3)."""
        return Evaluation(self.step, x, v, self.forces, known)

    def evaluate(self, v: Array) -> Evaluation:
        """The stage at velocities v (n_owned, 3); collective."""
        rates = self.points.extended(v)
        return self.revisit(self.at(self.step.stage.c * rates + self.step.x_h, rates))

    def linearised(self, v: Array) -> Evaluation:
        """The stage at which F and its Jacobian are evaluated for velocities v (n_owned, 3); collective.

        One linear solve takes them where the step starts, also if handles move: elements at a handle would be
        stretched by its whole motion.
        """
        if not self.step.linear:
            return self.evaluate(v)
        x_h, known = self.step.x_h, self.state.evaluation
        self.state.evaluation = None
        return self.revisit(self.at(x_h, np.zeros_like(x_h), known.internal if known else None))

    def revisit(self, evaluation: Evaluation) -> Evaluation:
        """An evaluation of the present step again, with the pairs that are near there; collective."""
        self.evaluated = evaluation
        self.update_stencils(evaluation.x)
        return self.evaluated

    def evaluate_at_start(self) -> None:
        """Evaluate the stage at the positions where the step starts; collective."""
        self.evaluate(self.stationary_velocity())

    def residual_at(self, v: Array) -> Array:
        """F (n_owned, 3) [N] at velocities v (n_owned, 3); collective."""
        self.forces.residual(v, self.linearised(v), out := np.empty_like(v))
        return out

    def out_of_balance(self, v: Array | None = None) -> Array:
        """Force (n_owned, 3) [N] on the free unknowns, with the state's velocities or v (n_local, 3)."""
        at = self.at(self.x, self.v if v is None else v)
        total = self.forces.total(at, np.zeros((len(self.mass), 3)), np.empty((len(self.mass), 3)))
        return np.where(self.step.prescribed.free, -total, 0.0)

    def forces_now(self) -> Iterator[tuple[str, Array]]:
        """The parts of F at the start of the step without inertia, each (n_owned, 3) [N]."""
        return self.forces.parts(self.at(self.x, self.v), np.zeros((len(self.mass), 3)))

    def forces_at_stage(self) -> Iterator[tuple[str, Array]]:
        """The parts of F at the stage of the step just accepted, each (n_owned, 3) [N]."""
        step, n, held = self.step, len(self.mass), self.step.prescribed
        rate = step.stage.sigma * (self.evaluated.v[:n] - step.v_h)
        if not step.ends_at_stage:  # handles do not have the integrator's accelerations
            held.overwrite(rate, (self.v[:n] - step.v_h).take(held.indices) / step.dt)
        return self.forces.parts(self.evaluated, rate)

    @property
    def stage_velocity(self) -> Array:
        """Velocities (n_owned, 3) [m/s] of the stage of the step just accepted."""
        return self.evaluated.v[: len(self.mass)]

    def gradient_of(self, terms: Sequence[Elastic], x: Array) -> Array:
        """Gradient (n_owned, 3) [N] at x (n_local, 3) of the energy of ``terms``."""
        return self.forces.sum(terms, x, self.step.frozen)

    def displacement(self, v: Array, increment: Array) -> tuple[Array, Array]:
        """Stage positions at velocities v (n_owned, 3), and displacements from there, both (n_local, 3) [m].

        ``increment`` (n_owned, 3) [m/s] is added to the velocities; collective.
        """
        return self.evaluate(v).x, self.points.extended(increment * self.step.stage.c)

    # -- contact -------------------------------------------------------------------------------------

    def step_end(self, v: Array) -> StepEnd:
        """The step's end with velocities v (n_local, 3), for contact."""
        from lyra_petsc.contact.impacts import StepEnd

        step, held, order = self.step, self.step.prescribed, self.integrator.order
        times = step.start, step.end
        return StepEnd(self.points, self.mass, held.free, held.indices, self.x, v, *times, order)

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

    def update_stencils(self, x: Array, displacement: Array | None = None) -> None:
        """Update the near pairs to positions x (n_local, 3), or to all along a displacement, and all arrays
        to their ghosts; collective.
        """
        if self.contact is not None:
            self.contact.update(x, displacement)

    def _follow_ghosts(self) -> None:
        """Resize all arrays to the layout's present ghosts; collective."""
        self.state.resize()
        extended = self.points.extended
        held = self.prescriptions.resized(self.step.prescribed)
        self.change(x=extended(self.step.x), x_h=extended(self.step.x_h), prescribed=held)
        now = self.evaluated
        self.evaluated = self.at(extended(now.x), extended(now.v))

    def update_pattern(self) -> bool:
        """Update the pattern of the block rows to the pairs that act at the positions last evaluated.

        Returns whether the pattern changed; collective.
        """
        frozen = self.step.frozen
        acting = self.contact.acting(self.evaluated.x, frozen) if self.contact and self.near else {}
        number = sum(int(np.count_nonzero(mask)) for mask in acting.values())
        self.has_active_pairs = bool(acting) and any(self.points.global_max(number))
        changed = self.discretisation.update_pattern(acting)
        if changed:
            self.forces.forget_pattern()
        return changed

    def follow_step(self, v_before: Array) -> None:
        """Let contact, and the integrators that did not take the step just accepted, from velocities v_before
        (n_owned, 3), go on from its end.
        """
        if self.contact is not None:
            self.contact.accept()
        if self.integrator is not self.integrators.usual:
            rate = (self.stage_velocity - v_before) / self.step.dt
            moves = self.step.prescribed.free & (self.mass[:, None] > 0.0)
            self.integrators.follow_step(np.where(moves, rate, 0.0))
