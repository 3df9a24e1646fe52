"""What makes Newton's method converge from afar: line searches on the energy, and full steps on trust."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from lyra_petsc.stepping.convergence import Convergence
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.watchdog import Watchdog

ENERGY_ROUNDOFF = 1e-14
"""Differences of the objective below this fraction of its summands are noise."""


class Globalisation:
    """Judges the trial points of one SNES by the objective.

    Parameters
    ----------
    snes : PETSc.SNES
    equations : StageEquations
    convergence : Convergence
    """

    def __init__(self, snes: PETSc.SNES, equations: StageEquations, convergence: Convergence) -> None:
        self._snes, self._equations, self._convergence = snes, equations, convergence
        self._shape = (equations.points.n_owned, 3)
        self._watchdog = Watchdog()
        self.begin()

    def begin(self) -> None:
        """A new solve."""
        self._at, self._at_norm = (0.0, 0.0), 0.0
        self._slope, self._returns, self._near = 0.0, False, False
        self._watchdog.begin()

    def remember(self, u: PETSc.Vec) -> None:
        """Note energy and residual of the present iterate, against which trial points are judged."""
        self._at = self._equations.objective(u.getArray(readonly=True).reshape(self._shape))
        self._at_norm = self._snes.getFunctionNorm()
        # where forces are in balance differences of energies are round-off, and kinks far away; in statics,
        # where steps are long, searches along tangents would creep
        kinks = self._equations.touches and self._equations.integrator.moves
        self._near = kinks and not self._convergence.balanced
        energy, size = self._at
        self._watchdog.see(u, energy, ENERGY_ROUNDOFF * size)

    def go_back(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Let the step y lead back to the best iterate if full steps have led nowhere; whether it does."""
        self._returns = self._watchdog.lost
        if self._returns:
            self._watchdog.go_back(x, y)
            self._equations.new_iterate(None)
        return self._returns

    @property
    def trusts(self) -> bool:
        """Whether the next step is taken in full; not where contact has kinks, over which full steps jump."""
        return self._watchdog.trusts and not self._near

    def search_along(self, slope: float) -> None:
        """The next trial points lie along a direction in which the energy falls by ``slope`` [W]."""
        self._slope = slope

    def objective(self, snes: PETSc.SNES, u: PETSc.Vec) -> float:
        """Energy of a trial point; where differences drown in round-off, judged by its residual."""
        v = u.getArray(readonly=True).reshape(self._shape)
        value, size = self._equations.objective(v)
        here, here_size = self._at
        if value != here and np.isfinite(value) and (self._returns or self.trusts):
            return min(value, here - self._slope)
        noise = ENERGY_ROUNDOFF * max(size, here_size)
        if value == here or not abs(value - here) < noise:
            return value
        trial = np.empty(self._shape)
        equations = self._equations
        equations.residual(v, equations.stage.sigma * (v - equations.history), trial)
        (square,) = equations.points.summed(float(np.vdot(trial, trial)))
        smaller = bool(np.sqrt(square) < self._at_norm)
        return here - noise if smaller else here + noise
