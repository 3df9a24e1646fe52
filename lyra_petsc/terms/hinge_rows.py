"""Hessians of hinges added straight to block rows, as ``scatter`` adds blocks.

Of each hinge the blocks (0, 0), (0, 1), …, (3, 3) on and above the diagonal; ``hinge_energy`` has them all.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.block_rows.scatter import add_element, fetch_ahead
from lyra_petsc.block_rows.vectors import add_outer
from lyra_petsc.terms.hinge import angle_slopes, combined, cross, dot, minus, point, scaled, triangle_turn
from lyra_petsc.terms.hinge_energy import hinge_hessian, hinge_stiffness
from lyra_petsc.terms.kernel import kernel


@kernel()
def add_regularised(x, s, k, limit, weight, offsets, values):  # type: ignore[no-untyped-def]
    """Add weight (E,) times the regularised blocks."""
    for e in range(s.shape[0]):
        fetch_ahead(e, offsets, values)
        x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(x, s[e, 3])
        g, square1, square2 = angle_slopes(x0, x1, x2, x3)
        w = weight[e] * hinge_stiffness(square1, square2, k[e], limit[e, 0], limit[e, 1])
        if w == 0.0:  # where θ itself may be no number
            continue
        pair = 0
        for a in range(4):
            for b in range(a, 4):
                add_outer(values, offsets[e, pair], 0.0, (scaled(w, g[a]),), (g[b],))
                pair += 1


@kernel(forceinline=True)
def _more(p, u, q, w, r, v):  # type: ignore[no-untyped-def]
    """p u + q w + r v."""
    return p * u[0] + q * w[0] + r * v[0], p * u[1] + q * w[1] + r * v[1], p * u[2] + q * w[2] + r * v[2]


@kernel(forceinline=True)
def _halves(w, turned, gb, turn, a, b):  # type: ignore[no-untyped-def]
    """Of one triangle in the block of points a and b of the edge: … nᵀ and n …ᵀ."""
    _, o, slopes, t = turn
    return combined(turned, t, o[a], slopes[b]), _more(turned, t, o[b], slopes[a], w * o[a], gb)


@kernel(forceinline=True)
def _add_edge(at, w, turned, g, one, two, a, b, values):  # type: ignore[no-untyped-def]
    """Add the block of points a and b of the edge, both of both triangles."""
    left1, right1 = _halves(w, turned, g[b], one, a, b)
    left2, right2 = _halves(w, turned, g[b], two, a, b)
    add_outer(values, at, 0.0, (one[0], left1, two[0], left2), (right1, one[0], right2, two[0]))


@kernel(forceinline=True)
def _add_height(at, w, ga, turn, a, values):  # type: ignore[no-untyped-def]
    """Add the block of a point of the edge, or the opposite corner, and the opposite corner."""
    n, o, slopes, _ = turn
    left = combined(w * o[2], ga, o[a], slopes[2])
    add_outer(values, at, 0.0, (n, left), (scaled(o[2], slopes[a]), n))


@kernel(forceinline=True)
def _times(z, turn):  # type: ignore[no-untyped-def]
    """A triangle's turn with −z ∇b and z t."""
    n, o, (b0, b1, b2), t = turn
    return n, o, (scaled(-z, b0), scaled(-z, b1), scaled(-z, b2)), scaled(z, t)


@kernel()
def _add_faded(points, theta, k, rest, limits, blend, weight, offsets, values):  # type: ignore[no-untyped-def]
    """Add weight times the blocks of one hinge, of triangles that have nearly no area."""
    gradient, blocks = np.empty((4, 3)), np.empty((4, 4, 3, 3))
    x0, x1, x2, x3 = points
    hinge_hessian(x0, x1, x2, x3, theta, k, rest, limits, blend, gradient, blocks)
    add_element(weight, blocks, offsets, values)


@kernel()
def add_exact(x, s, theta, blend, k, rest, limit, weight, offsets, values):  # type: ignore[no-untyped-def]
    """Add weight (E,) times the blocks of ``hinge_hessian``, angles theta (E,); ``blend`` 0 is exact."""
    for h in range(s.shape[0]):
        fetch_ahead(h, offsets, values)
        x0, x1, x2, x3 = point(x, s[h, 0]), point(x, s[h, 1]), point(x, s[h, 2]), point(x, s[h, 3])
        e, o1, o2 = minus(x1, x0), minus(x2, x0), minus(x3, x0)
        m1, m2 = cross(e, o1), cross(o2, e)
        at = offsets[h]
        if not (dot(m1, m1) > limit[h, 0] and dot(m2, m2) > limit[h, 1]):
            limits = limit[h, 0], limit[h, 1]
            _add_faded((x0, x1, x2, x3), theta[h], k[h], rest[h], limits, blend, weight[h], at, values)
            continue
        length = math.sqrt(dot(e, e))
        u = scaled(1.0 / length, e)
        w = 2.0 * k[h] * weight[h]
        z = (1.0 - blend) * w * (theta[h] - rest[h])
        one = _times(z, triangle_turn(length, u, o1, m1))
        two = _times(z, triangle_turn(length, u, o2, m2))
        n1, n2, p, q = one[0], two[0], one[1], two[1]
        g = combined(p[0], n1, q[0], n2), combined(p[1], n1, q[1], n2)
        _add_edge(at[0], w, 1.0, g, one, two, 0, 0, values)
        _add_edge(at[1], w, -1.0, g, one, two, 0, 1, values)
        _add_height(at[2], w, g[0], one, 0, values)
        _add_height(at[3], w, g[0], two, 0, values)
        _add_edge(at[4], w, 1.0, g, one, two, 1, 1, values)
        _add_height(at[5], w, g[1], one, 1, values)
        _add_height(at[6], w, g[1], two, 1, values)
        _add_height(at[7], w, scaled(p[2], n1), one, 2, values)
        add_outer(values, at[8], 0.0, (scaled(w * p[2] * q[2], n1),), (n2,))
        _add_height(at[9], w, scaled(q[2], n2), two, 2, values)
