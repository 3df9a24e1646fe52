"""Backward Euler, the Lyra paper eq. 10-18, in full and as the paper's one linear solve a step."""

from __future__ import annotations

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.integrators.integrator import Integrator, Stage


class BackwardEuler(Integrator):
    """x_{n+1} = x_n + Δt v_{n+1}: first order; damps every motion that the steps do not resolve."""

    name = "beuler"
    error_constant = 0.5

    def stage_offset(self, dt: float) -> float:
        return dt

    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        return Stage(1.0 / dt, dt, dt)

    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        return x + dt * stage_velocity, stage_velocity


class SemiImplicit(BackwardEuler):
    """The paper's method: one Newton iteration of backward Euler, from the state at the start of the step."""

    name = "semi-implicit"
    lagged_loads = True
    iterates = False

    def for_contact(self) -> Integrator:
        return LaggedBackwardEuler()


class LaggedBackwardEuler(BackwardEuler):
    """Backward Euler with the loads of `SemiImplicit`, for steps in which something touches: one iteration
    could neither follow the barrier's force nor decide between sticking and sliding.
    """

    lagged_loads = True
