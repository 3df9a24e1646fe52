"""On which side of a plane through three points a fourth one lies: exact for floating-point coordinates.

Shewchuk, Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates, Discrete &
Computational Geometry 18 (1997) 305-363: a determinant in floating point with a bound of its error, and
where that does not decide, the determinant as an expansion, an unevaluated sum of numbers without overlap.
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import numpy as np

from lyra_petsc.kernels.cache import cached

UNDECIDED = 2
"""Where products of the coordinates overflow or underflow, so that expansions are not exact."""

_HALF_ULP = 2.0**-53
_RELATIVE = (7.0 + 56.0 * _HALF_ULP) * _HALF_ULP
"""Bound of the determinant's error over the sum of its terms' magnitudes (Shewchuk 1997, figure 21)."""

_UNDERFLOW = 1e-290
"""Far above what underflow adds to the error of a term whose other factor is at most 1."""

_LEAST, _MOST = 2.0**-300, 2.0**300
"""Between them, products of three numbers and the rounding errors of these are exact."""

_SPLITTER = 2.0**27 + 1.0
_PARTS = 6 * 2**3 * 4
"""Most numbers in the expansion: six products of three differences of two parts, each of four numbers."""


@cached()
def side(points: Any, a: int, b: int, c: int, d: int) -> int:
    """Sign of (b − a) × (c − a) · (d − a): 1 where d is where the normal of the triangle a, b, c points.

    Parameters
    ----------
    points : (V, 3) float64
        Finite [m].
    a, b, c, d : int
        Rows of ``points``.

    Returns
    -------
    int
        1, −1, 0 for points in one plane, or `UNDECIDED`; `rational_side` decides then.
    """
    if a in (b, c, d) or b in (c, d) or c == d:
        return 0
    bx, by, bz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    cx, cy, cz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    dx, dy, dz = points[d, 0] - points[a, 0], points[d, 1] - points[a, 1], points[d, 2] - points[a, 2]
    # a plane of constant x, y or z, which flat sheets are
    if bx == cx == dx == 0.0 or by == cy == dy == 0.0 or bz == cz == dz == 0.0:
        return 0
    determinant = dx * (by * cz - bz * cy) + dy * (bz * cx - bx * cz) + dz * (bx * cy - by * cx)
    size = (
        abs(dx) * (abs(by * cz) + abs(bz * cy))
        + abs(dy) * (abs(bz * cx) + abs(bx * cz))
        + abs(dz) * (abs(bx * cy) + abs(by * cx))
    )
    error = _RELATIVE * size + _UNDERFLOW * (1.0 + abs(dx) + abs(dy) + abs(dz))
    if determinant > error:
        return 1
    if determinant < -error:
        return -1
    return int(_exact_side(points, a, b, c, d))


@cached()
def _exact_side(points: Any, a: int, b: int, c: int, d: int) -> int:
    """`side` by expansions."""
    parts = np.empty((3, 3, 2))
    for row, vertex in enumerate((b, c, d)):
        for axis in range(3):
            high, low = _sum(points[vertex, axis], -points[a, axis])
            parts[row, axis, 0], parts[row, axis, 1] = high, low
            for part in (abs(high), abs(low)):
                if part != 0.0 and not _LEAST < part < _MOST:
                    return UNDECIDED
    expansion, size = np.empty(_PARTS), 0
    for x in range(3):
        for turn in (1, 2):
            y, z = (x + turn) % 3, (x + 2 * turn) % 3
            for choice in range(8):
                first = parts[0, x, choice & 1]
                second = parts[1, y, choice >> 1 & 1]
                third = parts[2, z, choice >> 2]
                if first == 0.0 or second == 0.0 or third == 0.0:
                    continue
                for half in _product(first, second):
                    for part in _product(half, third):
                        size = _add(expansion, size, part if turn == 1 else -part)
    # the parts ascend, and none overlaps the next: the last one is larger than the sum of the others
    return int(np.sign(expansion[size - 1])) if size else 0


@cached()
def _sum(a: float, b: float) -> tuple[float, float]:
    """a + b rounded, and the rounding error (Knuth's two-sum)."""
    total = a + b
    virtual = total - a
    return total, (a - (total - virtual)) + (b - virtual)


@cached()
def _product(a: float, b: float) -> tuple[float, float]:
    """a b rounded, and the rounding error (Dekker's product with Veltkamp's splitting)."""
    total = a * b
    scaled = _SPLITTER * a
    a_high = scaled - (scaled - a)
    scaled = _SPLITTER * b
    b_high = scaled - (scaled - b)
    a_low, b_low = a - a_high, b - b_high
    return total, a_low * b_low - (((total - a_high * b_high) - a_low * b_high) - a_high * b_low)


@cached()
def _add(expansion: Any, size: int, number: float) -> int:
    """Add a number to the expansion in the first ``size`` entries, in place; its new size without zeros."""
    kept = 0
    for i in range(size):
        number, error = _sum(number, expansion[i])
        if error != 0.0:
            expansion[kept] = error
            kept += 1
    if number != 0.0:
        expansion[kept] = number
        kept += 1
    return kept


def rational_side(points: Mapping[int, tuple[Fraction, ...]], a: int, b: int, c: int, d: int) -> int:
    """`side` in rational numbers: slow, and exact for any coordinates."""
    (bx, by, bz), (cx, cy, cz), (dx, dy, dz) = (
        [one - other for one, other in zip(points[vertex], points[a], strict=True)] for vertex in (b, c, d)
    )
    determinant = dx * (by * cz - bz * cy) + dy * (bz * cx - bx * cz) + dz * (bx * cy - by * cx)
    return (determinant > 0) - (determinant < 0)
