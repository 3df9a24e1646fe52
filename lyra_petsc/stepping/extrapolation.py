"""Where a solve starts: on a polynomial through past velocities in time, or equilibria in the load factor."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array

MOST = 2
"""Degree of the polynomial; the third gained no more, and each is an array to keep."""


def weights(times: list[float], at: float) -> list[float]:
    """Of the values at ``times`` (n,), of the polynomial of degree n − 1 through them at another time."""
    return [math.prod((at - other) / (own - other) for other in times if other != own) for own in times]


class Extrapolation:
    """Extrapolates by the degree that would have been the best for the step before; collective.

    After a jump that is the constant, the last velocity itself.

    Parameters
    ----------
    comm : MPI.Comm
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._times: list[float] = []
        self._values: list[Array] = []
        self._degree = 0

    def to(self, t1: float, t0: float, v: Array) -> Array:
        """Velocities (n, 3) [m/s] to expect at t1 [s], of ``v`` at t0, which are kept and must stay."""
        self.learn(t0, v)
        return self._expected(t1, min(self._degree, len(self._times) - 1))

    def along(self, t1: float, rate: Array) -> list[Array]:
        """Ways (n, 3) to expect until t1 from the last values, which change at ``rate``: the tangent, and the
        parabola from the values before.
        """
        after = t1 - self._times[-1]
        ways = [after * rate]
        if len(self._times) > 1:
            before = self._times[-1] - self._times[-2]
            bend = (self._values[-2] - self._values[-1]) / before + rate
            ways.append(after * rate + (after * after / before) * bend)
        return ways

    def learn(self, t0: float, v: Array) -> None:
        """Take the velocities at t0 [s], unless they are known; collective."""
        if self._times and t0 <= self._times[-1]:
            return
        if self._times:
            errors = np.array([self._error(t0, v, degree) for degree in range(len(self._times))])
            self._comm.Allreduce(MPI.IN_PLACE, errors)
            self._degree = int(errors.argmin())
        self._times = [*self._times[-MOST:], t0]
        self._values = [*self._values[-MOST:], v]

    def memory(self) -> tuple[dict[str, Array], dict[str, float]]:
        """Arrays (n, 3) and numbers to go on with after a restart; the newest velocities are the state's."""
        past = list(zip(self._times[:-1], self._values[:-1], strict=True))
        arrays = {f"past_{number}": value for number, (_, value) in enumerate(past)}
        return arrays, {f"past_{number}": time for number, (time, _) in enumerate(past)} | {
            "degree": self._degree
        }

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, float], t0: float, v: Array) -> None:
        """Go on with a memory from velocities v (n, 3) [m/s] at t0 [s]; an older one is empty."""
        names = sorted(name for name in numbers if name.startswith("past_") and name in arrays)
        if not names:
            return
        self._times = [*(float(numbers[name]) for name in names), t0]
        self._values = [*(np.array(arrays[name]) for name in names), v]
        self._degree = int(numbers["degree"])

    def _error(self, t0: float, v: Array, degree: int) -> float:
        """Square of the difference, on this rank, of v from what was to be expected at t0 [s]."""
        wrong = (v - self._expected(t0, degree)).ravel()
        return float(np.dot(wrong, wrong))

    def _expected(self, t1: float, degree: int) -> Array:
        times, values = self._times[-degree - 1 :], self._values[-degree - 1 :]
        expected: Array = np.zeros_like(values[0])
        for weight, value in zip(weights(times, t1), values, strict=True):
            expected += weight * value
        return expected
