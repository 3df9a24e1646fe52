"""A barrier against compression: an energy of small principal stretches λ that other laws add to theirs.

    φ(λ) = b ln(λ₀/λ)³ below λ₀ = ¾, else 0,   summed over both principal stretches

Without it a quadratic energy of the Green strain softens below λ = 1/√3, since its force λ S vanishes with λ.
φ is convex in E, being a convex decreasing function of the eigenvalues of C = I + 2E, and 0 at rest. λ₀ is
smaller than the principal stretches that occur when wovens are sheared.
"""

from __future__ import annotations

import math

from lyra_petsc.kernels.element import inlined

THRESHOLD = 0.75**2
"""λ₀²."""

SMALLEST_SQUARE = 0.1**2
"""λ² below which laws are extended as polynomials: strains predicted in Newton's method may have λ² < 0."""

STIFFNESS_RATIO = 0.25
"""Ratio of b to the largest stiffness at rest."""

COINCIDENT = 1e-6
"""Difference of the two λ² below which they count as equal."""


@inlined()
def _barrier(c):  # type: ignore[no-untyped-def]
    """φ/b as a function of c = λ², and its first two derivatives."""
    if c >= THRESHOLD:
        return 0.0, 0.0, 0.0
    at = max(c, SMALLEST_SQUARE)
    q = 0.5 * math.log(THRESHOLD / at)
    second = 1.5 * q * (1.0 + q) / (at * at)
    slope, beyond = -1.5 * q * q / at, c - at
    return q * q * q + (slope + 0.5 * second * beyond) * beyond, slope + second * beyond, second


@inlined()
def _stretches(e0, e1, e2):  # type: ignore[no-untyped-def]
    """Mean and half the difference of the two λ²."""
    return 1.0 + e0 + e1, math.sqrt((e0 - e1) * (e0 - e1) + e2 * e2)


@inlined()
def energy(e0, e1, e2, b):  # type: ignore[no-untyped-def]
    """Energy [J] per rest area [m²] of the Green strain (E_uu, E_vv, 2 E_uv); b [N/m]."""
    mean, half = _stretches(e0, e1, e2)
    if mean - half >= THRESHOLD:
        return 0.0
    return b * (_barrier(mean - half)[0] + _barrier(mean + half)[0])


@inlined()
def _slopes(mean, half):  # type: ignore[no-untyped-def]
    """φ'₁ + φ'₂, (φ'₂ − φ'₁)/half, φ''₁ + φ''₂ and φ''₂ − φ''₁, divided by b."""
    _, slope1, second1 = _barrier(mean - half)
    _, slope2, second2 = _barrier(mean + half)
    ratio = (slope2 - slope1) / half if half > COINCIDENT else second1 + second2
    return slope1 + slope2, ratio, second1 + second2, second2 - second1


@inlined()
def stress(e0, e1, e2, b):  # type: ignore[no-untyped-def]
    """Second Piola-Kirchhoff stress (S_uu, S_vv, S_uv) [N/m]."""
    mean, half = _stretches(e0, e1, e2)
    if mean - half >= THRESHOLD:
        return 0.0, 0.0, 0.0
    both, ratio, _, _ = _slopes(mean, half)
    d = e0 - e1
    return b * (both + ratio * d), b * (both - ratio * d), b * ratio * e2


@inlined()
def tangent(e0, e1, e2, b):  # type: ignore[no-untyped-def]
    """c11, c12, c22, c33, c13, c23 [N/m]."""
    mean, half = _stretches(e0, e1, e2)
    if mean - half >= THRESHOLD:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    _, ratio, both, differ = _slopes(mean, half)
    d, s = ((e0 - e1) / half, e2 / half) if half > COINCIDENT else (0.0, 0.0)
    rest = both - ratio
    return (
        b * (both + 2.0 * differ * d + rest * d * d + ratio),
        b * (both - rest * d * d - ratio),
        b * (both - 2.0 * differ * d + rest * d * d + ratio),
        b * (ratio + rest * s * s),
        b * (differ + rest * d) * s,
        b * (differ - rest * d) * s,
    )
