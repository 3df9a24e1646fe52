"""Principal stretches of the triangles: the singular values of their deformation gradients.

With C = FᵀF, m = tr C / 2 and r the distance of its eigenvalues from m, the larger eigenvalue is m + r
and the smaller det C/(m + r), a form without cancellation for nearly collapsed triangles.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.element import kernel

SOFTENS_BELOW = 1.0 / math.sqrt(3.0)
"""Stretch at which the stress of a St. Venant-Kirchhoff bar, c λ (λ² − 1)/2, is at its most compressive."""


@kernel()
def principal(x, s, n, inverse, out):  # type: ignore[no-untyped-def]
    """Write the smallest and largest principal stretch of triangles 0..n into out (n, 2)."""
    for e in range(n):
        a, b, c = s[e, 0], s[e, 1], s[e, 2]
        i00, i01, i10, i11 = inverse[e, 0, 0], inverse[e, 0, 1], inverse[e, 1, 0], inverse[e, 1, 1]
        uu, vv, uv = 0.0, 0.0, 0.0
        for i in range(3):
            p, q = x[b, i] - x[a, i], x[c, i] - x[a, i]
            u, v = p * i00 + q * i10, p * i01 + q * i11
            uu += u * u
            vv += v * v
            uv += u * v
        half = 0.5 * (uu - vv)
        largest = 0.5 * (uu + vv) + np.sqrt(half * half + uv * uv)
        # √det C as a ratio of areas from a cross product, since det C is a difference of products
        px, py, pz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
        qx, qy, qz = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
        nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        area = np.sqrt(nx * nx + ny * ny + nz * nz) * abs(i00 * i11 - i01 * i10)
        out[e, 1] = np.sqrt(largest)
        out[e, 0] = area / out[e, 1] if largest > 0.0 else 0.0


def principal_stretches(x: Array, stencil: NDArray[np.int32], inverse: Array, n: int) -> Array:
    """Smallest and largest principal stretch of the first n triangles, (n, 2).

    Parameters
    ----------
    x : (V, 3) float64
        Positions [m].
    stencil : (E, 3) int32
    inverse : (E, 2, 2) float64
        Inverse rest matrices [1/m].
    """
    out = np.empty((n, 2))
    principal(x, stencil, n, inverse, out)
    return out
