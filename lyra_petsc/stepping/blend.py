"""How much of the Hessian is regularised: as little as keeps it positive definite.

The exact Hessian converges in few iterations but may be indefinite (compression, folds); the
regularised one never is, but converges slowly. Conjugate gradients tell: when they meet negative
curvature, the iteration is repeated with more regularisation; the next one tries less. A nearly
singular Hessian shows in the line search: a step that had to be cut asks for more as well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

FIRST = 0.05
RAISE = 8.0
LOWER = 0.5
SMALLEST = 1e-3
CLOSE = 0.85
"""Fraction of one that was enough up to which less is tried."""

FORGET = 0.3
"""By how much what was too little falls in an iteration, so that less is tried again."""

CUT = 0.5
"""Fraction of a step taken by the line search below which the Hessian was too soft."""


class Blend:
    """The fraction of regularisation in use: 0 exact, 1 regularised.

    Parameters
    ----------
    mode : str
        ``exact`` and ``regularised`` stay at 0 and 1; ``adaptive`` moves between them.

    Attributes
    ----------
    value : float
    """

    def __init__(self, mode: str) -> None:
        self._adaptive = mode == "adaptive"
        self.value = 1.0 if mode == "regularised" else 0.0
        # what was too little lately, and what was enough: the least lies between them
        self._too_little, self._enough = 0.0, 1.0
        self._lower = LOWER

    def after(self, taken: float, *, exact: bool = False) -> float:
        """The fraction for the next iteration, when the line search took ``taken`` of the last step; with
        ``exact`` none is tried first.
        """
        if taken < CUT:
            self.raise_()
        elif self._adaptive and exact:
            self._enough, self.value = self.value, 0.0
        elif self._adaptive:
            self._enough = self.value
            lowered = self._lower * self.value
            self._lower *= self._lower
            if lowered <= self._too_little < self.value:
                lowered = self._between(self._too_little, self.value)
            self.value = lowered if lowered > SMALLEST else 0.0
            self._too_little *= FORGET
        return self.value

    def raise_(self) -> bool:
        """Take more, after negative curvature was met; False if there is no more."""
        if not self._adaptive or self.value >= 1.0:
            return False
        self._too_little, self._lower = self.value, LOWER
        raised = max(FIRST, RAISE * self.value)
        if self.value < self._enough < raised:
            raised = self._between(self.value, self._enough)
        self.value = min(1.0, raised)
        return True

    def memory(self) -> dict[str, float]:
        """What a checkpoint must hold to go on alike."""
        return {"blend": self.value, "too_little": self._too_little, "enough": self._enough}

    def restore(self, memory: Mapping[str, float]) -> None:
        """Go on with a memory; an older one has but the value."""
        if not self._adaptive:
            return
        self.value = float(memory.get("blend", self.value))
        self._too_little = float(memory.get("too_little", self._too_little))
        self._enough = float(memory.get("enough", self._enough))

    @staticmethod
    def _between(low: float, high: float) -> float:
        """A fraction between two, in the middle of their logarithms; the upper one where they are close."""
        return math.sqrt(low * high) if 0.0 < low < CLOSE * high else high
