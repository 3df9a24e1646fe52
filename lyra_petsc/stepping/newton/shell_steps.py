"""Newton steps of equilibria of shells that are taken in full: along arcs, and corrected."""

from __future__ import annotations

import itertools

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.stepping import motion_limits as limits
from lyra_petsc.stepping.integrators.static import Static
from lyra_petsc.stepping.newton.arcs import Arcs, can_factor
from lyra_petsc.stepping.newton.convergence import HALVED, Convergence
from lyra_petsc.stepping.newton.globalisation import descends
from lyra_petsc.stepping.stage_equations import StageEquations

MAX_CORRECTIONS = 8
"""Largest number of corrections of one step."""

MIN_OVERLAP, MAX_OVERLAP = -1.0, 0.5
"""Range of the correction's projection on the last step, over that step, in which Broyden's update acts."""


class ShellSteps:
    """Changes steps of one SNES; all methods are collective.

    Parameters
    ----------
    snes : PETSc.SNES
    equations : StageEquations
    convergence : Convergence

    Attributes
    ----------
    iterations : int
        Linear iterations of all corrections.
    """

    def __init__(self, snes: PETSc.SNES, equations: StageEquations, convergence: Convergence) -> None:
        self._snes, self._ksp = snes, snes.getKSP()
        self._equations, self._convergence = equations, convergence
        self._arcs = Arcs(equations) if can_factor(equations.points.comm.size) else None
        self.iterations = 0

    def correct(self, v: Array, y: PETSc.Vec, *, exact: bool) -> bool:
        """Add corrections, solved with the same factors, to a step y from v (n_owned, 3) that is taken in
        full.

        Each is solved for the residual at the end of the step, as long as it reduces that residual notably.
        With ``exact``, where y is the unmodified Newton step, several are tried, else one. Returns whether y
        changed. The first removes the stretch of a linear step (Traub, Iterative Methods for the Solution of
        Equations, 1964, chapter 8: of third order), the others are steps of Broyden's method.
        """
        convergence, increment = self._convergence, -_array(y)
        first = v + increment
        size, force = self._residual(first)
        if size == 0.0:
            return False
        right, correction, steps = y.duplicate(), y.duplicate(), [y.copy()]
        corrected = False
        for _ in range(MAX_CORRECTIONS if exact else 1):
            right.setArray(force.ravel())
            self._ksp.solve(right, correction)
            self.iterations += self._ksp.getIterationNumber()
            if exact:
                _apply_broyden(correction, steps)
            before, increment = size, -_array(y) - _array(correction)
            if not limits.moves_freely(self._equations, v, increment):
                break
            size, force = self._residual(v + increment)
            if not size < HALVED * before:
                break
            corrected = True
            y.axpy(1.0, correction)
            if exact and convergence.correction_suffices(_max_norm(correction), _max_norm(steps[-1]), size):
                break
            steps.append(correction.copy())
        if corrected:
            self._equations.predicted_stress.take_uncorrected(self._equations.evaluate(first).x)
        for vector in (right, correction, *steps):
            vector.destroy()
        return corrected

    def _residual(self, v: Array) -> tuple[float, Array]:
        """F (n_owned, 3) [N] at velocities v and its norm."""
        force = self._equations.residual_at(v)
        (square,) = self._equations.points.global_sum(float(np.vdot(force, force)))
        return float(np.sqrt(square)), force

    def curve(self, v: Array, residual: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Replace a step y from v (n_owned, 3) by one along arcs if it descends and hits nothing.

        Returns whether y changed.
        """
        if self._arcs is None or not self._arcs.turns_notably(-_array(y)):
            return False
        equations, (curved, increment) = self._equations, self._arcs.curve(v, -_array(y))
        if not descends(residual, curved, equations.points) or not limits.moves_freely(equations, v, curved):
            return False
        y.setArray(-curved.ravel())
        equations.predicted_stress.take_uncorrected(equations.evaluate(v + increment).x)
        return True

    def curve_guess(self, v: Array, start: Array, guess: Array) -> None:
        """Change a first guess (n_owned, 3) [m/s] far from v to one along arcs that moves freely from
        ``start``.

        Of all expected increments it takes the one whose end has the least energy.
        """
        integrator = self._equations.integrator
        if self._arcs is None or not isinstance(integrator, Static):
            return
        others = [displacement / integrator.pseudo_dt for displacement in integrator.alternatives]
        lowest = np.inf
        for increment in (guess - v, *others):
            end = v + self._arcs.curve(v, increment, strains=False)[0]
            self._equations.prescribe(end)
            if not limits.moves_freely(self._equations, start, end - start):
                continue
            energy = self._equations.evaluate(end).objective[0] if others else 0.0
            if energy < lowest:
                lowest, guess[:] = energy, end

    def tangent(self, force: Array, c: float) -> tuple[Array | None, int]:
        """See `NewtonCallbacks.tangent`; c [s] is that of the stage whose Jacobian was factored last."""
        if self._arcs is None:
            return None, 0
        b, v = self._snes.getSolution().duplicate(), self._snes.getSolution().duplicate()
        b.setArray(force.ravel())
        self._ksp.solve(b, v)
        displacement = c * _array(v) if self._ksp.getConvergedReason() > 0 else None
        b.destroy()
        v.destroy()
        return displacement, int(self._ksp.getIterationNumber())

    def destroy(self) -> None:
        """Free the factors."""
        if self._arcs is not None:
            self._arcs.destroy()


def _array(vector: PETSc.Vec) -> Array:
    values: Array = vector.getArray(readonly=True).reshape(-1, 3)
    return values


def _max_norm(vector: PETSc.Vec) -> float:
    return float(vector.norm(PETSc.NormType.INFINITY))


def _apply_broyden(correction: PETSc.Vec, steps: list[PETSc.Vec]) -> None:
    """Change a correction solved with the matrix of the first step to that of Broyden's matrix.

    ``steps`` are the Newton step and the corrections before this one.
    (Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 2.1.4, algorithm QNERR.)
    """
    for step, following in itertools.pairwise(steps):
        correction.axpy(step.dot(correction) / step.dot(step), following)
    repeated = steps[-1].dot(correction) / steps[-1].dot(steps[-1])
    if MIN_OVERLAP < repeated < MAX_OVERLAP:
        correction.scale(1.0 / (1.0 - repeated))
