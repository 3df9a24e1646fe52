"""Compressible neo-Hookean sheet in plane stress: W = μ/2 (tr C − 2 + (J^−2β − 1)/β), β = ν/(1 − ν).

C = I + 2E and J² = det C. This is Storåkers's foam (J. Mech. Phys. Solids 34 (1986) 125-145) of exponent 2
without stress across the thickness, for ν = ½ the incompressible neo-Hookean sheet. W is convex in E and
grows without bound as the area of a triangle vanishes.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.element import inlined
from lyra_petsc.scene.materials.library import ShellMaterial

SOFTENS = False

SMALLEST_DETERMINANT = 1e-3
"""det C below which W is extended as a parabola: strains predicted in Newton's method may have det C < 0."""


@inlined()
def _volume(e0, e1, e2, beta):  # type: ignore[no-untyped-def]
    """t = det C − 1; and t/2 + g, 1 + 2 g' and g'' of g = ((det C)^−β − 1)/2β as a function of t."""
    t = 2.0 * (e0 + e1) + 4.0 * e0 * e1 - e2 * e2
    u = max(t, SMALLEST_DETERMINANT - 1.0)
    log = math.log1p(u)
    value = 0.5 * u - 0.5 * log if beta == 0.0 else 0.5 * u + 0.5 * math.expm1(-beta * log) / beta
    slope = -math.expm1(-(1.0 + beta) * log)
    second = 0.5 * (1.0 + beta) * (1.0 - slope) / (1.0 + u)
    beyond = t - u
    return t, value + (0.5 * slope + 0.5 * second * beyond) * beyond, slope + 2.0 * second * beyond, second


@inlined()
def stress(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """Second Piola-Kirchhoff stress (S_uu, S_vv, S_uv) [N/m]."""
    _, _, slope, _ = _volume(e0, e1, e2, c[m, 1])
    mu, rest = c[m, 0], 1.0 - slope
    return mu * (slope - 2.0 * rest * e1), mu * (slope - 2.0 * rest * e0), mu * rest * e2


@inlined()
def energy(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """Energy [J] per rest area [m²]."""
    _, value, _, _ = _volume(e0, e1, e2, c[m, 1])
    return c[m, 0] * (value - 2.0 * e0 * e1 + 0.5 * e2 * e2)


@inlined()
def tangent(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """c11, c12, c22, c33, c13, c23 [N/m]."""
    _, _, slope, second = _volume(e0, e1, e2, c[m, 1])
    mu, rest = c[m, 0], 1.0 - slope
    k, d0, d1, d2 = mu * second, 2.0 + 4.0 * e1, 2.0 + 4.0 * e0, -2.0 * e2
    return (
        k * d0 * d0,
        k * d0 * d1 - 2.0 * mu * rest,
        k * d1 * d1,
        k * d2 * d2 + mu * rest,
        k * d0 * d2,
        k * d1 * d2,
    )


def parameters(shell: ShellMaterial) -> list[float]:
    """μ [N/m] and β."""
    return [shell.c33, 0.5 * shell.c12 / shell.c33]


def stiffest(c: Array) -> Array:
    """Largest stiffness at rest [N/m], (n_materials,), for parameters c (n_materials, 2)."""
    return 2.0 * c[:, 0] * (1.0 + np.maximum(c[:, 1], 0.0))
