"""How much of the Hessian is regularised: as little as keeps it positive definite.

The exact Hessian converges in few iterations but may be indefinite (compression, folds); the
regularised one never is, but converges slowly. Conjugate gradients tell: when they meet negative
curvature, the iteration is repeated with more regularisation; the next one tries less. A nearly
singular Hessian shows in the line search: a step that had to be cut asks for more as well.
"""

from __future__ import annotations

FIRST = 0.05
RAISE = 4.0
LOWER = 0.25
SMALLEST = 1e-3
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

    def after(self, taken: float) -> float:
        """The fraction for the next iteration, when the line search took ``taken`` of the last step."""
        if taken < CUT:
            self.raise_()
        elif self._adaptive:
            lowered = LOWER * self.value
            self.value = lowered if lowered > SMALLEST else 0.0
        return self.value

    def raise_(self) -> bool:
        """Take more, after negative curvature was met; False if there is no more."""
        if not self._adaptive or self.value >= 1.0:
            return False
        self.value = min(1.0, max(FIRST, RAISE * self.value))
        return True
