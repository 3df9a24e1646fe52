"""The bending energy of one hinge, its gradient and Hessian: pure functions on four points.

    energy = k (θ − θ̄)² w(a1) w(a2)
    a_t = (A_t / 0.1 A0_t)²,   w(a) = a³ (10 − 15 a + 6 a²), 1 from a = 1 on

with the areas A and the rest areas A0 of the hinge's two triangles. A triangle without area has no normal,
hence no dihedral angle, and the gradient of the angle grows like 1/height. Therefore the energy fades out,
with two continuous derivatives, as the triangle loses the last tenth of its area. (A St. Venant-Kirchhoff
membrane softens long before, at 1/√3 of a length.)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.kernels.element import inlined, kernel, subkernel
from lyra_petsc.kernels.vector3 import cross, dot, minus
from lyra_petsc.terms.bending.dihedral_angle import add_angle_hessian, angle_gradients

FADES_BELOW = 0.1
"""Fraction of a triangle's rest area below which the hinges on its edges fade."""

VANISHED = 1e-30
"""a below which w counts as 0: it is negligible, and divisions in the angle's derivatives may overflow."""


def fading_limit(area: NDArray[np.float64]) -> NDArray[np.float64]:
    """|n|² [m⁴], |n| = 2A, above which w = 1, for triangles of these rest areas [m²]."""
    return (FADES_BELOW * 2.0 * area) ** 2


@kernel()
def fade(square, limit):  # type: ignore[no-untyped-def]
    """w of one triangle, and its first two derivatives with respect to |n|² [1/m⁴, 1/m⁸].

    With limit 0 a triangle has w = 1 as long as its area is not 0.
    """
    if square <= VANISHED * limit:
        return 0.0, 0.0, 0.0
    if square >= limit:
        return 1.0, 0.0, 0.0
    a = square / limit
    rest = 1.0 - a
    first = 30.0 * (a * rest) ** 2 / limit
    second = 60.0 * a * rest * (1.0 - 2.0 * a) / limit / limit
    return a * a * a * (10.0 - 15.0 * a + 6.0 * a * a), first, second


@subkernel()
def hinge_weight(square1, square2, limit1, limit2):  # type: ignore[no-untyped-def]
    """w(a1) w(a2); 1 unless a triangle has lost nearly all its area."""
    return fade(square1, limit1)[0] * fade(square2, limit2)[0]


@inlined()
def hinge_energy(theta, square1, square2, k, rest, limits):  # type: ignore[no-untyped-def]
    """Energy [J] of stiffness k [N·m] at angle theta, with rest angle ``rest`` [rad]."""
    full = k * (theta - rest) * (theta - rest)
    if square1 > limits[0] and square2 > limits[1]:
        return full
    return full * hinge_weight(square1, square2, limits[0], limits[1])


@inlined()
def _write_angle_gradient(x0, x1, x2, x3, g):  # type: ignore[no-untyped-def]
    """Write the gradient of θ into g (4, 3); return |n1|² and |n2|² [m⁴]."""
    slopes, square1, square2 = angle_gradients(x0, x1, x2, x3)
    for a in range(4):
        g[a, 0], g[a, 1], g[a, 2] = slopes[a]
    return square1, square2


@subkernel()
def hinge_gradient(x0, x1, x2, x3, theta, k, rest, limits, g):  # type: ignore[no-untyped-def]
    """Write g (4, 3) [1/m] and return a moment [N·m]; their product is the energy's gradient [N]."""
    square1, square2 = _write_angle_gradient(x0, x1, x2, x3, g)
    change = theta - rest
    if not (square1 > limits[0] and square2 > limits[1]):
        change = _fade_gradient(x0, x1, x2, x3, square1, square2, limits[0], limits[1], change, g)
    return 2.0 * k * change


@kernel()
def hinge_hessian(x0, x1, x2, x3, theta, k, rest, limits, convexity, g, out):  # type: ignore[no-untyped-def]
    """Write the Hessian blocks [N/m] into out (4, 4, 3, 3); g (4, 3) is work space.

    ``convexity`` 0 is exact, 1 the positive-semidefinite 2 k ∇θ ∇θᵀ w(a1) w(a2).
    """
    square1, square2 = _write_angle_gradient(x0, x1, x2, x3, g)
    change = theta - rest
    stiffness = 2.0 * k
    for a in range(4):
        for b in range(4):
            for i in range(3):
                for j in range(3):
                    out[a, b, i, j] = stiffness * g[a, i] * g[b, j]
    if convexity < 1.0:
        add_angle_hessian(x0, x1, x2, x3, (1.0 - convexity) * stiffness * change, out)
    if not (square1 > limits[0] and square2 > limits[1]):
        _fade_hessian(x0, x1, x2, x3, square1, square2, limits[0], limits[1], k, change, convexity, g, out)


@subkernel()
def _normals(x0, x1, x2, x3):  # type: ignore[no-untyped-def]
    """Normals [m²] of triangles (0, 1, 2) and (1, 0, 3), of length twice the area."""
    e = minus(x1, x0)
    return cross(e, minus(x2, x0)), cross(minus(x3, x0), e)


