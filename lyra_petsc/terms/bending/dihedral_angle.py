"""The dihedral angle of a hinge, its gradient and Hessian: pure functions on four points.

Hinge vertices: edge x0-x1, x2 opposite in triangle (0, 1, 2), x3 opposite in (1, 0, 3). With
e = x1 − x0, n1 = e × (x2 − x0), n2 = (x3 − x0) × e the angle θ = atan2((n1 × n2)·ê, n1·n2) is
0 for a flat hinge and positive when the opposite vertices lie on the side the normals point away from.
Source: Grinspun et al., Discrete Shells, SCA 2003; derivatives as in Tamstorf and Grinspun,
Discrete bending forces and their Jacobians, Graphical Models 75 (2013), derived independently.
"""

from __future__ import annotations

import math

from lyra_petsc.kernels.element import inlined, kernel, subkernel
from lyra_petsc.kernels.vector3 import combined, cross, dot, minus, scaled


@inlined()
def angle_parts(x0, x1, x2, x3):  # type: ignore[no-untyped-def]
    """|n1| |n2| sin θ and |n1| |n2| cos θ, both 0 where a triangle has no normal; |n1|² and |n2|² [m⁴]."""
    e = minus(x1, x0)
    n1 = cross(e, minus(x2, x0))
    n2 = cross(minus(x3, x0), e)
    length = math.sqrt(dot(e, e))
    sine = dot(cross(n1, n2), e) / length if length > 0.0 else 0.0
    return sine, dot(n1, n2), dot(n1, n1), dot(n2, n2)


@kernel()
def angle(x0, x1, x2, x3):  # type: ignore[no-untyped-def]
    """Dihedral angle θ [rad] in [−π, π], 0 where a triangle has no normal; |n1|² and |n2|² [m⁴]."""
    sine, cosine, square1, square2 = angle_parts(x0, x1, x2, x3)
    return math.atan2(sine, cosine), square1, square2


@inlined()
def angle_gradients(x0, x1, x2, x3):  # type: ignore[no-untyped-def]
    """Gradients of θ at the four points [1/m]; |n1|² and |n2|² [m⁴]."""
    e, a, b = minus(x1, x0), minus(x2, x0), minus(x3, x0)
    n1, n2 = cross(e, a), cross(b, e)
    square1, square2 = dot(n1, n1), dot(n2, n2)
    w1, w2 = 1.0 / square1, 1.0 / square2
    length = math.sqrt(dot(e, e))
    g1 = combined(dot(a, e) / length * w1, n1, dot(b, e) / length * w2, n2)
    g2, g3 = scaled(-length * w1, n1), scaled(-length * w2, n2)
    g0 = -g1[0] - g2[0] - g3[0], -g1[1] - g2[1] - g3[1], -g1[2] - g2[2] - g3[2]
    return (g0, g1, g2, g3), square1, square2


@inlined()
def triangle_derivatives(length, u, p, m):  # type: ignore[no-untyped-def]
    """One triangle's part in the derivatives of θ: unit normal n, ω_c and ∇b_c of its corners, and t.

    With barycentric coordinates b_c and ∂θ/∂x_c = ω_c n the change of the normal is −Σ ∇b_d (n · δx_d).
    Summed over both triangles

        ∂²θ/∂x_c∂x_d = −ω_d n ∇b_cᵀ − ω_c ∇b_d nᵀ + σ_c σ_d (n tᵀ + t nᵀ),   σ = 1, −1, 0.

    (The derivative of one triangle alone has 2 n tᵀ; its antisymmetric part cancels in the sum.) The edge
    x1 − x0 has the given ``length`` and direction u, p is the vector from x0 to the opposite corner, and m
    the normal with the length of twice the triangle's area.
    """
    inverse = 1.0 / math.sqrt(dot(m, m))
    n = scaled(inverse, m)
    # up: unit vector along the height, from the edge to the opposite corner
    steep, part = length * inverse, dot(p, u) / length
    up = combined(steep, p, -part * length * steep, u)
    # ω = (1/h − f/(L h), f/(L h), −1/h) with the height h and its foot at f
    w1 = part * steep
    b1, b2 = combined(1.0 / length, u, -w1, up), scaled(steep, up)
    b0 = -b1[0] - b2[0], -b1[1] - b2[1], -b1[2] - b2[2]
    return n, (steep - w1, w1, -steep), (b0, b1, b2), scaled(0.5 / (length * length), up)


@subkernel()
def add_angle_hessian(x0, x1, x2, x3, scale, out):  # type: ignore[no-untyped-def]
    """Add scale times the Hessian of θ [1/m²] to out (4, 4, 3, 3): [a, b, i, j] = ∂²θ / ∂x_a,i ∂x_b,j."""
    e = minus(x1, x0)
    length = math.sqrt(dot(e, e))
    u = scaled(1.0 / length, e)
    for side in range(2):
        p = minus(x2, x0) if side == 0 else minus(x3, x0)
        n, w, b, t = triangle_derivatives(length, u, p, cross(e, p) if side == 0 else cross(p, e))
        for c in range(3):
            for d in range(3):
                turned = 0.0 if c == 2 or d == 2 else (1.0 if c == d else -1.0)
                left, right = combined(turned, t, -w[c], b[d]), combined(turned, t, -w[d], b[c])
                block = out[c if c < 2 else 2 + side, d if d < 2 else 2 + side]
                for i in range(3):
                    for j in range(3):
                        block[i, j] += scale * (n[i] * right[j] + left[i] * n[j])
