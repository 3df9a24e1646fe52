"""Accelerations at the start of a step, for integrators and error estimates that begin anew there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.applied_loads import LoadCase
from lyra_petsc.stepping.forces import StageForces
from lyra_petsc.stepping.integrators.in_use import IntegratorsInUse
from lyra_petsc.stepping.integrators.integrator import NeedsAcceleration
from lyra_petsc.stepping.prescribed import Prescriptions
from lyra_petsc.stepping.state import State
from lyra_petsc.stepping.time_step import Evaluation, TimeStep
from lyra_petsc.terms.protocols import Located
from lyra_petsc.terms.step_end import INSTANT

if TYPE_CHECKING:
    from lyra_petsc.contact.scene_contact import SceneContact

MAX_ITERATIONS = 100
"""Largest number of iterations for the rates of directors, whose equations are well-conditioned."""

ROUND_OFF = 1e-10
"""Norm of their residual over the first one at which they count as solved."""


class StartAcceleration:
    """Gives accelerations to those that need them: at the start of a run, and after jumps of the forces.

    Parameters
    ----------
    events : list of float
        Times [s] at which forces may jump.
    integrators : IntegratorsInUse
    forces : StageForces
    state : State
    prescriptions : Prescriptions
    contact : SceneContact or None

    Attributes
    ----------
    followers : list of NeedsAcceleration
        Objects besides the integrator (an error estimate) that need to know of jumps of the forces and of the
        accelerations after a jump.
    starts_anew : bool
        Whether the integrator began the step from accelerations computed at its start.
    jumps : tuple of float
        Times [s] of the jumps that the scene does not name: by a program, or by what breaks.
    """

    starts_anew = False
    jumps: tuple[float, ...] = ()

    def __init__(
        self,
        events: list[float],
        integrators: IntegratorsInUse,
        forces: StageForces,
        state: State,
        prescriptions: Prescriptions,
        contact: SceneContact | None,
    ) -> None:
        self._events, self._integrators, self._forces = events, integrators, forces
        self._state, self._prescriptions, self._contact = state, prescriptions, contact
        self.followers: list[NeedsAcceleration] = []

    def expect_jump(self, time: float, now: float) -> None:
        """Let forces jump at a further time [s], ``now`` or later."""
        self.jumps = (*(jump for jump in self.jumps if jump >= now), time)

    def begin_step(self, step: TimeStep, x: Array) -> None:
        """Compute accelerations at the start of a step, with frozen positions x (n_local, 3), where they are
        needed; collective.

        Whether forces jump at the start of the step is decided by its time alone, so that a resumed run
        decides alike.
        """
        integrators = self._integrators
        everyone = (integrators.present, *self.followers)
        # the start of a step may differ from the time of an event by round-off
        if any(abs(step.start - event) <= 1e-6 * step.dt for event in (*self._events, *self.jumps)):
            for follower in {integrators.usual, integrators.in_contact, *everyone}:
                follower.restart()
        self.starts_anew = integrators.present.needs_acceleration
        asking = [follower for follower in everyone if follower.needs_acceleration]
        if asking:
            acceleration = self._computed(step, x)
            for follower in asking:
                follower.set_acceleration(acceleration)

    def _computed(self, step: TimeStep, x: Array) -> Array:
        """Accelerations (n_owned, 3) [m/s²] of the free unknowns at the start of the step; collective."""
        forces, state, layout = self._forces, self._state, self._forces.layout
        active, mass, v = forces.active, forces.mass[:, None], state.v.copy()
        if step.dt > 0.0:
            # of handles just after the start, where they may jump
            soon = step.start + INSTANT * step.dt
            rates = self._prescriptions.rates(step.prescribed, step.start, step.end, soon)
            step.prescribed.overwrite(v[: len(mass)], rates)
        layout.update_ghosts(v)
        # at the stage targets are farther, an obstacle may be where the sheet is now, and loads are others
        there = step.upcoming(step.start, x, self._prescriptions.reference)
        frozen = dict(active.with_targets(step.frozen, there))
        frozen |= {term: term.freeze(there) for term in active.viscous}
        wind = forces.sum(active.viscous, state.v, frozen) if step.lagged and active.viscous else None
        loads = LoadCase().loads(active.loads, there, len(mass), wind)
        at_start = step.changed(frozen=frozen, loads=loads)
        geometry = (state.evaluation or Evaluation(at_start, state.x, v, forces)).geometry
        if forces.damps and layout.n_edges_global:
            self._balance_moments(at_start, v, geometry)
        force = self._out_of_balance(at_start, v, geometry)
        acceleration = np.divide(force, mass, out=np.zeros_like(force), where=mass > 0.0)
        start = step.finished(layout, forces.mass, state.x, v, self._integrators.present.order)
        for term in active.sliding if self._contact is not None and self._contact.near else ():
            acceleration = term.hold(start, acceleration, step.frozen[term])
        return acceleration

    def _out_of_balance(self, step: TimeStep, v: Array, geometry: Mapping[Any, Located]) -> Array:
        """Force (n_owned, 3) [N] on the free unknowns at the state's positions with velocities v."""
        at = Evaluation(step, self._state.x, v, self._forces, known_geometry=geometry)
        return self._forces.out_of_balance(at)

    def _balance_moments(self, step: TimeStep, v: Array, geometry: Mapping[Any, Located]) -> None:
        """Set the rates of free directors, in v (n_local, 3) and in the state; collective.

        Directors have no mass: damping balances their moments. Other rates would give the vertices the
        accelerations of a sheet with stiffer directors. The method is that of conjugate gradients.
        """
        layout = self._forces.layout
        edges, free = slice(layout.n_vertices, layout.n_owned), step.prescribed.free
        diagonal, increment = np.zeros_like(v), np.zeros_like(v)
        for term in self._forces.active.with_edges:
            if term.registration.damped:
                damping = term.elements.data["damping"]
                diagonal.reshape(-1)[term.edge_indices] += term.edge_stiffness(damping)
        scale = np.divide(1.0, diagonal[edges], out=np.zeros_like(v[edges]), where=diagonal[edges] > 0.0)
        residual = self._out_of_balance(step, v, geometry)[edges]
        direction = scale * residual
        square = first = layout.global_sum(float(np.vdot(residual, direction)))[0]
        for _ in range(MAX_ITERATIONS):
            increment[edges] = direction
            layout.update_ghosts(increment)
            damping = Evaluation(step, self._state.x, increment, self._forces).damping
            product = np.where(free, damping, 0.0)[edges]
            power = layout.global_sum(float(np.vdot(direction, product)))[0]
            if not power > 0.0:
                break
            v[edges] += square / power * direction
            residual -= square / power * product
            before, square = square, layout.global_sum(float(np.vdot(residual, scale * residual)))[0]
            if square <= ROUND_OFF**2 * first:
                break
            direction = scale * residual + square / before * direction
        layout.update_ghosts(v)
        self._state.set_edge_rates(v)
