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
from lyra_petsc.stepping.start_acceleration import StartAcceleration
from lyra_petsc.stepping.state import State
from lyra_petsc.stepping.time_step import Evaluation, TimeStep
from lyra_petsc.terms.handles.prescribed_handles import ExactHandles
from lyra_petsc.terms.protocols import Located
from lyra_petsc.terms.step_end import ContactEnd, StepEnd
from lyra_petsc.terms.term import Term, UpcomingStep

if TYPE_CHECKING:
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
    load_case, forces, active, damping, directors, prescriptions, reference, integrators : parts
    predicted_stress, start_acceleration : parts
    nears_limit : bool
        `ActiveTerms.limits_act` at the positions of the state; contact is apart.
    has_active_pairs : bool
        Whether any pair of a term with changing stencils acted when the block rows were last renewed.
    """

    has_active_pairs = nears_limit = False
    contact_before = contact_end = ContactEnd()
    """At the start of the step, and at its end once it is taken."""

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
        self.active = active = ActiveTerms(terms, obstacles_move=moves, damps_stiff=integrator.damps_stiff)
        limited = contact is not None or bool(active.limiting or active.holding)
        self.integrators = IntegratorsInUse(integrator, limited=limited)
        discretisation.when_ghosts_change(self._follow_ghosts)
        self.contact, self.held = contact, held
        self.prescriptions = Prescriptions(discretisation, held, terms, starts)
        self.reference = self.prescriptions.reference
        self.load_case = LoadCase()
        once = integrator.lagged_loads
        self.damping = Damping(
            discretisation, active.elastic, dynamic=integrator.dynamic, single_assembly=once
        )
        self.directors = Directors(active.with_edges, self.points)
        self.forces = StageForces(discretisation, mass, active, self.damping, self.directors.min_stiffness)
        self.state = State(discretisation)
        zero, none, frozen = self.v[: len(mass)], self.prescriptions.none, dict.fromkeys(terms)
        stage, loads = Stage(1.0, 1.0, 1.0), StepLoads(np.zeros((len(mass), 3)))
        self.step = TimeStep(0.0, 0.0, stage, self.x, self.x, zero, none, loads, frozen, lagged=once)
        self.evaluated = self.at(self.x, self.v)
        self.start_acceleration = StartAcceleration(
            events, self.integrators, self.forces, self.state, self.prescriptions, contact
        )
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

    def take_loads(self, **changes: Any) -> None:
        """Change entries of the load case of the next step."""
        self.load_case = replace(self.load_case, **changes)

    def targets_at(self, time: float, x: Array | None = None) -> UpcomingStep:
        """The step as terms receive it to freeze their data at a time [s] of it."""
        return self.step.upcoming(time, self.x if x is None else x, self.reference)

    def change(self, **changes: Any) -> None:
        """Go on with another step, with these entries changed: what has been evaluated holds no longer."""
        self.step = self.step.changed(**changes)

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
        self.state.evaluation = self.evaluated if self._starts_next(self.step) else None

    def hold_targets(self, time: float) -> None:
        """Put moving targets at their positions at ``time`` [s], between two steps; collective."""
        self.change(start=time, end=time)
        self.change(frozen=self.active.freeze(self.targets_at(time)))
        if self.contact is not None:
            self.contact.begin(time, time)
            self.contact.update(self.x)  # energies at the start of a run need all stencils
            for term in self.active.sliding:
                term.initialise_pairs(self.x, self.step.frozen[term])
            self.contact_before = self.contact.finish(self._finished(), self.step.frozen, None)
        self.nears_limit = self.active.limits_act(self.x, self.step.frozen, self.points)
        self.evaluated = self.at(self.x, self.v)

    # -- a step ------------------------------------------------------------------------------------

    def begin_step(self, t0: float, t1: float) -> None:
        """Set up the equations of the step from t0 to t1 [s], and freeze its data; collective."""
        self.predicted_stress.forget()
        at = t0 + self.integrator.stage_offset(t1 - t0)
        in_contact = self.integrators.suits_contact
        held = self.prescriptions.of_step(t0, t1, self.x)
        self.contact_end = ContactEnd()
        self.change(start=t0, end=t1, prescribed=held, in_contact=in_contact)
        if self.contact is not None:
            self.contact.begin(t0, t1)
            self.contact.update(self.x, self.expected_displacement(), self.expected_displacement)
        x = self.state.moved(at - t0) if self.integrator.centred else self.x
        self._freeze(at, x)
        self.start_acceleration.begin_step(self.step, x)
        self._set_stage(at)

    def expected_displacement(self, steps: int = 1) -> Array:
        """As `State.expected_displacement` in the present step; collective."""
        return self.state.expected_displacement(self.step.dt, self.step.prescribed, steps)

    def _freeze(self, at: float, x: Array) -> None:
        """Freeze geometry at positions x (n_local, 3), targets and loads at the time ``at`` [s]."""
        lagged, there = self.integrator.lagged_loads, self.targets_at(at, x)
        frozen = self.active.freeze(there)
        self.directors.begin_step()
        if (geometry := self.state.geometry(frozen)) is None:
            self.state.evaluation = None  # its forces are those with other frames
        viscous = self.active.viscous if lagged else []
        wind = self.forces.sum(viscous, self.v, frozen) if viscous else None
        self.change(
            frozen=frozen,
            loads=self.load_case.loads(self.active.loads, there, len(self.mass), wind),
            x=self.x,
            size=float(np.abs(self.x).max(initial=0.0)),
            linear=not self.integrator.iterates,
            lagged=lagged,
        )
        if self.damping.active:
            located = {} if self.integrator.centred or geometry is None else geometry
            self.damping.freeze(x, frozen, self.active.refreeze(frozen, located))

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
            held.overwrite(rate, self.prescriptions.end_rates(step))
        self.state.set(moved, rate)
        if self._starts_next(step):
            self.evaluated = self.state.evaluation = self.at(self.x, solution.v)
        elif step.ends_at_stage and step.stage.x is None and not solution.v[held.mask].any():
            # the state is at the stage, as no handle moves
            self.state.evaluation = self.at(self.x, solution.v, solution.geometry)
        if self.integrator.dynamic:
            self.nears_limit = self.active.limits_act(self.x, step.frozen, self.points)
        if not self.integrator.dynamic or self.contact is None:
            return
        self.state.keep_past(rate_before)
        if not step.in_contact:
            return
        self.contact_end = self.contact.finish(self._finished(), step.frozen, self.contact_before)
        if self.near:
            change = self.contact_end.impulses.change
            self.state.set_velocity(self.v[:n] + change)
            self.integrators.in_contact.shift_past_velocities(change)

    def _starts_next(self, step: TimeStep) -> bool:
        """Whether the stage of a step is at its end, and the next step is linearised there."""
        return step.linear and not self.active.moving

    # -- evaluations -------------------------------------------------------------------------------

    def at(self, x: Array, v: Array, geometry: Mapping[Any, Located] | None = None) -> Evaluation:
        """An evaluation of the present step at positions and velocities x, v (n_local, 3), with the terms'
        geometry there where it is known.
        """
        return Evaluation(self.step, x, v, self.forces, known_geometry=geometry)

    def here(self) -> Evaluation:
        """The state as a point of the present step, kept for the start of the next."""
        known = self.state.evaluation
        if known is None or known.step.number != self.step.number:
            known = self.state.evaluation = self.at(self.x, self.v, self.state.geometry(self.step.frozen))
        return known

    def evaluate(self, v: Array) -> Evaluation:
        """The stage at velocities v (n_owned, 3); collective."""
        step, rates, geometry = self.step, self.points.extended(v), None
        if step.stage.x is None and not rates.any():  # where the step starts
            geometry = self.state.geometry(step.frozen) if self.state.starts(step) else None
        return self.revisit(self.at(step.stage.c * rates + step.x_h, rates, geometry))

    def linearised(self, v: Array) -> Evaluation:
        """The stage at which F and its Jacobian are evaluated for velocities v (n_owned, 3); collective.

        One linear solve takes them where the step starts, also if handles move: elements at a handle would be
        stretched by its whole motion.
        """
        if not self.step.linear:
            return self.evaluate(v)
        x_h, known = self.step.x_h, self.state.starts(self.step)
        geometry = self.state.geometry(self.step.frozen) if known else None
        forces = known.internal if known and self._starts_next(known.step) else None
        self.state.evaluation = None
        return self.revisit(Evaluation(self.step, x_h, np.zeros_like(x_h), self.forces, forces, geometry))

    def revisit(self, evaluation: Evaluation) -> Evaluation:
        """An evaluation of the present step again, with the pairs that are near there; collective."""
        self.evaluated = evaluation
        if self.acting_contact is not None:
            self.acting_contact.update(evaluation.x)
        return self.evaluated

    def residual_at(self, v: Array) -> Array:
        """F (n_owned, 3) [N] at velocities v (n_owned, 3); collective."""
        self.forces.residual(v, self.linearised(v), out := np.empty_like(v))
        return out

    def out_of_balance(self) -> Array:
        """Force (n_owned, 3) [N] on the free unknowns in the state, without inertia."""
        return self.forces.out_of_balance(self.at(self.x, self.v))

    def forces_at_stage(self) -> Iterator[tuple[str, Array]]:
        """The parts of F at the stage of the step just accepted, each (n_owned, 3) [N]."""
        step, n, held = self.step, len(self.mass), self.step.prescribed
        rate = step.stage.sigma * (self.evaluated.v[:n] - step.v_h)
        if not step.ends_at_stage:  # handles do not have the integrator's accelerations
            held.overwrite(rate, (self.v[:n] - step.v_h).take(held.indices) / step.dt)
        return self.forces.parts(self.evaluated, rate)

    def displacement(self, v: Array, increment: Array) -> tuple[Array, Array]:
        """Stage positions at velocities v (n_owned, 3), and displacements from there, both (n_local, 3) [m].

        ``increment`` (n_owned, 3) [m/s] is added to the velocities; collective.
        """
        return self.evaluate(v).x, self.points.extended(increment * self.step.stage.c)

    def _finished(self) -> StepEnd:
        """The end of the step, at the state."""
        return self.step.finished(self.points, self.mass, self.x, self.v, self.integrator.order)

    @property
    def acting_contact(self) -> SceneContact | None:
        """The contact that is part of the equations of the step."""
        return self.contact if self.step.in_contact else None

    @property
    def near(self) -> bool:
        """Whether any parts are near each other."""
        return self.contact is not None and self.contact.near

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
        here, terms = self.evaluated, self.active.of_contact if self.near else []
        acting = {term.name: term.active_elements(here.x, here.frozen[term]) for term in terms}
        acts = any(mask.any() for mask in acting.values())
        self.has_active_pairs = bool(acting) and any(self.points.global_max(acts))
        changed = self.discretisation.update_pattern(acting)
        if changed:
            self.forces.forget_pattern()
        return changed

    def follow_step(self, v_before: Array) -> None:
        """Go on from the end of the step just accepted, from velocities v_before (n_owned, 3), also with the
        integrators that did not take it.
        """
        self.contact_before = self.contact_end
        if self.integrator is not self.integrators.usual:
            rate = (self.evaluated.v[: len(self.mass)] - v_before) / self.step.dt
            moves = self.step.prescribed.free & (self.mass[:, None] > 0.0)
            self.integrators.follow_step(np.where(moves, rate, 0.0))
