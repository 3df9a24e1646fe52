"""Hessians of hinges added straight to block rows, as ``scatter`` adds blocks.

Of each hinge the blocks (0, 0), (0, 1), …, (3, 3) on and above the diagonal; ``hinge_energy`` has them all.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.block_rows.scatter import add_element
from lyra_petsc.terms.hinge import angle_slopes, cross, dot, minus, point, triangle_turn
from lyra_petsc.terms.hinge_energy import hinge_hessian, hinge_stiffness
from lyra_petsc.terms.kernel import kernel


@kernel(inline="always")
def _add_outer(w, p, q, block):  # type: ignore[no-untyped-def]
    """block += w p qᵀ."""
    for i in range(3):
        wp = w * p[i]
        block[i, 0] += wp * q[0]
        block[i, 1] += wp * q[1]
        block[i, 2] += wp * q[2]


@kernel()
def add_regularised(x, s, k, limit, weight, offsets, values):  # type: ignore[no-untyped-def]
    """Add weight (E,) times the regularised blocks."""
    for e in range(s.shape[0]):
        x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(x, s[e, 3])
        g, square1, square2 = angle_slopes(x0, x1, x2, x3)
        w = weight[e] * hinge_stiffness(square1, square2, k[e], limit[e, 0], limit[e, 1])
        if w == 0.0:  # where θ itself may be no number
            continue
        pair = 0
        for a in range(4):
            for b in range(a, 4):
                at = offsets[e, pair]
                pair += 1
                if at >= 0:
                    p, q = g[a], g[b]
                    if at & 1:
                        p, q = q, p
                    _add_outer(w, p, q, values[at >> 1])


@kernel(forceinline=True)
def _scaled(factor, v):  # type: ignore[no-untyped-def]
    return factor * v[0], factor * v[1], factor * v[2]


@kernel(forceinline=True)
def _add_three(at, p, q, one, values):  # type: ignore[no-untyped-def]
    """Add p qᵀ + n dᵀ + b nᵀ, the last two of one triangle's turn."""
    if at < 0:
        return
    n, d, b = one
    block = values[at >> 1]
    if at & 1:
        for i in range(3):
            for j in range(3):
                block[i, j] += q[i] * p[j] + d[i] * n[j] + n[i] * b[j]
    else:
        for i in range(3):
            for j in range(3):
                block[i, j] += p[i] * q[j] + n[i] * d[j] + b[i] * n[j]


@kernel(forceinline=True)
def _add_five(at, p, q, one, two, values):  # type: ignore[no-untyped-def]
    """Add p qᵀ + n dᵀ + b nᵀ + m fᵀ + c mᵀ, all but the first of two triangles' turns."""
    if at < 0:
        return
    (n, d, b), (m, f, c) = one, two
    block = values[at >> 1]
    if at & 1:
        for i in range(3):
            for j in range(3):
                block[i, j] += q[i] * p[j] + d[i] * n[j] + n[i] * b[j] + f[i] * m[j] + m[i] * c[j]
    else:
        for i in range(3):
            for j in range(3):
                block[i, j] += p[i] * q[j] + n[i] * d[j] + b[i] * n[j] + m[i] * f[j] + c[i] * m[j]


@kernel(forceinline=True)
def _pair(t, scale, c, d):  # type: ignore[no-untyped-def]
    """n, scale ∂ω_c/∂x_d and −scale ω_c ∇b_d of a triangle's turn t."""
    return t[0], _scaled(scale, t[3][c][d]), _scaled(-scale * t[1][c], t[2][d])


@kernel()
def add_exact(x, s, blend, k, rest, limit, weight, offsets, values):  # type: ignore[no-untyped-def]
    """Add weight (E,) times the blocks of ``hinge_hessian``; ``blend`` 0 is exact."""
    gradient, blocks = np.empty((4, 3)), np.empty((4, 4, 3, 3))
    for h in range(s.shape[0]):
        x0, x1, x2, x3 = point(x, s[h, 0]), point(x, s[h, 1]), point(x, s[h, 2]), point(x, s[h, 3])
        g, square1, square2 = angle_slopes(x0, x1, x2, x3)
        if not (square1 > limit[h, 0] and square2 > limit[h, 1]):
            limit1, limit2 = limit[h, 0], limit[h, 1]
            hinge_hessian(x0, x1, x2, x3, k[h], rest[h], limit1, limit2, blend, gradient, blocks)
            add_element(weight[h], blocks, offsets[h], values)
            continue
        e, o1, o2 = minus(x1, x0), minus(x2, x0), minus(x3, x0)
        length = math.sqrt(dot(e, e))
        u = _scaled(1.0 / length, e)
        n1, n2 = cross(e, o1), cross(o2, e)
        change = math.atan2(dot(cross(n1, n2), u), dot(n1, n2)) - rest[h]
        w = 2.0 * k[h] * weight[h]
        z = (1.0 - blend) * w * change
        one, two = triangle_turn(e, length, u, o1, 0), triangle_turn(e, length, u, o2, 1)
        p0, p1, p2 = _scaled(w, g[0]), _scaled(w, g[1]), _scaled(w, g[2])
        at = offsets[h]
        _add_five(at[0], p0, g[0], _pair(one, z, 0, 0), _pair(two, z, 0, 0), values)
        _add_five(at[1], p0, g[1], _pair(one, z, 0, 1), _pair(two, z, 0, 1), values)
        _add_three(at[2], p0, g[2], _pair(one, z, 0, 2), values)
        _add_three(at[3], p0, g[3], _pair(two, z, 0, 2), values)
        _add_five(at[4], p1, g[1], _pair(one, z, 1, 1), _pair(two, z, 1, 1), values)
        _add_three(at[5], p1, g[2], _pair(one, z, 1, 2), values)
        _add_three(at[6], p1, g[3], _pair(two, z, 1, 2), values)
        _add_three(at[7], p2, g[2], _pair(one, z, 2, 2), values)
        if at[8] >= 0:
            p, q = (g[3], g[2]) if at[8] & 1 else (g[2], g[3])
            _add_outer(w, p, q, values[at[8] >> 1])
        _add_three(at[9], _scaled(w, g[3]), g[3], _pair(two, z, 2, 2), values)
