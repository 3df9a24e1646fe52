"""Equilibria under loads that follow the shape by Newton's method, also with an unsymmetric stiffness.

Beside free edges the symmetric part of the stiffness, and with it the potential that solves minimise, may be
indefinite at a stable equilibrium. Newton's method with the whole stiffness finds it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.directors import transport_frames
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.statics.following_loads import FollowingLoads, Solve, newton_displacement
from lyra_petsc.stepping.statics.stability import Examination, Stability
from lyra_petsc.stepping.stepper import Attempt
from lyra_petsc.terms.term import Load, UpcomingStep

MAX_ITERATIONS, MAX_GROWTH = 20, 1e6
"""Limits of Newton's method: iterations, and growth of the force in one of them, by stretching."""


class WholeStiffness:
    """Newton's method with the whole stiffness, that of loads included; collective.

    Parameters
    ----------
    equations : StageEquations
    tangent : callable
        As `Stepper.tangent`.
    examine : callable
        Returns an `Examination` of the present equilibrium.
    balanced : callable
        Whether a force of this norm [N] counts as zero, given the norm one iteration before.
    """

    def __init__(
        self,
        equations: StageEquations,
        tangent: Callable[[Array], tuple[Array | None, int]],
        examine: Callable[[], Examination],
        balanced: Callable[[float, float], bool],
    ) -> None:
        self._equations, self._tangent, self._examine, self._balanced = equations, tangent, examine, balanced

    def find(self, before: float, factor: float, guess: Array) -> Attempt | None:
        """Find the equilibrium at load factor ``factor`` from a guess of its positions (n_owned, 3) [m].

        Returns None, with the state restored, if Newton's method fails or the equilibrium is unstable.
        """
        equations, n = self._equations, self._equations.points.n_owned
        if equations.active.viscous or equations.active.limiting or equations.contact is not None:
            return None
        x = equations.x[:n].copy()
        equations.begin_step(before, factor)
        frozen, last = equations.step.frozen, np.inf
        held = equations.step.prescribed
        held.overwrite(guess, held.goal)
        self._set_positions(guess)
        for iteration in range(MAX_ITERATIONS):
            equations.begin_step(before, factor)
            unbalanced = equations.out_of_balance()
            force = float(np.sqrt(equations.points.global_sum(float(np.vdot(unbalanced, unbalanced)))[0]))
            if iteration > 0 and self._balanced(force, last):
                if not self._is_stable(factor):
                    break
                equations.evaluate(equations.stationary_velocity())
                return Attempt(True, iteration, 0, force)
            displacement = self._displacement_by_force(unbalanced, factor) if np.isfinite(force) else None
            if displacement is None or force > MAX_GROWTH * last:
                break
            last = force
            self._set_positions(equations.x[:n] + displacement)
        equations.state.set(x, np.zeros_like(x))
        transport_frames(equations, frozen)
        return None

    def _set_positions(self, x: Array) -> None:
        self._equations.state.set(x, np.zeros_like(x))
        transport_frames(self._equations)

    def _is_stable(self, factor: float) -> bool:
        """Whether the equilibrium is stable, or stability is not known; collective."""
        with self._examine() as examination:
            stability = examination.stability
            if stability.stable is not False:
                return True
            return self.skew_part_stabilises(stability, examination.lowest_mode(), factor)

    def skew_part_stabilises(self, stability: Stability, mode: Array | None, factor: float) -> bool:
        """Whether the skew part of the stiffness stabilises the unstable ``mode`` u of the symmetric part S.

        With one negative eigenvalue of S the determinant of all of the stiffness K has the sign of uᵀK⁻¹u, as
        the rest of S, and so of K, is positive definite; collective.
        """
        if mode is None or stability.negative != 1 or self._equations.active.viscous:
            return False
        response = self._displacement_by_force(mode, factor)
        if response is None:
            return False
        return bool(self._equations.points.global_sum(float(np.vdot(mode, response)))[0] > 0.0)

    def _displacement_by_force(self, force: Array, factor: float) -> Array | None:
        """Displacement (n_owned, 3) [m] for a force (n_owned, 3) [N] by the whole stiffness; collective."""
        with self._examine() as examination:
            return self._newton_displacement(force, self.linearise_loads(factor, factor), examination.solve)

    def tangent(self, force: Array, loads: FollowingLoads) -> tuple[Array | None, int]:
        """As `Stepper.tangent`, with the whole stiffness of ``loads``; collective."""
        linear = 0

        def solve(force: Array) -> Array | None:
            nonlocal linear
            u, iterations = self._tangent(force)
            linear += iterations
            return u

        return self._newton_displacement(force, loads, solve), linear

    def _newton_displacement(self, force: Array, loads: FollowingLoads, solve: Solve) -> Array | None:
        comm = self._equations.points.comm
        return newton_displacement(force, solve, lambda u: self.skew_force(loads, u), comm)

    def linearise_loads(self, before: float, factor: float) -> FollowingLoads:
        """The loads that follow the shape, linear in the displacement from it."""

        def force_of(load: Load, x: Array, out: Array) -> None:
            step = UpcomingStep(before, factor, factor, x, self._equations.reference.at)
            load.add_force_on_vertices(step, out)

        return FollowingLoads(self._equations.active.following, self._equations.x, force_of)

    def skew_force(self, loads: FollowingLoads, u: Array) -> Array:
        """Force (n_owned, 3) [N] of the skew part on free unknowns for a displacement (n_owned, 3) [m];
        collective.
        """
        equations = self._equations
        local = np.zeros_like(equations.x)
        local[: len(u)] = u
        equations.points.update_ghosts(local)
        return np.where(equations.step.prescribed.free, loads.skew_force(local, len(u)), 0.0)
