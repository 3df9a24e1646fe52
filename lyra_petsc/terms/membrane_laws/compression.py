"""What keeps a law of strains from softening under compression: an energy of small principal stretches λ.

    φ(λ) = b ln(λ₀/λ)³ below λ₀ = ¾, else 0

added for both. A quadratic energy of the Green strain softens below λ = 1/√3, as its force λ S vanishes with
λ. φ is convex in E (a convex decreasing function of the eigenvalues of C = I + 2E), has nothing at rest, and
λ₀ lies below what wovens are sheared to.
"""

from __future__ import annotations

import math

from lyra_petsc.kernels.element import kernel

BEGINS = 0.75**2
"""λ₀²."""

LEAST = 0.1**2
"""λ² below which φ goes on as a parabola of λ²: strains that Newton's method expects may be of no shape."""

PART = 0.25
"""b over the largest stiffness at rest."""

ROUND = 1e-6
"""Difference of λ² below which both count as one."""


@kernel(inline="always")
def _barrier(c):  # type: ignore[no-untyped-def]
    """φ/b of c = λ², and its first two derivatives with respect to c."""
    if c >= BEGINS:
        return 0.0, 0.0, 0.0
    at = max(c, LEAST)
    q = 0.5 * math.log(BEGINS / at)
    second = 1.5 * q * (1.0 + q) / (at * at)
    slope, more = -1.5 * q * q / at, c - at
    return q * q * q + (slope + 0.5 * second * more) * more, slope + second * more, second


@kernel(inline="always")
def _stretches(e0, e1, e2):  # type: ignore[no-untyped-def]
    """Mean and half difference of the λ²."""
    return 1.0 + e0 + e1, math.sqrt((e0 - e1) * (e0 - e1) + e2 * e2)


@kernel(inline="always")
def energy(e0, e1, e2, b):  # type: ignore[no-untyped-def]
    """Energy [J] per rest area [m²] of the Green strain (E_uu, E_vv, 2 E_uv); b [N/m]."""
    mean, half = _stretches(e0, e1, e2)
    if mean - half >= BEGINS:
        return 0.0
    return b * (_barrier(mean - half)[0] + _barrier(mean + half)[0])


@kernel(inline="always")
def _slopes(mean, half):  # type: ignore[no-untyped-def]
    """Σ φ', (φ'₂ − φ'₁)/half, Σ φ'' and φ''₂ − φ''₁, over b."""
    _, slope1, second1 = _barrier(mean - half)
    _, slope2, second2 = _barrier(mean + half)
    apart = (slope2 - slope1) / half if half > ROUND else second1 + second2
    return slope1 + slope2, apart, second1 + second2, second2 - second1


@kernel(inline="always")
def stress(e0, e1, e2, b):  # type: ignore[no-untyped-def]
    """Second Piola-Kirchhoff stress (S_uu, S_vv, S_uv) [N/m]."""
    mean, half = _stretches(e0, e1, e2)
    if mean - half >= BEGINS:
        return 0.0, 0.0, 0.0
    both, apart, _, _ = _slopes(mean, half)
    d = e0 - e1
    return b * (both + apart * d), b * (both - apart * d), b * apart * e2


@kernel(inline="always")
def tangent(e0, e1, e2, b):  # type: ignore[no-untyped-def]
    """c11, c12, c22, c33, c13, c23 [N/m]."""
    mean, half = _stretches(e0, e1, e2)
    if mean - half >= BEGINS:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    _, apart, both, differ = _slopes(mean, half)
    d, s = ((e0 - e1) / half, e2 / half) if half > ROUND else (0.0, 0.0)
    left = both - apart
    return (
        b * (both + 2.0 * differ * d + left * d * d + apart),
        b * (both - left * d * d - apart),
        b * (both - 2.0 * differ * d + left * d * d + apart),
        b * (apart + left * s * s),
        b * (differ + left * d) * s,
        b * (differ - left * d) * s,
    )