@subkernel()
def _square_gradients(x0, x1, x2, x3, out):  # type: ignore[no-untyped-def]
    """Write ∇|n|² [m³] of both triangles into out (2, 4, 3): 2 ε × n with the edge ε opposite each corner."""
    n1, n2 = _normals(x0, x1, x2, x3)
    out[:] = 0.0
    _set_row(out[0, 0], cross(minus(x1, x2), n1))
    _set_row(out[0, 1], cross(minus(x2, x0), n1))
    _set_row(out[0, 2], cross(minus(x0, x1), n1))
    _set_row(out[1, 0], cross(minus(x3, x1), n2))
    _set_row(out[1, 1], cross(minus(x0, x3), n2))
    _set_row(out[1, 3], cross(minus(x1, x0), n2))
    out *= 2.0


@inlined()
def _set_row(row, values):  # type: ignore[no-untyped-def]
    row[0], row[1], row[2] = values


@subkernel()
def _fade_gradient(  # type: ignore[no-untyped-def]
    x0, x1, x2, x3, square1, square2, limit1, limit2, change, g
):
    """Replace ∇θ in g (4, 3) by W ∇θ + ½ (θ − θ̄) ∇W, W = w(a1) w(a2); return θ − θ̄, or 0 where W is 0."""
    w1, d1, _ = fade(square1, limit1)
    w2, d2, _ = fade(square2, limit2)
    if w1 * w2 == 0.0:  # g may be infinite
        g[:] = 0.0
        return 0.0
    slopes = np.empty((2, 4, 3))
    _square_gradients(x0, x1, x2, x3, slopes)
    for a in range(4):
        for i in range(3):
            slope = d1 * w2 * slopes[0, a, i] + w1 * d2 * slopes[1, a, i]
            g[a, i] = w1 * w2 * g[a, i] + 0.5 * change * slope
    return change


@subkernel()
def add_square_hessian(y, n, at, scale, out):  # type: ignore[no-untyped-def]
    """Add scale ∂²|n|²/∂y² of a triangle with corners y to out (4, 4, 3, 3).

    ``at`` are the corners' numbers in the hinge. For corners c and d with opposite edges ε the block is
    2 ((ε_c·ε_d) I − ε_d ε_cᵀ − σ [n]×), with σ = 1 if d follows c, −1 if c follows d, 0 if they are the same.
    """
    sides = minus(y[1], y[2]), minus(y[2], y[0]), minus(y[0], y[1])
    for c in range(3):
        for d in range(3):
            block = out[at[c], at[d]]
            turn = 0.0 if c == d else (1.0 if d == (c + 1) % 3 else -1.0)
            for i in range(3):
                for j in range(3):
                    block[i, j] -= 2.0 * scale * sides[d][i] * sides[c][j]
                block[i, i] += 2.0 * scale * dot(sides[c], sides[d])
                j, k = (i + 1) % 3, (i + 2) % 3
                block[i, j] += 2.0 * scale * turn * n[k]
                block[j, i] -= 2.0 * scale * turn * n[k]


@subkernel()
def _fade_hessian(  # type: ignore[no-untyped-def]
    x0, x1, x2, x3, square1, square2, limit1, limit2, k, change, convexity, g, out
):
    """Replace the Hessian of f = k (θ − θ̄)² in out (4, 4, 3, 3) by that of f W, W = w(a1) w(a2)."""
    w1, d1, dd1 = fade(square1, limit1)
    w2, d2, dd2 = fade(square2, limit2)
    if w1 * w2 == 0.0:
        out[:] = 0.0
        return
    out *= w1 * w2
    # the regularised Hessian consists of the term above only
    force, value = (1.0 - convexity) * 2.0 * k * change, (1.0 - convexity) * k * change * change
    n1, n2 = _normals(x0, x1, x2, x3)
    slopes, bent = np.empty((2, 4, 3)), np.zeros((4, 4, 3, 3))
    _square_gradients(x0, x1, x2, x3, slopes)
    add_square_hessian((x0, x1, x2), n1, (0, 1, 2), d1 * w2, bent)
    add_square_hessian((x1, x0, x3), n2, (1, 0, 3), w1 * d2, bent)
    for a in range(4):
        for b in range(4):
            for i in range(3):
                for j in range(3):
                    p, q, r, s = slopes[0, a, i], slopes[1, a, i], slopes[0, b, j], slopes[1, b, j]
                    # ∇f ∇Wᵀ + ∇W ∇fᵀ + f ∂²W
                    w_a, w_b = d1 * w2 * p + w1 * d2 * q, d1 * w2 * r + w1 * d2 * s
                    w_ab = dd1 * w2 * p * r + w1 * dd2 * q * s + d1 * d2 * (p * s + q * r)
                    out[a, b, i, j] += force * (g[a, i] * w_b + w_a * g[b, j])
                    out[a, b, i, j] += value * (w_ab + bent[a, b, i, j])
