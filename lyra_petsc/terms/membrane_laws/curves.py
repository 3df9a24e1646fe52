"""Cloth by curves of the user: forces per width along warp and weft, and in shear, each by its own strain.

    W = ∫ P₁ dλ₁ + ∫ P₂ dλ₂ + ∫ P₃ dγ + barrier against compression (``compression``)

with the stretches λ = √(1 + 2E) of warp and weft, forces P per rest width [N/m], and γ = 2 E_uv, without
coupling. A curve is extended linearly beyond its last point, P₁ and P₂ also under compression. P₃ is odd.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import inlined, kernel, subkernel
from lyra_petsc.scene.materials.library import ShellMaterial
from lyra_petsc.scene.materials.measured_curves import interpolation
from lyra_petsc.terms.membrane_laws import compression

SOFTENS = False


@subkernel()
def _evaluate_curve(x, c, m, which):  # type: ignore[no-untyped-def]
    """Integral, value and slope at x of curve ``which`` (0 warp, 1 weft, 2 shear) of material m."""
    first, last = Index(c[m, 1 + which]), Index(c[m, 2 + which]) - Index(4)
    if x <= 0.0:
        slope = c[m, first + 2]
        return 0.5 * slope * x * x, slope * x, slope
    if x >= c[m, last]:
        beyond, slope = x - c[m, last], c[m, last + 2]
        force = c[m, last + 1]
        return c[m, last + 3] + (force + 0.5 * slope * beyond) * beyond, force + slope * beyond, slope
    low, high = first // 4, last // 4
    while high - low > 1:
        middle = (low + high) // 2
        if x < c[m, 4 * middle]:
            high = middle
        else:
            low = middle
    i, j = Index(4 * low), Index(4 * low + 4)
    h = c[m, j] - c[m, i]
    t = (x - c[m, i]) / h
    y0, y1, d0, d1 = c[m, i + 1], c[m, j + 1], h * c[m, i + 2], h * c[m, j + 2]
    a, b = 3.0 * (y1 - y0) - 2.0 * d0 - d1, 2.0 * (y0 - y1) + d0 + d1
    total = c[m, i + 3] + h * t * (y0 + t * (d0 / 2.0 + t * (a / 3.0 + t * b / 4.0)))
    return total, y0 + t * (d0 + t * (a + t * b)), (d0 + t * (2.0 * a + 3.0 * t * b)) / h


@subkernel()
def _axial(e, c, m, which):  # type: ignore[no-untyped-def]
    """Energy, P/λ and its derivative at the Green strain e along warp (0) or weft (1)."""
    square = max(1.0 + 2.0 * e, compression.SMALLEST_SQUARE)
    stretch = math.sqrt(square)
    # (λ² − 1)/(λ + 1) is λ − 1 without cancellation
    total, force, slope = _evaluate_curve((square - 1.0) / (stretch + 1.0), c, m, which)
    stress = force / stretch
    rise = (slope - stress) / square
    beyond = e - 0.5 * (square - 1.0)
    return total + (stress + 0.5 * rise * beyond) * beyond, stress + rise * beyond, rise


@kernel()
def _shear(e, c, m):  # type: ignore[no-untyped-def]
    """Energy, stress and its derivative at the shear e."""
    total, force, slope = _evaluate_curve(abs(e), c, m, 2)
    return total, (force if e >= 0.0 else -force), slope


@inlined()
def energy(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """Energy [J] per rest area [m²]."""
    sheet = _axial(e0, c, m, 0)[0] + _axial(e1, c, m, 1)[0] + _shear(e2, c, m)[0]
    return sheet + compression.energy(e0, e1, e2, c[m, 0])


@inlined()
def stress(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """Second Piola-Kirchhoff stress (S_uu, S_vv, S_uv) [N/m]."""
    s0, s1, s2 = compression.stress(e0, e1, e2, c[m, 0])
    return s0 + _axial(e0, c, m, 0)[1], s1 + _axial(e1, c, m, 1)[1], s2 + _shear(e2, c, m)[1]


@inlined()
def tangent(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """c11, c12, c22, c33, c13, c23 [N/m]."""
    c11, c12, c22, c33, c13, c23 = compression.tangent(e0, e1, e2, c[m, 0])
    c11, c22, c33 = c11 + _axial(e0, c, m, 0)[2], c22 + _axial(e1, c, m, 1)[2], c33 + _shear(e2, c, m)[2]
    return c11, c12, c22, c33, c13, c23


def parameters(shell: ShellMaterial) -> list[float]:
    """b [N/m], the start and end indices of the three curves' points in the row, and the points."""
    curves = [interpolation(points) * [1.0, *(shell.stretching,) * 3] for points in shell.curves]
    starts = 8 + np.cumsum([0, *(4 * len(curve) for curve in curves)])
    b = compression.STIFFNESS_RATIO * max(shell.c11, shell.c22, shell.c33)
    return [b, *starts.astype(float), 0.0, 0.0, 0.0, *np.concatenate(curves).ravel()]


def stiffest(c: Array) -> Array:
    """Largest stiffness at rest [N/m], (n_materials,), for parameters c (n_materials, n)."""
    return c[:, 0] / compression.STIFFNESS_RATIO
