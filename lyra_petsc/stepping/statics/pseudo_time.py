"""Pseudo time steps Δτ of the proximal steps of static load steps.

The first Δτ lets the fastest vertex move by an edge. Δτ grows while Newton's method converges in few
iterations. A leap is a solve with a Δτ that is longer by far: most load steps need one or two.
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.stepping.integrators.static import Static

EASY, FAIR = 6, 15
"""Newton iterations up to which Δτ grows fast, and up to which it grows."""

GROW_FAST, GROW, SHRINK = 10.0, 3.0, 0.2
"""Factors of Δτ."""

LEAP, LEAP_ITERATIONS = 1e3, 30
"""A leap is a solve with Δτ larger by this factor, or with the last Δτ of the load step before. It is given
up after so many iterations, and no further leaps are tried."""

BELOW_CEILING, CEILING_GROWTH = 0.5, 2.0
"""With contact Δτ stays below this fraction of a ceiling, the Δτ of the last failed solve. The ceiling grows
by the second factor in each solve: while sheets fall before they come to rest, longer Δτ fail repeatedly."""

MAX_GROWTH = 1e7
"""Largest Δτ over the first one: beyond it the last term is below round-off."""

UNLIMITED = float(np.finfo(np.float64).max)
"""A number larger than any Δτ."""


class PseudoTimeStep:
    """Δτ of the next proximal step, which it sets in the integrator.

    Parameters
    ----------
    integrator : Static
    spacing : float
        Mean edge length [m].
    leaps : bool
        Whether leaps are tried.
    contact : bool
        Whether contact may limit motions.
    factors : bool
        Whether linear systems are solved with factors: then the first solve may take any Δτ.

    Attributes
    ----------
    sufficed : float
        Δτ [s] of the last solve of the last load step; 0 if that failed.
    """

    def __init__(
        self, integrator: Static, spacing: float, *, leaps: bool, contact: bool, factors: bool
    ) -> None:
        self._integrator, self._spacing = integrator, spacing
        self._leaps, self._contact = leaps, contact
        self.sufficed = UNLIMITED if factors else 0.0
        self._first, self._safe, self._longest = 1.0, 1.0, MAX_GROWTH
        self.begin_load_step()

    def begin_load_step(self) -> None:
        """Begin a load step, in which no Δτ has failed."""
        self._ceiling, self._leaping = np.inf, self._leaps

    def start(self, fastest: float) -> None:
        """Set Δτ for the first solve of a load step, with the largest acceleration [m/s²]."""
        self._limit(fastest)
        self._first = self._safe
        if fastest > 0.0:
            sufficed = self.sufficed if self._leaps else 0.0
            self._integrator.pseudo_dt = min(max(self._safe, sufficed), self._longest)

    def restart(self, fastest: float) -> None:
        """Go on after friction was updated: Δτ stays, and leaps are tried again."""
        self._limit(fastest)
        self._leaping = self._leaps

    def _limit(self, fastest: float) -> None:
        if fastest > 0.0:
            self._safe = float(np.sqrt(self._spacing / fastest))
            self._longest = MAX_GROWTH * self._safe

    @property
    def is_leap(self) -> bool:
        """Whether the next solve is a leap."""
        return self._leaping and self._integrator.pseudo_dt > self._safe

    def shrink(self) -> None:
        """Take a shorter Δτ, as the out-of-balance force grew."""
        self._integrator.pseudo_dt *= SHRINK

    def shorten_to_repeat(self) -> bool:
        """Take a shorter Δτ, to repeat a solve, and no leaps; returns False if Δτ is not above the first."""
        used = self._integrator.pseudo_dt
        if used <= self._first:
            return False
        self._integrator.pseudo_dt = self._first if self.is_leap else max(self._first, SHRINK * used)
        self._ceiling, self._safe, self._leaping = used, self._integrator.pseudo_dt, False
        return True

    def record_success(self, iterations: int) -> None:
        """Let Δτ grow after a solve with this number of Newton iterations."""
        used = self._integrator.pseudo_dt
        grown = min(used * growth(iterations), BELOW_CEILING * self._ceiling)
        self._safe = longest = max(grown, used)
        self._ceiling *= CEILING_GROWTH
        longest *= LEAP if self._leaping else 1.0
        self._integrator.pseudo_dt = min(longest, self._longest)

    def record_failed_leap(self, *, first: bool) -> None:
        """Go back to a Δτ that is no leap; ``first`` if no solve of the load step has converged."""
        # Δτ was too long, perhaps too long to set up a preconditioner
        self._leaping = self.sufficed == UNLIMITED and first and not self._contact
        self._integrator.pseudo_dt = self._safe

    def record_failure(self) -> None:
        """Take a shorter Δτ after a solve that failed, and no leaps."""
        if self._contact:
            self._ceiling = self._integrator.pseudo_dt
        self.shrink()
        self._leaping = False


def growth(iterations: int) -> float:
    """Factor of Δτ after a solve with this number of Newton iterations."""
    if iterations <= EASY:
        return GROW_FAST
    return GROW if iterations <= FAIR else 1.0
