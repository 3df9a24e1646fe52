"""The proximal step of a static analysis, in the form of a integrator."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.integrators.integrator import Integrator, Stage


class Static(Integrator):
    """Not a motion: the proximal step of `stepping.equilibrium`, backward Euler from rest.

    Attributes
    ----------
    pseudo : float
        Pseudo time step [s]: the larger, the closer to equilibrium a solve gets.
    ahead : (n_owned, 3) or None
        Way [m] that the next solve is expected to go; where Newton's method starts.
    others : list of (n_owned, 3)
        Other ways [m] that may be better.
    """

    name = "static"
    error_constant = 0.0
    lagged_loads = True
    moves = False

    def __init__(self) -> None:
        self.pseudo = 1.0
        self.ahead: Array | None = None
        self.others: list[Array] = []

    def stage_after(self, dt: float) -> float:
        return dt

    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        return Stage(1.0 / self.pseudo, self.pseudo, dt)

    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        return x + self.pseudo * stage_velocity, np.zeros_like(v)
