"""The proximal step of a static analysis, in the form of an integrator."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.integrators.integrator import Integrator, Stage


class Static(Integrator):
    """The proximal step of `stepping.statics.equilibrium`: backward Euler from rest in a pseudo time.

    Attributes
    ----------
    pseudo_dt : float
        Pseudo time step [s]: the larger it is, the closer a solve gets to equilibrium.
    predicted : (n_owned, 3) or None
        Displacement [m] predicted for the next solve, from which Newton's method starts.
    alternatives : list of (n_owned, 3)
        Other predictions [m], which may be better.
    """

    name = "static"
    error_constant = 0.0
    lagged_loads = True
    dynamic = False

    def __init__(self) -> None:
        self.pseudo_dt = 1.0
        self.predicted: Array | None = None
        self.alternatives: list[Array] = []

    def stage_offset(self, dt: float) -> float:
        return dt

    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        return Stage(1.0 / self.pseudo_dt, self.pseudo_dt, dt)

    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        return x + self.pseudo_dt * stage_velocity, np.zeros_like(v)
