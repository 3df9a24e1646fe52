"""BDF2, with unequal steps: Hairer, Nørsett & Wanner, Solving ODEs I, sec. III.5."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.integrators.alpha2 import GeneralisedAlpha
from lyra_petsc.stepping.integrators.integrator import Arrays, Integrator, Stage


class Bdf2(Integrator):
    """Backward differentiation formula of second order, which damps stiff motions.

    Its history has two states. If the last steps are equal it has three, with 48 % of the third-order formula
    added: that is still L-stable and halves the error (BDF2OPT; Vatsa, Carpenter & Lockard, AIAA 2010-122).
    The first step, and the first after a jump of the forces, is a step of generalised-α with spectral
    radius 0.
    """

    name = "bdf2"
    order = 2
    centred = True
    gain_window = 4

    SHARE = 0.48
    """Weight of the third-order formula; A-stable up to 0.5."""

    SAME = 1e-6
    """Relative difference below which two steps count as equal."""

    def __init__(self) -> None:
        self._starter = GeneralisedAlpha(0.0)
        self._past: list[tuple[Array, Array, float]] = []

    @property
    def error_constant(self) -> float:
        if len(self._past) < 2:
            return self._starter.error_constant
        r = self._past[0][2] / self._past[1][2]
        return (1.0 + r) ** 2 / (6.0 * r * (1.0 + 2.0 * r))

    @property
    def handles_at_stage(self) -> bool:  # type: ignore[override]
        return not self._past

    @property
    def needs_acceleration(self) -> bool:
        return not self._past and self._starter.needs_acceleration

    def set_acceleration(self, acceleration: Array) -> None:
        self._starter.set_acceleration(acceleration)

    def restart(self) -> None:
        # a polynomial through states before and after a jump is of first order
        self._past = []
        self._starter.restart()

    def stage_offset(self, dt: float) -> float:
        return dt

    def weights(self, dt: float) -> tuple[float, list[float]]:
        """σ [1/s], and the weights, with sum 1, of the present and the past states in the history."""
        r = dt / self._past[0][2]
        if len(self._past) > 1 and all(abs(dt / step - 1.0) < self.SAME for _, _, step in self._past):
            second, third = (1.5, -2.0, 0.5, 0.0), (11.0 / 6.0, -3.0, 1.5, -1.0 / 3.0)
            lead, *rest = (
                self.SHARE * c + (1.0 - self.SHARE) * b for b, c in zip(second, third, strict=True)
            )
            return lead / dt, [-c / lead for c in rest]
        lead = (1.0 + 2.0 * r) / (1.0 + r)
        return lead / dt, [(1.0 + r) ** 2 / (1.0 + 2.0 * r), -r * r / (1.0 + 2.0 * r)]

    def _history(self, x: Array, v: Array, dt: float) -> tuple[float, Array, Array]:
        """σ [1/s] and the histories x_h [m] and v_h [m/s]."""
        sigma, (now, *before) = self.weights(dt)
        x_h, v_h = now * x, now * v
        for weight, (past_x, past_v, _) in zip(before, self._past, strict=False):
            x_h += weight * past_x
            v_h += weight * past_v
        return sigma, x_h, v_h

    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        if not self._past:
            return self._starter.stage(x, v, dt)
        sigma, x_h, v_h = self._history(x, v, dt)
        return Stage(sigma, 1.0 / sigma, dt, x_h, v_h)

    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        if not self._past:
            return self._starter.end(x, v, stage_velocity, dt)
        sigma, x_h, _ = self._history(x, v, dt)
        return x_h + stage_velocity / sigma, stage_velocity

    def record_step(self, x: Array, v: Array, free: NDArray[np.bool_], dt: float) -> None:
        self._past = [(x, v, dt), *self._past[:1]]

    def shift_past_positions(self, change: Array) -> None:
        self._past = [(x + change, v, dt) for x, v, dt in self._past]

    def shift_past_velocities(self, change: Array) -> None:
        past, ago = [], 0.0
        for x, v, dt in self._past:
            ago += dt
            past.append((x - ago * change, v + change, dt))
        self._past = past

    def saved_state(self) -> tuple[Arrays, dict[str, float]]:
        arrays: Arrays = {}
        numbers: dict[str, float] = {}
        for i, (x, v, dt) in enumerate(self._past):
            arrays |= {f"past_position_{i}": x, f"past_velocity_{i}": v}
            numbers[f"past_dt_{i}"] = dt
        return arrays if self._past else self._starter.saved_state()[0], numbers

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, float]) -> None:
        self._starter = GeneralisedAlpha(0.0)
        self._starter.restore(arrays, numbers)
        self._past = [
            (arrays[f"past_position_{i}"], arrays[f"past_velocity_{i}"], float(numbers[f"past_dt_{i}"]))
            for i in range(2)
            if f"past_position_{i}" in arrays
        ]
