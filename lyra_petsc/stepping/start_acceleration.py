"""Accelerations at the start of a step, for integrators and error estimates that begin anew there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.integrators.integrator import NeedsAcceleration

if TYPE_CHECKING:
    from lyra_petsc.stepping.stage_equations import StageEquations


JUST_AFTER = 1e-3
"""Part of a step after which handles have the velocities with which it starts."""

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

    Attributes
    ----------
    followers : list of NeedsAcceleration
        Objects besides the integrator (an error estimate) that need to know of jumps of the forces and of the
        accelerations after a jump.
    starts_anew : bool
        Whether the integrator began the step from accelerations computed at its start.
    """

    starts_anew = False

    def __init__(self, events: list[float]) -> None:
        self._events = events
        self.followers: list[NeedsAcceleration] = []

    def begin_step(self, equations: StageEquations, at: float) -> None:
        """Compute accelerations at the start of the step where they are needed; collective.

        ``at`` [s] is the time of the step's stage. Whether forces jump at the start of the step is decided by
        its time alone, so that a resumed run decides alike.
        """
        everyone = (equations.integrator, *self.followers)
        jumping = {equations.integrators.usual, equations.integrators.in_contact, *everyone}
        # the start of a step may differ from the time of an event by round-off
        if any(abs(equations.step.start - event) <= 1e-6 * equations.step.dt for event in self._events):
            for each in jumping:
                each.restart()
        self.starts_anew = equations.integrator.needs_acceleration
        asking = [each for each in everyone if each.needs_acceleration]
        if not asking:
            return
        acceleration = _computed(equations, at)
        for each in asking:
            each.set_acceleration(acceleration)


def _computed(equations: StageEquations, at: float) -> Array:
    """Accelerations (n_owned, 3) [m/s²] of the free unknowns at the start of the step; collective."""
    x, v, step, active = equations.frozen_positions(at), equations.v.copy(), equations.step, equations.active
    if equations.held and step.end > step.start:
        # of handles just after the start, where they may jump
        soon = step.start + JUST_AFTER * step.dt
        rates = equations.prescriptions.rates(step.prescribed, step.start, step.end, soon)
        step.prescribed.overwrite(v[: len(equations.mass)], rates)
    equations.points.update_ghosts(v)
    turns = bool(active.moving or active.external)
    if turns:  # at the stage targets are farther, and an obstacle may be where the sheet still is now
        equations.change(frozen=active.with_targets(step.frozen, equations.targets_at(step.start, x)))
    if equations.damping.active and equations.points.n_edges_global:
        _balance_moments(equations, v)
    force, mass = equations.out_of_balance(v), equations.mass[:, None]
    if turns:
        equations.change(frozen=step.frozen)
    acceleration = np.divide(force, mass, out=np.zeros_like(force), where=mass > 0.0)
    if equations.contact is None:
        return acceleration
    return equations.contact.hold(equations.step_end(v), acceleration, equations.step.frozen)


def _balance_moments(equations: StageEquations, v: Array) -> None:
    """Set the rates of free directors, in v (n_local, 3) and in the state; collective.

    Directors have no mass: damping balances their moments. Other rates would give the vertices the
    accelerations of a sheet with stiffer directors. The method is that of conjugate gradients.
    """
    layout = equations.points
    edges, free = slice(layout.n_vertices, layout.n_owned), equations.step.prescribed.free
    diagonal, increment = np.zeros_like(v), np.zeros_like(v)
    for term in equations.active.with_edges:
        if term.registration.damped:
            damping = term.elements.data["damping"]
            diagonal.reshape(-1)[term.edge_indices] += term.edge_stiffness(damping)
    scale = np.divide(1.0, diagonal[edges], out=np.zeros_like(v[edges]), where=diagonal[edges] > 0.0)
    residual = equations.out_of_balance(v)[edges]
    direction = scale * residual
    square = first = layout.global_sum(float(np.vdot(residual, direction)))[0]
    for _ in range(MAX_ITERATIONS):
        increment[edges] = direction
        layout.update_ghosts(increment)
        product = np.where(free, equations.damping.product(increment), 0.0)[edges]
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
    equations.v[edges] = v[edges]
    equations.state.update_ghosts()
