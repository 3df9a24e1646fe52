"""Adaptive steps: their local errors against the tolerance of the run."""

from __future__ import annotations

import math

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.linear.petsc_options import is_set
from lyra_petsc.stepping.local_error import LocalError
from lyra_petsc.stepping.run_notes import RunNotes
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.step_control import NEAR_MINIMUM, ToleranceControl

IMPACT_SKIN_FRACTION, IMPACT_RUN_FRACTION = 0.02, 1e-4
"""Displacement in a step over the skin of the contact search, and Δt over the length of the run, below which
adaptive steps are not shortened for the error of an impact, which would lead to ever shorter ones.
"""

FIRST_ORDER_STEPS = 500
"""Adaptive steps of a first-order integrator after which a note recommends one of second order."""


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

    def minimum_dt(self) -> float:
        """Smallest Δt [s] while something touches; 0 if nothing does, or ``-ts_adapt_dt_min`` is given."""
        equations = self._equations
        if not equations.has_active_pairs or is_set("ts_adapt_dt_min"):
            return 0.0
        fastest = float(equations.points.comm.allreduce(np.abs(equations.v).max(initial=0.0), MPI.MAX))
        through = (math.inf if equations.contact is None else equations.contact.skin) / max(fastest, 1e-300)
        return min(IMPACT_SKIN_FRACTION * through, IMPACT_RUN_FRACTION * self._control.end)
