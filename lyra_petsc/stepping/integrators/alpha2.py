"""Generalised-α: Chung & Hulbert, J. Appl. Mech. 60 (1993) 371-375."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.integrators.integrator import Arrays, Integrator, Stage


class GeneralisedAlpha(Integrator):
    """Generalised-α: second order, with numerical damping of high frequencies.

    Parameters
    ----------
    radius : float
        Spectral radius at infinite frequency, from 0 (gone after one step) to 1 (undamped).
    """

    name = "alpha2"
    order = 2
    centred = True
    gain_window = 4
    handles_at_stage = True

    def __init__(self, radius: float) -> None:
        self._am = (2.0 * radius - 1.0) / (radius + 1.0)
        self._af = radius / (radius + 1.0)
        self._gamma = 0.5 - self._am + self._af
        self._beta = 0.25 * (1.0 - self._am + self._af) ** 2
        self._a: Array | None = None
        self._next: Array | None = None

    def for_contact(self) -> Integrator:
        from lyra_petsc.stepping.integrators.bdf2 import Bdf2  # in scenes with contact only

        return Bdf2()

    @property
    def error_constant(self) -> float:
        # the stored accelerations lag by (γ − ½) Δt
        return abs(1.0 / 6.0 - self._beta + 0.5 * (self._gamma - 0.5))

    @property
    def needs_acceleration(self) -> bool:
        return self._a is None

    def set_acceleration(self, acceleration: Array) -> None:
        self._a = acceleration

    def restart(self) -> None:
        self._a = None

    def stage_offset(self, dt: float) -> float:
        return (1.0 - self._af) * dt

    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        assert self._a is not None
        am, af, gamma, beta = self._am, self._af, self._gamma, self._beta
        sigma = (1.0 - am) / ((1.0 - af) * gamma * dt)
        c = beta * dt / gamma
        v_h = v + (((1.0 - am) * (1.0 - gamma) / gamma - am) / sigma) * self._a
        x_h = x + ((1.0 - af) * dt - c) * v + (1.0 - af) * dt * dt * (0.5 - beta / gamma) * self._a
        return Stage(sigma, c, (1.0 - af) * dt, x_h, v_h)

    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        assert self._a is not None
        gamma, beta = self._gamma, self._beta
        change = (stage_velocity - v) / ((1.0 - self._af) * dt)
        self._next = (change - (1.0 - gamma) * self._a) / gamma
        x_end = x + dt * v + dt * dt * ((0.5 - beta) * self._a + beta * self._next)
        return x_end, v + dt * ((1.0 - gamma) * self._a + gamma * self._next)

    def record_step(self, x: Array, v: Array, free: NDArray[np.bool_], dt: float) -> None:
        assert self._next is not None
        self._a = np.where(free, self._next, 0.0)

    def saved_state(self) -> tuple[Arrays, dict[str, float]]:
        return ({} if self._a is None else {"acceleration": self._a}), {}

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, float]) -> None:
        self._a = arrays.get("acceleration")
