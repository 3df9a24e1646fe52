"""Local error of a step in the positions, from the velocities at its ends.

Order 1: ½ Δt² ẍ, with Δt ẍ = v_{n+1} − v_n. Order 2: C Δt³ x⃛, with x⃛ from the second divided difference
of the velocities over this step and the one before (or the accelerations at the start, where there is
none or forces have jumped), C the integrator's error constant.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.stage_equations import StageEquations


class LocalError:
    """Estimates the error of each step of a run; collective.

    Parameters
    ----------
    equations : StageEquations
    """

    def __init__(self, equations: StageEquations) -> None:
        self._equations = equations
        self._slope: Array | None = None
        self._dt = 0.0
        equations.start_acceleration.followers.append(self)

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
        return float(equations.points.comm.allreduce(largest, MPI.MAX))

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
