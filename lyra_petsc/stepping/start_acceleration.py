"""Accelerations at the start of a step, for integrators and error estimates that begin anew there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.integrators.integrator import NeedsAcceleration
from lyra_petsc.terms.term import UpcomingStep

if TYPE_CHECKING:
    from lyra_petsc.stepping.stage_equations import StageEquations


class StartAcceleration:
    """Gives accelerations to those that need them: at the start of a run, and after jumps of the forces.

    Parameters
    ----------
    system : StageEquations
    events : list of float
        Times [s] at which forces may jump.

    Attributes
    ----------
    followers : list of NeedsAcceleration
        Objects besides the integrator (an error estimate) that need to know of jumps of the forces and of the
        accelerations after a jump.
    starts_anew : bool
        Whether the integrator began the step from accelerations computed at its start.
    """

    starts_anew = False

    def __init__(self, system: StageEquations, events: list[float]) -> None:
        self._system, self._events = system, events
        self.followers: list[NeedsAcceleration] = []

    def begin_step(self, at: float, jumps: bool) -> None:
        """Compute accelerations at the start of the step where they are needed; collective.

        ``at`` [s] is the time of the step's stage. ``jumps`` says whether forces jump at the start of the
        step, as they do at events.
        """
        system = self._system
        everyone = (system.integrator, *self.followers)
        # the start of a step may differ from the time of an event by round-off
        if jumps or any(abs(system.t0 - event) <= 1e-6 * system.dt for event in self._events):
            for each in everyone:
                each.restart()
        self.starts_anew = system.integrator.needs_acceleration
        asking = [each for each in everyone if each.needs_acceleration]
        if not asking:
            return
        acceleration = self._computed(at)
        for each in asking:
            each.set_acceleration(acceleration)

    def _computed(self, at: float) -> Array:
        """Accelerations (n_owned, 3) [m/s²] of the free unknowns at the start of the step; collective."""
        system, active = self._system, self._system.active
        x, v = system.frozen_positions(at), system.v.copy()
        system.prescribed.overwrite_with_start_velocity(v[: system.points.n_owned])
        system.points.update_ghosts(v)
        turns = bool(active.moving or active.constraints)
        if turns:  # at the stage targets are farther, and an obstacle may be where the sheet still is now
            active.move_targets(UpcomingStep(system.t0, system.t1, system.t0, x, system.reference.at))
        force, mass = system.out_of_balance(v), system.mass[:, None]
        if turns:
            active.move_targets(UpcomingStep(system.t0, system.t1, at, x, system.reference.at))
        acceleration = np.divide(force, mass, out=np.zeros_like(force), where=mass > 0.0)
        if system.discretisation.has_near_elements:
            from lyra_petsc.stepping import impacts  # needed only if something is near

            for term in active.changing:
                if term.slips:
                    acceleration = impacts.hold_by_friction(system, term, v, acceleration)
        return acceleration
