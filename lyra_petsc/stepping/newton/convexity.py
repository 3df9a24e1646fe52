"""The weight of the regularised Hessian in the Jacobian: the least that keeps it positive definite.

With the exact Hessian Newton's method converges in few iterations, but it may be indefinite (compression,
folds). The regularised Hessian never is, but converges slowly. When conjugate gradients meet negative
curvature, the iteration is repeated with a larger weight; the next iteration tries a smaller one. A step that
the line search shortens, as with a nearly singular Hessian, also increases the weight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

FIRST, SMALLEST = 0.05, 1e-3
"""Smallest weight after an increase, and weight below which none is used."""

GROWTH, DECAY = 8.0, 0.5
"""Factors of the weight after negative curvature, and from iteration to iteration."""

CLOSE = 0.85
"""Bisection between a weight too small and one large enough ends if their ratio is above this."""

BOUND_DECAY = 0.3
"""Factor of the weight known to be too small in each iteration, so that smaller ones are tried again."""

SHORTENED = 0.5
"""A step of which the line search takes less than this fraction increases the weight."""


class Convexity:
    """The weight of the regularised Hessian: 0 is exact, 1 regularised.

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
        # weights that were too small and large enough lately: the least admissible one lies between them
        self._too_little, self._enough = 0.0, 1.0
        self._decay = DECAY

    def after(self, taken: float, *, exact: bool = False) -> float:
        """The weight for the next iteration, after the line search took ``taken`` of the last step.

        With ``exact`` it is 0.
        """
        if taken < SHORTENED:
            self.increase()
        elif self._adaptive and exact:
            self._enough, self.value = self.value, 0.0
        elif self._adaptive:
            self._enough = self.value
            smaller = self._decay * self.value
            self._decay *= self._decay
            if smaller <= self._too_little < self.value:
                smaller = self._bisect(self._too_little, self.value)
            self.value = smaller if smaller > SMALLEST else 0.0
            self._too_little *= BOUND_DECAY
        return self.value

    def increase(self) -> bool:
        """Increase the weight after negative curvature; False if it is at its maximum."""
        if not self._adaptive or self.value >= 1.0:
            return False
        self._too_little, self._decay = self.value, DECAY
        larger = max(FIRST, GROWTH * self.value)
        if self.value < self._enough < larger:
            larger = self._bisect(self.value, self._enough)
        self.value = min(1.0, larger)
        return True

    def saved_state(self) -> dict[str, float]:
        """Entries of a checkpoint, for `restore`."""
        return {"convexity": self.value, "too_little": self._too_little, "enough": self._enough}

    def restore(self, saved: Mapping[str, float]) -> None:
        """Restore a `saved_state`."""
        if self._adaptive:
            self.value, self._too_little, self._enough = (
                saved[name] for name in ("convexity", "too_little", "enough")
            )

    @staticmethod
    def _bisect(low: float, high: float) -> float:
        """Geometric mean of two weights, or the upper one where they are close."""
        return math.sqrt(low * high) if 0.0 < low < CLOSE * high else high
