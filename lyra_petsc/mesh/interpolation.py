"""Cubic interpolation between values at successive times, of keyframes and of frames from files."""

from __future__ import annotations

from typing import Any

import numpy as np


def hermite(s: float, h: float, p: Any, q: Any, m: Any, n: Any) -> tuple[Any, Any]:
    """Value and rate at the part s of an interval of length h, of the cubic polynomial with values p, q and
    rates m, n at its ends.
    """
    value = (1 + 2 * s) * (1 - s) ** 2 * p + s * s * (3 - 2 * s) * q
    value = value + h * s * (1 - s) * ((1 - s) * m - s * n)
    rate = 6 * s * (1 - s) / h * (q - p) + (1 - s) * (1 - 3 * s) * m + s * (3 * s - 2) * n
    return value, rate


def without_overshoot(rate: Any, before: Any, after: Any) -> Any:
    """The rate at a keyframe between intervals with mean rates ``before`` and ``after``, limited such that
    values on both intervals stay between those of the keyframes (F. N. Fritsch, R. E. Carlson, SIAM J. Numer.
    Anal. 17 (1980) 238-246).
    """
    largest = 3.0 * np.minimum(np.abs(before), np.abs(after))
    return np.where(np.sign(before) == np.sign(after), np.clip(rate, -largest, largest), 0.0)
