"""Polynomial extrapolation of past velocities in time, or of past equilibria in the load factor."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array

MAX_DEGREE = 2
"""Largest degree of the polynomial. The third gained nothing, and each degree is one more array to keep."""


def lagrange_weights(times: list[float], at: float) -> list[float]:
    """Weights of values at ``times`` (n,) in the interpolation polynomial's value at another time."""
    return [math.prod((at - other) / (own - other) for other in times if other != own) for own in times]


class Extrapolation:
    """Extrapolates with the degree that would have been the best for the last step; collective.

    After a jump that is degree 0: the last velocity itself.

    Parameters
    ----------
    comm : MPI.Comm
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._times: list[float] = []
        self._values: list[Array] = []
        self._degree = 0

    def extrapolate(self, t1: float, t0: float, v: Array) -> Array:
        """Velocities (n, 3) [m/s] expected at t1 [s], after recording v (n, 3) at t0; v must not change."""
        self.record(t0, v)
        return self._expected(t1, min(self._degree, len(self._times) - 1))

    def tangent_predictions(self, t1: float, rate: Array) -> list[Array]:
        """Changes (n, 3) expected from the last values, which change at ``rate`` (n, 3), until t1.

        The first is along the tangent, the second along the parabola through the values before.
        """
        after = t1 - self._times[-1]
        changes = [after * rate]
        if len(self._times) > 1:
            before = self._times[-1] - self._times[-2]
            curvature = (self._values[-2] - self._values[-1]) / before + rate
            changes.append(after * rate + (after * after / before) * curvature)
        return changes

    def record(self, t0: float, v: Array) -> None:
        """Record the velocities at t0 [s], unless they are known; collective."""
        if self._times and t0 <= self._times[-1]:
            return
        if self._times:
            errors = np.array([self._error(t0, v, degree) for degree in range(len(self._times))])
            self._comm.Allreduce(MPI.IN_PLACE, errors)
            self._degree = int(errors.argmin())
        self._times = [*self._times[-MAX_DEGREE:], t0]
        self._values = [*self._values[-MAX_DEGREE:], v]

    def saved_state(self) -> tuple[dict[str, Array], dict[str, float]]:
        """Arrays (n, 3) and numbers of a checkpoint, for `restore`, without the newest velocities."""
        past = list(zip(self._times[:-1], self._values[:-1], strict=True))
        arrays = {f"past_{number}": value for number, (_, value) in enumerate(past)}
        return arrays, {f"past_{number}": time for number, (time, _) in enumerate(past)} | {
            "degree": self._degree
        }

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, float], t0: float, v: Array) -> None:
        """Restore a `saved_state` and velocities v (n, 3) [m/s] at t0 [s]; another integrator saves none."""
        names = sorted(name for name in numbers if name.startswith("past_") and name in arrays)
        if not names:
            return
        self._times = [*(float(numbers[name]) for name in names), t0]
        self._values = [*(np.array(arrays[name]) for name in names), v]
        self._degree = int(numbers["degree"])

    def _error(self, t0: float, v: Array, degree: int) -> float:
        """Square, on this rank, of the difference of v from the extrapolation of this degree to t0 [s]."""
        error = (v - self._expected(t0, degree)).ravel()
        return float(np.dot(error, error))

    def _expected(self, t1: float, degree: int) -> Array:
        times, values = self._times[-degree - 1 :], self._values[-degree - 1 :]
        expected: Array = np.zeros_like(values[0])
        for weight, value in zip(lagrange_weights(times, t1), values, strict=True):
            expected += weight * value
        return expected
