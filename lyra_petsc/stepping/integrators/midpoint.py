"""The implicit midpoint rule."""

from __future__ import annotations

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.integrators.integrator import Integrator, Stage


class Midpoint(Integrator):
    """Implicit midpoint rule: second order, conserves energy, without numerical damping."""

    name = "midpoint"
    order = 2
    error_constant = 1.0 / 12.0
    ts_type = "theta"
    centred = True
    handles_at_stage = True
    damps_stiff = False
    moves_uniformly = True

    def for_contact(self) -> Integrator:
        from lyra_petsc.stepping.integrators.bdf2 import Bdf2  # in scenes with contact only

        return Bdf2()

    def stage_offset(self, dt: float) -> float:
        return 0.5 * dt

    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        return Stage(2.0 / dt, 0.5 * dt, 0.5 * dt)

    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        return x + dt * stage_velocity, 2.0 * stage_velocity - v
