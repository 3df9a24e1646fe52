"""The dihedral angle of a hinge, its gradient and Hessian: pure functions on four points.

Hinge vertices: edge x0-x1, x2 opposite in triangle (0, 1, 2), x3 opposite in (1, 0, 3). With
e = x1 − x0, n1 = e × (x2 − x0), n2 = (x3 − x0) × e the angle θ = atan2((n1 × n2)·ê, n1·n2) is
0 for a flat hinge and positive when the opposite vertices lie on the side the normals point away from.
Source: Grinspun et al., Discrete Shells, SCA 2003; derivatives as in Tamstorf and Grinspun,
Discrete bending forces and their Jacobians, Graphical Models 75 (2013), derived here anew.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.terms.kernel import kernel


@kernel(inline="always")
def point(x, i):  # type: ignore[no-untyped-def]
    return x[i, 0], x[i, 1], x[i, 2]


@kernel(inline="always")
def cross(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel(inline="always")
def dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(inline="always")
def minus(a, b):  # type: ignore[no-untyped-def]
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@kernel()
def angle(x0, x1, x2, x3):  # type: ignore[no-untyped-def]
    """Dihedral angle θ [rad] in (−π, π], 0 where a triangle has no normal; |n1|² and |n2|² [m⁴]."""
    e = minus(x1, x0)
    n1 = cross(e, minus(x2, x0))
    n2 = cross(minus(x3, x0), e)
    length = math.sqrt(dot(e, e))
    theta = math.atan2(dot(cross(n1, n2), e) / length if length > 0.0 else 0.0, dot(n1, n2))
    return theta, dot(n1, n1), dot(n2, n2)


@kernel()
def angle_gradient(x0, x1, x2, x3, g):  # type: ignore[no-untyped-def]
    """θ [rad], |n1|² and |n2|² [m⁴]; the gradient of θ [1/m] into g (4, 3)."""
    e, a, b = minus(x1, x0), minus(x2, x0), minus(x3, x0)
    n1, n2 = cross(e, a), cross(b, e)
    length = math.sqrt(dot(e, e))
    theta = math.atan2(dot(cross(n1, n2), e) / length, dot(n1, n2))
    square1, square2 = dot(n1, n1), dot(n2, n2)
    w1, w2 = 1.0 / square1, 1.0 / square2
    ae, be = dot(a, e) / length, dot(b, e) / length
    l1, l2 = length * w1, length * w2
    g[2, 0], g[2, 1], g[2, 2] = -l1 * n1[0], -l1 * n1[1], -l1 * n1[2]
    g[3, 0], g[3, 1], g[3, 2] = -l2 * n2[0], -l2 * n2[1], -l2 * n2[2]
    a1, a2 = ae * w1, be * w2
    for i in range(3):
        g[1, i] = a1 * n1[i] + a2 * n2[i]
        g[0, i] = -g[1, i] - g[2, i] - g[3, i]
    return theta, square1, square2


@kernel(inline="always")
def _add_skew_product(q, w, scale, out):  # type: ignore[no-untyped-def]
    """out += scale · Q [w]×, Q symmetric (3, 3), [w]× u = w × u."""
    for i in range(3):
        out[i, 0] += scale * (q[i, 1] * w[2] - q[i, 2] * w[1])
        out[i, 1] += scale * (q[i, 2] * w[0] - q[i, 0] * w[2])
        out[i, 2] += scale * (q[i, 0] * w[1] - q[i, 1] * w[0])


@kernel()
def angle_hessian(x0, x1, x2, x3, h):  # type: ignore[no-untyped-def]
    """Hessian of θ [1/m²] into h (4, 4, 3, 3): [a, b, i, j] = ∂²θ / ∂x_a,i ∂x_b,j."""
    e = minus(x1, x0)
    length = math.sqrt(dot(e, e))
    unit = e[0] / length, e[1] / length, e[2] / length
    h[:] = 0.0
    inverse = np.empty((3, 3))
    # the two triangles enter alike: side +1 with n = e × p, side −1 with n = p × e
    for side in range(2):
        opposite = 2 + side
        p = minus(x2, x0) if side == 0 else minus(x3, x0)
        sign = 1.0 if side == 0 else -1.0
        m = cross(e, p)
        n = sign * m[0], sign * m[1], sign * m[2]
        w = 1.0 / dot(n, n)
        q = n[0] * w, n[1] * w, n[2] * w
        along = dot(p, unit)
        # d(n/|n|²) = inverse · dn
        for i in range(3):
            for j in range(3):
                inverse[i, j] = -2.0 * w * n[i] * n[j] * w
            inverse[i, i] += w
        # ∂θ/∂x_k = weight_k q with weights: opposite −L, x1 along, x0 L − along
        # dn = sign ([e]× dp − [p]× de),  de = dx1 − dx0,  dp = dx_opposite − dx0
        for k in range(3):
            row = opposite if k == 2 else k
            weight = -length if k == 2 else (along if k == 1 else length - along)
            scale = sign * weight
            _add_skew_product(inverse, e, scale, h[row, opposite])
            _add_skew_product(inverse, p, -scale, h[row, 1])
            _add_skew_product(inverse, e, -scale, h[row, 0])
            _add_skew_product(inverse, p, scale, h[row, 0])
        for j in range(3):
            d_length = unit[j]  # ∂L/∂x1, its negative ∂L/∂x0
            d_opposite = unit[j]  # ∂along/∂x_opposite
            d_one = (p[j] - along * unit[j]) / length  # ∂along/∂x1
            d_zero = -d_opposite - d_one
            for i in range(3):
                h[opposite, 1, i, j] -= q[i] * d_length
                h[opposite, 0, i, j] += q[i] * d_length
                h[1, opposite, i, j] += q[i] * d_opposite
                h[1, 1, i, j] += q[i] * d_one
                h[1, 0, i, j] += q[i] * d_zero
                h[0, opposite, i, j] -= q[i] * d_opposite
                h[0, 1, i, j] += q[i] * (d_length - d_one)
                h[0, 0, i, j] += q[i] * (-d_length - d_zero)
