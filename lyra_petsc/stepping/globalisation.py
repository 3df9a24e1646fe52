"""What makes Newton's method converge from afar: line searches on the energy, and full steps on trust."""

from __future__ import annotations

import math

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.convergence import Convergence
from lyra_petsc.stepping.stage_equations import StageEquations

PATIENCE = 5
"""Iterations without less energy than ever before after which trust is lost."""

HALVED = 0.5
"""Of the energy above the best, what is left by then counts as progress."""

PENALTY = 6
"""Iterations with line searches after trust was lost for the first time; doubled each time."""


class Watchdog:
    """Full Newton steps on trust during one nonlinear solve: accepted although the energy rises, for a while.

    A step of a stiff sheet along the tangents of its rotations stretches it by the square of their angles;
    the next step takes that back at once. A line search that insists on less energy in every step forbids it
    and creeps. So full steps are taken until the energy has neither fallen below its best nor come halfway
    down to it for ``PATIENCE`` iterations; then the solve goes back to the best iterate and searches along
    lines for some iterations.

    Source: Chamberlain, Powell, Lemarechal & Pedersen, Math. Prog. Study 16 (1982) 1-17 (watchdog technique
    against the Maratos effect).

    Attributes
    ----------
    best : PETSc.Vec or None
        The iterate of least energy.
    energy : float
        That energy [W].
    lost : bool
        The next step must lead back to it.
    """

    def __init__(self) -> None:
        self.best: PETSc.Vec | None = None
        self.begin()

    def begin(self) -> None:
        """A new solve."""
        self.energy = math.inf
        self._excess = math.inf
        self._left = PATIENCE
        self._searches, self._penalty = 0, PENALTY
        self.lost = False
        self._forget()

    @property
    def trusts(self) -> bool:
        """Whether a full step is taken without a look at its energy."""
        return self._searches == 0

    def see(self, u: PETSc.Vec, energy: float, noise: float) -> None:
        """Note iterate u of this energy, known to ``noise``; collective."""
        if self._searches > 0:
            self._searches -= 1
        if not energy > self.energy + noise:
            if energy < self.energy - noise:
                self._left, self._excess = PATIENCE, math.inf
            elif self._left > 1:  # two iterates may take turns
                self._left -= 1
            self.energy = energy
            self._forget()
            self.best = u.copy()
            return
        excess = energy - self.energy
        self._left -= 1
        if excess < HALVED * self._excess:
            self._excess = excess
            self._left = PATIENCE
        if self._left <= 0:
            self.lost = True

    def go_back(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Make the step y (x − y is next) lead to the best iterate, and search from there; collective."""
        x.copy(y)
        y.axpy(-1.0, self.best)
        self.lost = False
        self._excess = math.inf
        self._left = PATIENCE
        # one more, as the best iterate is seen again first
        self._searches, self._penalty = self._penalty + 1, 2 * self._penalty

    def _forget(self) -> None:
        if self.best is not None:
            self.best.destroy()
            self.best = None


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
        self._first = -math.inf
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
        kinks = self._equations.has_active_pairs and self._equations.integrator.dynamic
        self._near = kinks and not self._convergence.balanced
        energy, size = self._at
        if self._snes.getIterationNumber() == 0:
            self._first = energy
        self._watchdog.see(u, energy, ENERGY_ROUNDOFF * size)

    def lowest(self) -> Array | None:
        """The iterate (n_owned, 3) [m/s] of least energy since frames last followed, if that is less than the
        first one's.
        """
        best = self._watchdog.best
        if best is None or not self._watchdog.energy < self._first:
            return None
        found: Array = best.getArray(readonly=True).reshape(self._shape).copy()
        return found

    def go_back(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Let the step y lead back to the best iterate if full steps have led nowhere; whether it does."""
        self._returns = self._watchdog.lost
        if self._returns:
            self._watchdog.go_back(x, y)
            self._equations.set_iterate(None)
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
        (square,) = equations.points.global_sum(float(np.vdot(trial, trial)))
        smaller = bool(np.sqrt(square) < self._at_norm)
        return here - noise if smaller else here + noise
