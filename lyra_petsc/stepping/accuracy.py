"""Adaptive steps: their local errors against the tolerance of the run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.linear.petsc_options import is_set
from lyra_petsc.stepping.run_notes import RunNotes
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.step_control import NEAR_MINIMUM, ToleranceControl

IMPACT_SKIN_FRACTION, IMPACT_RUN_FRACTION = 0.02, 1e-4
"""Displacement in a step over the skin of the contact search, and Δt over the length of the run, below which
adaptive steps are not shortened for the error of an impact, which would lead to ever shorter ones.
"""

FIRST_ORDER_STEPS = 500
"""Adaptive steps of a first-order integrator after which a note recommends one of second order."""


class LocalError:
    """Estimates the local error of each step in the positions, from the velocities at its ends; collective.

    Order 1: ½ Δt² ẍ, with Δt ẍ = v_{n+1} − v_n. Order 2: C Δt³ x⃛, with x⃛ from the second divided difference
    of the velocities over this step and the one before (or the accelerations at the start, where there is
    none or forces have jumped), C the integrator's error constant.

    Parameters
    ----------
    equations : StageEquations
    """

    def __init__(self, equations: StageEquations) -> None:
        self._equations = equations
        self._slope: Array | None = None
        self._dt = 0.0

    @property
    def needs_acceleration(self) -> bool:
        """Whether accelerations at the start of the coming step are needed."""
        return self._equations.integrator.order > 1 and self._slope is None

    def set_acceleration(self, acceleration: Array) -> None:
        """Set the accelerations (n_owned, 3) [m/s²] at the start of the step."""
        self._slope, self._dt = acceleration, 0.0

    def restart(self) -> None:
        """Forget the history, as forces jump at the start of the coming step."""
        self._slope = None

    def estimate(self, v_before: Array, dt: float) -> float:
        """Largest local error [m] over the free coordinates of the step just taken, which began with
        velocities v_before (n_owned, 3) [m/s].
        """
        equations = self._equations
        n = equations.points.n_owned
        slope = (equations.v[:n] - v_before) / dt
        if equations.integrator.order == 1:
            error = 0.5 * dt * dt * slope
        else:
            assert self._slope is not None
            third = 2.0 * (slope - self._slope) / (dt + self._dt)
            error = equations.integrator.error_constant * dt**3 * third
        # edge unknowns follow the vertices and have no error of their own
        vertices = slice(0, equations.points.n_vertices)
        largest = float(
            np.abs(error[vertices]).max(initial=0.0, where=equations.step.prescribed.free[vertices])
        )
        return equations.points.global_max(largest)[0]

    def record_step(self, v_before: Array, dt: float) -> None:
        """Record the slope of the accepted step."""
        if self._equations.integrators.usual.order > 1:
            n = self._equations.points.n_owned
            self._slope, self._dt = (self._equations.v[:n] - v_before) / dt, dt

    def saved_state(self) -> tuple[dict[str, Array], dict[str, float]]:
        """Arrays (n_owned, 3) and numbers of a checkpoint."""
        return ({} if self._slope is None else {"slope": self._slope}), {"slope_dt": self._dt}

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, float]) -> None:
        """Restore a `saved_state`."""
        self._slope = arrays.get("slope")
        self._dt = float(numbers.get("slope_dt", 0.0))


class Accuracy:
    """Judges the local error of each step; collective.

    Parameters
    ----------
    equations : StageEquations
    control : ToleranceControl
    tolerance : float
        Error at the end of the run over ``size``.
    size : float
        Size of the sheet [m].

    Attributes
    ----------
    local_error : LocalError
    estimated : float
        Sum of the errors of the accepted steps over ``size``.
    """

    def __init__(
        self, equations: StageEquations, control: ToleranceControl, tolerance: float, size: float
    ) -> None:
        self._equations, self._control, self._tolerance, self._size = equations, control, tolerance, size
        self.local_error = LocalError(equations)
        self.estimated = self._error = 0.0

    def accepts(self, v_before: Array, dt: float) -> bool:
        """Whether the error of a step of dt [s] from velocities v_before (n_owned, 3) is within its share."""
        equations = self._equations
        self._error = self.local_error.estimate(v_before, dt) / self._size
        ratio, touches = self._error / self._share(dt), equations.has_active_pairs
        order = equations.integrator.order
        return self._control.accept(dt, ratio, order, self.minimum_dt(), touches=touches)

    def _share(self, dt: float) -> float:
        return self._tolerance * dt / self._control.end

    def record_step(self, v_before: Array, dt: float, step: int, time: float, notes: RunNotes) -> None:
        """Record the step that was accepted after ``step`` others at ``time`` [s]."""
        self.local_error.record_step(v_before, dt)
        self.estimated += self._error
        usual, minimum = self._equations.integrators.usual, self.minimum_dt()
        if usual.order == 1 and step >= FIRST_ORDER_STEPS:
            notes.once(
                "order",
                f"{step} steps to t = {time:g} s: {usual.name} is of first order, with Δt in proportion to "
                "time.tolerance; bdf2 or alpha2 take fewer steps",
            )
        if self._error > self._share(dt) and dt <= NEAR_MINIMUM * max(minimum, self._control.smallest):
            where = "of those that follow impacts " if minimum > self._control.smallest else ""
            notes.once(
                "error",
                f"step {step + 1} (t = {time:g} s): time.tolerance is not reached with the smallest "
                f"Δt = {dt:.3g} s {where}(-ts_adapt_dt_min)",
            )

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, Any]) -> None:
        """Continue from a checkpoint's arrays (n_owned, 3) and numbers."""
        self.estimated = numbers["estimated_error"]
        self.local_error.restore(arrays, numbers["integrator"])

    def minimum_dt(self) -> float:
        """Smallest Δt [s] while something touches; 0 if nothing does, or ``-ts_adapt_dt_min`` is given."""
        equations = self._equations
        if not equations.has_active_pairs or is_set("ts_adapt_dt_min"):
            return 0.0
        (fastest,) = equations.points.global_max(float(np.abs(equations.v).max(initial=0.0)))
        through = (math.inf if equations.contact is None else equations.contact.skin) / max(fastest, 1e-300)
        return min(IMPACT_SKIN_FRACTION * through, IMPACT_RUN_FRACTION * self._control.end)
