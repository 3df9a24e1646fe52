"""Globalisation of Newton's method: full steps under a watchdog, else line searches on the energy."""

from __future__ import annotations

import math

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.points import Layout
from lyra_petsc.stepping.newton.convergence import Convergence
from lyra_petsc.stepping.newton.iterates import Iterates

PATIENCE = 5
"""Number of iterations without a new lowest energy after which full steps end."""

PROGRESS = 0.5
"""Reduction of the energy above the lowest one to this fraction counts as progress."""

PENALTY = 6
"""Number of iterations with line searches after the first return; doubled at each return."""


class Watchdog:
    """Accepts full Newton steps although the energy rises, for a number of iterations.

    A linear step that rotates a stiff sheet stretches it by the square of the angles; the next step removes
    the stretch at once. A line search that demands less energy in every step would reject such steps and
    progress slowly. So full steps are taken until for ``PATIENCE`` iterations the energy has neither fallen
    below its lowest value nor halved its distance to it. The solve then returns to the best iterate and uses
    line searches for some iterations.

    Source: Chamberlain, Powell, Lemarechal & Pedersen, Math. Prog. Study 16 (1982) 1-17 (watchdog technique
    against the Maratos effect).

    Attributes
    ----------
    best : PETSc.Vec or None
        The iterate with the lowest objective.
    energy : float
        Objective [W] at the best iterate.
    must_return : bool
        Whether the next step must return to the best iterate.
    """

    def __init__(self) -> None:
        self.best: PETSc.Vec | None = None
        self.begin_solve()

    def begin_solve(self) -> None:
        """A new solve."""
        self.energy = math.inf
        self._excess = math.inf
        self._patience = PATIENCE
        self._line_searches, self._penalty = 0, PENALTY
        self.must_return = False
        self._discard_best()

    @property
    def takes_full_steps(self) -> bool:
        """Whether the next step is taken in full, whatever its energy."""
        return self._line_searches == 0

    def note_iterate(self, u: PETSc.Vec, energy: float, noise: float) -> None:
        """Note iterate u and its energy, which has the round-off ``noise`` (both [W]); collective."""
        if self._line_searches > 0:
            self._line_searches -= 1
        if not energy > self.energy + noise:
            if energy < self.energy - noise:
                self._patience, self._excess = PATIENCE, math.inf
            elif self._patience > 1:  # else two iterates could alternate without end
                self._patience -= 1
            self.energy = energy
            self._discard_best()
            self.best = u.copy()
            return
        excess = energy - self.energy
        self._patience -= 1
        if excess < PROGRESS * self._excess:
            self._excess = excess
            self._patience = PATIENCE
        if self._patience <= 0:
            self.must_return = True

    def return_to_best(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Make the step y (x − y is next) return to the best iterate, and search lines there; collective."""
        x.copy(y)
        y.axpy(-1.0, self.best)
        self.must_return = False
        self._excess = math.inf
        self._patience = PATIENCE
        # one more, because the best iterate is noted again first
        self._line_searches, self._penalty = self._penalty + 1, 2 * self._penalty

    def _discard_best(self) -> None:
        if self.best is not None:
            self.best.destroy()
            self.best = None


def descends(residual: PETSc.Vec, increment: Array, points: Layout) -> bool:
    """Whether an increment (n_owned, 3) [m/s] of Newton's iterate reduces the objective to first order;
    collective.
    """
    slope = float(np.vdot(residual.getArray(readonly=True), increment))
    return bool(points.global_sum(slope)[0] < 0.0)


ENERGY_ROUNDOFF = 1e-14
"""Differences of the objective below this fraction of its summands are noise."""


class Globalisation:
    """Judges the trial points of one SNES by the objective.

    Parameters
    ----------
    snes : PETSc.SNES
    iterates : Iterates
    convergence : Convergence
    """

    def __init__(self, snes: PETSc.SNES, iterates: Iterates, convergence: Convergence) -> None:
        self._snes, self._iterates, self._convergence = snes, iterates, convergence
        self._watchdog = Watchdog()
        self._first_energy = -math.inf
        self.begin_solve()

    def begin_solve(self) -> None:
        """A new solve."""
        self._energy, self._norm = (0.0, 0.0), 0.0
        self._slope, self._returns, self._near_kinks = 0.0, False, False
        self._watchdog.begin_solve()

    def note_iterate(self, u: PETSc.Vec, *, kinks: bool) -> None:
        """Note energy and residual of iterate u, with which trial points are compared; collective.

        ``kinks``: contact acts in a motion. In statics, where steps are long, line searches would progress
        slowly.
        """
        self._energy = self._iterates.at(u).objective
        self._norm = self._snes.getFunctionNorm()
        # near equilibrium energy differences are round-off
        self._near_kinks = kinks and not self._convergence.balanced
        energy, size = self._energy
        if self._snes.getIterationNumber() == 0:
            self._first_energy = energy
        self._watchdog.note_iterate(u, energy, ENERGY_ROUNDOFF * size)

    def lowest_iterate(self) -> Array | None:
        """The iterate (n_owned, 3) [m/s] of least energy since the last `begin_solve`.

        None unless its energy is less than that of the first iterate.
        """
        best = self._watchdog.best
        if best is None or not self._watchdog.energy < self._first_energy:
            return None
        iterate: Array = best.getArray(readonly=True).reshape(-1, 3).copy()
        return iterate

    def return_to_best(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Make the step y return to the best iterate if full steps have failed; whether it does."""
        self._returns = self._watchdog.must_return
        if self._returns:
            self._watchdog.return_to_best(x, y)
        return self._returns

    @property
    def takes_full_steps(self) -> bool:
        """Whether the next step is taken in full; not across the kinks of contact forces."""
        return self._watchdog.takes_full_steps and not self._near_kinks

    def set_slope(self, slope: float) -> None:
        """Set the decrease [W] of the energy along the next direction, to first order."""
        self._slope = slope

    def objective(self, snes: PETSc.SNES, u: PETSc.Vec) -> float:
        """Energy [W] of a trial point, for ``SNES.setObjective``.

        Where energies differ by round-off only, the returned value depends on the residual. Full steps get a
        value that every line search accepts.
        """
        at = self._iterates.at(u)
        value, size = at.objective
        here, own_size = self._energy
        if value != here and np.isfinite(value) and (self._returns or self.takes_full_steps):
            return min(value, here - self._slope)
        noise = ENERGY_ROUNDOFF * max(size, own_size)
        if value == here or not abs(value - here) < noise:
            return value
        v = u.getArray(readonly=True).reshape(-1, 3)
        at.forces.residual(v, at, trial := np.empty_like(v))
        (square,) = at.forces.layout.global_sum(float(np.vdot(trial, trial)))
        smaller = bool(np.sqrt(square) < self._norm)
        return here - noise if smaller else here + noise
