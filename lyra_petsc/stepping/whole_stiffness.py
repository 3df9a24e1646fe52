"""Pressures in an equilibrium with all of their stiffness, also where they have no potential.

Beside free edges there may be a stable equilibrium where the symmetric part of the stiffness, and with it the
potential that solves minimise, is indefinite. Newton's method with all of the stiffness finds it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.following_loads import FollowingLoads, Solve, newton_way
from lyra_petsc.stepping.stability import Examination, Stability
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.stepper import Attempt
from lyra_petsc.terms.term import Load

MOST_ITERATIONS, GIVEN_UP = 20, 1e6
"""Of Newton's method, and the growth of the force in one, by stretching, at which it is given up."""


class WholeStiffness:
    """Of an equilibrium with pressures; collective.

    Parameters
    ----------
    system : StageEquations
    tangent : callable
        As `Stepper.tangent`.
    examine : callable
        Examines the equilibrium that the equations are at.
    balanced : callable
        Whether a force of this norm [N] counts as none, with that an iteration before.
    """

    def __init__(
        self,
        system: StageEquations,
        tangent: Callable[[Array], tuple[Array | None, int]],
        examine: Callable[[], Examination],
        balanced: Callable[[float, float], bool],
    ) -> None:
        self._system, self._tangent, self._examine, self._balanced = system, tangent, examine, balanced

    def seek(self, before: float, factor: float, guess: Array) -> Attempt | None:
        """Seek the equilibrium at load factor ``factor`` from positions (n_owned, 3) [m] by Newton's method.

        Of those with a potential none that is unstable is taken. On failure the state is the one before.
        """
        system, n = self._system, self._system.points.n_owned
        if system.active.viscous or system.discretisation.limits_motion:
            return None
        x = system.x[:n].copy()
        system.begin_step(before, factor)
        frozen, anchored, last = system.active.frozen, system.moving_energy_before, np.inf
        system.prescribed.targets(before, factor, factor, guess)
        self._go_to(guess)
        for iteration in range(MOST_ITERATIONS):
            system.begin_step(before, factor)
            off, _ = system.out_of_balance()
            force = float(np.sqrt(system.points.global_sum(float(np.vdot(off, off)))[0]))
            if iteration > 0 and self._balanced(force, last):
                if not self._stands(factor):
                    break
                system.evaluate_at_start()
                system.moving_energy_before = anchored
                return Attempt(True, iteration, 0, force)
            way = self._way(off, factor) if np.isfinite(force) else None
            if way is None or force > GIVEN_UP * last:
                break
            last = force
            self._go_to(system.x[:n] + way)
        system.state.set(x, np.zeros_like(x))
        system.active.carry_frames(system.x, frozen)
        return None

    def _go_to(self, x: Array) -> None:
        self._system.state.set(x, np.zeros_like(x))
        self._system.active.carry_frames(self._system.x)

    def _stands(self, factor: float) -> bool:
        """Whether the equilibrium is stable, or has no potential that would tell; collective."""
        with self._examine() as examination:
            found = examination.stability
            return found.stable is not False or self.holds(found, examination.mode(), factor)

    def holds(self, found: Stability, mode: Array | None, factor: float) -> bool:
        """Whether the skew part of the stiffness holds what the symmetric part S lets go by ``mode`` u.

        With one negative eigenvalue of S the determinant of all of the stiffness K has the sign of uᵀK⁻¹u, as
        the rest of S, and so of K, is positive definite; collective.
        """
        if mode is None or found.negative != 1 or self._system.active.viscous:
            return False
        way = self._way(mode, factor)
        return way is not None and self._system.points.global_sum(float(np.vdot(mode, way)))[0] > 0.0

    def _way(self, force: Array, factor: float) -> Array | None:
        """The displacement (n_owned, 3) [m] to which a force (n_owned, 3) [N] leads by the exact Hessian and
        the skew part; collective.
        """
        with self._examine() as examination:
            return self._newton_way(force, self.linearised(factor, factor), examination.solve)

    def tangent(self, force: Array, loads: FollowingLoads) -> tuple[Array | None, int]:
        """As `Stepper.tangent`, with all of the stiffness of ``loads``; collective."""
        linear = 0

        def solve(force: Array) -> Array | None:
            nonlocal linear
            way, spent = self._tangent(force)
            linear += spent
            return way

        return self._newton_way(force, loads, solve), linear

    def _newton_way(self, force: Array, loads: FollowingLoads, solve: Solve) -> Array | None:
        return newton_way(force, solve, lambda way: self.skew_force(loads, way), self._system.points.comm)

    def linearised(self, before: float, factor: float) -> FollowingLoads:
        """The pressures, linear in the displacement from the present shape."""

        def force_of(load: Load, x: Array, out: Array) -> None:
            load.add_force(x, before, factor, out)

        return FollowingLoads(self._system.active.following, self._system.x, force_of, factor)

    def skew_force(self, loads: FollowingLoads, way: Array) -> Array:
        """Force (n_owned, 3) [N] on free unknowns by the skew part on a displacement (n_owned, 3) [m];
        collective.
        """
        system = self._system
        local = np.zeros_like(system.x)
        local[: len(way)] = way
        system.points.update_ghosts(local)
        return np.where(system.prescribed.free, loads.skew_force(local, len(way)), 0.0)
