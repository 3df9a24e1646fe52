"""The dihedral angle of a hinge, its gradient and Hessian: pure functions on four points.

Hinge vertices: edge x0-x1, x2 opposite in triangle (0, 1, 2), x3 opposite in (1, 0, 3). With
e = x1 − x0, n1 = e × (x2 − x0), n2 = (x3 − x0) × e the angle θ = atan2((n1 × n2)·ê, n1·n2) is
0 for a flat hinge and positive when the opposite vertices lie on the side the normals point away from.
Source: Grinspun et al., Discrete Shells, SCA 2003; derivatives as in Tamstorf and Grinspun,
Discrete bending forces and their Jacobians, Graphical Models 75 (2013), derived here anew.
"""

from __future__ import annotations

import math

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


@kernel(inline="always")
def _combined(p, u, q, w):  # type: ignore[no-untyped-def]
    return p * u[0] + q * w[0], p * u[1] + q * w[1], p * u[2] + q * w[2]


@kernel(inline="always")
def angle_slopes(x0, x1, x2, x3):  # type: ignore[no-untyped-def]
    """Gradients of θ at the four points [1/m]; |n1|² and |n2|² [m⁴]."""
    e, a, b = minus(x1, x0), minus(x2, x0), minus(x3, x0)
    n1, n2 = cross(e, a), cross(b, e)
    square1, square2 = dot(n1, n1), dot(n2, n2)
    w1, w2 = 1.0 / square1, 1.0 / square2
    length = math.sqrt(dot(e, e))
    l1, l2 = -length * w1, -length * w2
    g1 = _combined(dot(a, e) / length * w1, n1, dot(b, e) / length * w2, n2)
    g2, g3 = (l1 * n1[0], l1 * n1[1], l1 * n1[2]), (l2 * n2[0], l2 * n2[1], l2 * n2[2])
    g0 = -g1[0] - g2[0] - g3[0], -g1[1] - g2[1] - g3[1], -g1[2] - g2[2] - g3[2]
    return (g0, g1, g2, g3), square1, square2


@kernel()
def angle_gradient(x0, x1, x2, x3, g):  # type: ignore[no-untyped-def]
    """θ [rad], |n1|² and |n2|² [m⁴]; the gradient of θ [1/m] into g (4, 3)."""
    slopes, square1, square2 = angle_slopes(x0, x1, x2, x3)
    for a in range(4):
        g[a, 0], g[a, 1], g[a, 2] = slopes[a]
    e = minus(x1, x0)
    n1, n2 = cross(e, minus(x2, x0)), cross(minus(x3, x0), e)
    theta = math.atan2(dot(cross(n1, n2), e) / math.sqrt(dot(e, e)), dot(n1, n2))
    return theta, square1, square2


@kernel(inline="always")
def _add_turn(n, d, w, b, scale, out):  # type: ignore[no-untyped-def]
    """out += scale · (n dᵀ − w b nᵀ)."""
    for i in range(3):
        p, q = scale * n[i], -scale * w * b[i]
        for j in range(3):
            out[i, j] += p * d[j]
            out[i, j] += q * n[j]


@kernel(forceinline=True)
def triangle_turn(e, length, u, p, side):  # type: ignore[no-untyped-def]
    """Of one triangle of a hinge: its unit normal n, and ω_c, ∇b_c and ∂ω_c/∂x_d of its three corners.

    With barycentric coordinates b_c and ∂θ/∂x_c = ω_c n the normal turns by −Σ ∇b_d (n · δx_d), so that
    ∂²θ/∂x_c∂x_d = n (∂ω_c/∂x_d)ᵀ − ω_c ∇b_d nᵀ, with all but n in the triangle's plane. The edge e = x1 − x0
    has the direction u, p goes from x0 to the opposite corner, on the first or second side (0, 1).
    """
    m = cross(e, p) if side == 0 else cross(p, e)
    double = math.sqrt(dot(m, m))
    n = m[0] / double, m[1] / double, m[2] / double
    height, foot = double / length, dot(p, u)
    # up: the direction of the height, from the edge to the opposite corner
    up = _combined(1.0 / height, p, -foot / height, u)
    part = foot / length
    # how the height changes along up with x0 and x1; with the opposite corner by 1
    dh0, dh1 = part - 1.0, -part
    r = height / length
    # ω = (1/h − f/(L h), f/(L h), −1/h) of x0, x1, opposite; ∂f/∂x0 = −u − r·up, ∂x1: r·up, opposite: u
    w1 = part / height
    w0, w2 = 1.0 / height - w1, -1.0 / height
    k, inverse = 1.0 / (length * height), 1.0 / height
    # ∂ω1 = ∂f/(L h) − ω1 ∂L/L − ω1 ∂h/h
    d10 = _combined(w1 / length - k, u, -k * r - w1 * inverse * dh0, up)
    d11 = _combined(-w1 / length, u, k * r - w1 * inverse * dh1, up)
    d12 = _combined(k, u, -w1 * inverse, up)
    # ∂ω2 = ∂h/h², ∂ω0 = −∂ω2 − ∂ω1
    square = inverse * inverse
    d20 = _combined(0.0, u, square * dh0, up)
    d21 = _combined(0.0, u, square * dh1, up)
    d22 = _combined(0.0, u, square, up)
    d00, d01 = _combined(-1.0, d20, -1.0, d10), _combined(-1.0, d21, -1.0, d11)
    d02 = _combined(-1.0, d22, -1.0, d12)
    b0 = _combined(-1.0 / length, u, inverse * dh0, up)
    b1 = _combined(1.0 / length, u, inverse * dh1, up)
    b2 = _combined(0.0, u, inverse, up)
    return n, (w0, w1, w2), (b0, b1, b2), ((d00, d01, d02), (d10, d11, d12), (d20, d21, d22))


@kernel()
def add_angle_hessian(x0, x1, x2, x3, scale, out):  # type: ignore[no-untyped-def]
    """Add scale times the Hessian of θ [1/m²] to out (4, 4, 3, 3): [a, b, i, j] = ∂²θ / ∂x_a,i ∂x_b,j."""
    e = minus(x1, x0)
    length = math.sqrt(dot(e, e))
    u = e[0] / length, e[1] / length, e[2] / length
    for side in range(2):
        p = minus(x2, x0) if side == 0 else minus(x3, x0)
        n, w, b, d = triangle_turn(e, length, u, p, side)
        for c in range(3):
            for f in range(3):
                row, column = c if c < 2 else 2 + side, f if f < 2 else 2 + side
                _add_turn(n, d[c][f], w[c], b[f], scale, out[row, column])
