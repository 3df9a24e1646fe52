"""Compressible neo-Hookean sheet in plane stress: W = μ/2 (tr C − 2 + (J^−2β − 1)/β), β = ν/(1 − ν).

C = I + 2E and J² = det C. It is Storåkers's foam (J. Mech. Phys. Solids 34 (1986) 125-145) of exponent 2 with
no stress across the thickness, hence the incompressible neo-Hookean sheet for ν = ½. W is convex in E, and
grows without bound as a triangle loses its area.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.element import kernel
from lyra_petsc.scene.materials.library import ShellMaterial

SOFTENS = False

LEAST = 1e-3
"""det C below which W goes on as a parabola: strains that Newton's method expects may be of no shape."""


@kernel(inline="always")
def _volume(e0, e1, e2, beta):  # type: ignore[no-untyped-def]
    """t = det C − 1; of g = (det C^−β − 1)/2β its sum with t/2, 1 + 2g' and g''."""
    t = 2.0 * (e0 + e1) + 4.0 * e0 * e1 - e2 * e2
    u = max(t, LEAST - 1.0)
    log = math.log1p(u)
    value = 0.5 * u - 0.5 * log if beta == 0.0 else 0.5 * u + 0.5 * math.expm1(-beta * log) / beta
    slope = -math.expm1(-(1.0 + beta) * log)
    second = 0.5 * (1.0 + beta) * (1.0 - slope) / (1.0 + u)
    more = t - u
    return t, value + (0.5 * slope + 0.5 * second * more) * more, slope + 2.0 * second * more, second


@kernel(inline="always")
def stress(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """Second Piola-Kirchhoff stress (S_uu, S_vv, S_uv) [N/m]."""
    _, _, slope, _ = _volume(e0, e1, e2, c[m, 1])
    mu, left = c[m, 0], 1.0 - slope
    return mu * (slope - 2.0 * left * e1), mu * (slope - 2.0 * left * e0), mu * left * e2


@kernel(inline="always")
def energy(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """Energy [J] per rest area [m²]."""
    _, value, _, _ = _volume(e0, e1, e2, c[m, 1])
    return c[m, 0] * (value - 2.0 * e0 * e1 + 0.5 * e2 * e2)


@kernel(inline="always")
def tangent(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """c11, c12, c22, c33, c13, c23 [N/m]."""
    _, _, slope, second = _volume(e0, e1, e2, c[m, 1])
    mu, left = c[m, 0], 1.0 - slope
    k, d0, d1, d2 = mu * second, 2.0 + 4.0 * e1, 2.0 + 4.0 * e0, -2.0 * e2
    return (
        k * d0 * d0,
        k * d0 * d1 - 2.0 * mu * left,
        k * d1 * d1,
        k * d2 * d2 + mu * left,
        k * d0 * d2,
        k * d1 * d2,
    )


def parameters(shell: ShellMaterial) -> list[float]:
    """μ [N/m] and β."""
    return [shell.c33, 0.5 * shell.c12 / shell.c33]


def stiffest(c: Array) -> Array:
    """Largest stiffness [N/m] of each law (n_laws, 2) at rest."""
    return 2.0 * c[:, 0] * (1.0 + np.maximum(c[:, 1], 0.0))
