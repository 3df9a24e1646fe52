"""Full Newton steps on trust: accepted although the energy rises, for a while.

A step of a stiff sheet along the tangents of its rotations stretches it by the square of their angles; the
next step takes that back at once. A line search that insists on less energy in every step forbids it and
creeps. So full steps are taken until the energy has neither fallen below its best nor come halfway down to
it for ``PATIENCE`` iterations; then the solve goes back to the best iterate and searches along lines for some
iterations.

Source: Chamberlain, Powell, Lemarechal & Pedersen, Math. Prog. Study 16 (1982) 1-17 (watchdog technique
against the Maratos effect).
"""

from __future__ import annotations

import math

from petsc4py import PETSc

PATIENCE = 5
"""Iterations without less energy than ever before after which trust is lost."""

HALVED = 0.5
"""Of the energy above the best, what is left by then counts as progress."""

PENALTY = 6
"""Iterations with line searches after trust was lost for the first time; doubled each time."""


class Watchdog:
    """Trust in full steps during one nonlinear solve.

    Attributes
    ----------
    best : PETSc.Vec or None
        The iterate of least energy.
    lost : bool
        The next step must lead back to it.
    """

    def __init__(self) -> None:
        self.best: PETSc.Vec | None = None
        self.begin()

    def begin(self) -> None:
        """A new solve."""
        self._energy = math.inf
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
        if not energy > self._energy + noise:
            if energy < self._energy - noise:
                self._left, self._excess = PATIENCE, math.inf
            elif self._left > 1:  # two iterates may take turns
                self._left -= 1
            self._energy = energy
            self._forget()
            self.best = u.copy()
            return
        excess = energy - self._energy
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
