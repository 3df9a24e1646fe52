"""Hessians of hinges added straight to block rows, triangle by triangle.

A hinge has ∂θ/∂x_c = ω_c n at the corners of each of its triangles, and its Hessian k' ∇θ ∇θᵀ + z ∂²θ, with
k' = 2 k w w and z = 2 k (θ − θ̄), is made of blocks in either triangle and one across, of the two opposite
vertices. All blocks of a triangle with normal n are of the form n Rᵀ + L nᵀ, whichever of its sides they come
from: six blocks are added for the three hinges that have thirty. ∂²θ is that of ``hinge.triangle_turn``.

With the cotangents c of the corners' angles, ℓ = c_i + c_j of the side between i and j, of length √s, and K
opposite to it, ω is (c_j, c_i, −ℓ)/√s at (i, j, K): what the side gives is k'/s and z/√s times products of
γ = (c_j, c_i, −ℓ).
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel
from lyra_petsc.kernels.scatter import AHEAD, add_element, fetch_ahead
from lyra_petsc.kernels.vectors import add_outers, add_six, fetch
from lyra_petsc.terms.hinge import cross, dot, minus, point, scaled
from lyra_petsc.terms.hinge_energy import hinge_hessian
from lyra_petsc.terms.hinge_forces import limits_of
from lyra_petsc.terms.hinge_shape import fades, triangles_at


@kernel(inline="always")
def _ends(corner):  # type: ignore[no-untyped-def]
    """The two other corners of a triangle, in its sense."""
    return (corner + 1 if corner < 2 else 0), (corner - 1 if corner > 0 else 2)


@kernel(inline="always")
def _pair(a, b):  # type: ignore[no-untyped-def]
    """Which of a triangle's couplings (0, 0), (0, 1), …, (2, 2) is that of two corners."""
    low, high = min(a, b), max(a, b)
    return low * (5 - low) // 2 + high


@kernel(inline="always")
def _same_block(at, swapped):  # type: ignore[no-untyped-def]
    """Offset of the same block, added transposed where ``swapped``."""
    return 2 * (at >> 1) + int(swapped) if at >= 0 else at


@kernel()
def hinge_offsets(h, s, sides, within, across, out):  # type: ignore[no-untyped-def]
    """Offsets of all couplings of hinge h, into out (10,)."""
    one, two, p, q = sides[h, 0] >> 2, sides[h, 1] >> 2, sides[h, 0] & 3, sides[h, 1] & 3
    (i, j), (m, k) = _ends(p), _ends(q)  # the second triangle runs along the edge the other way
    out[0] = within[one, _pair(i, i)]
    out[1] = _same_block(within[one, _pair(i, j)], s[h, 0] < s[h, 1])
    out[2] = _same_block(within[one, _pair(i, p)], s[h, 0] < s[h, 2])
    out[3] = _same_block(within[two, _pair(k, q)], s[h, 0] < s[h, 3])
    out[4] = within[one, _pair(j, j)]
    out[5] = _same_block(within[one, _pair(j, p)], s[h, 1] < s[h, 2])
    out[6] = _same_block(within[two, _pair(m, q)], s[h, 1] < s[h, 3])
    out[7] = within[one, _pair(p, p)]
    out[8] = across[h]
    out[9] = within[two, _pair(q, q)]


@kernel()
def _add_faded(x, h, s, theta, k, rest, limits, blend, weight, offsets, values):  # type: ignore[no-untyped-def]
    """Add weight times the blocks of a hinge of triangles that have nearly no area."""
    gradient, blocks = np.empty((4, 3)), np.empty((4, 4, 3, 3))
    x0, x1, x2, x3 = point(x, s[h, 0]), point(x, s[h, 1]), point(x, s[h, 2]), point(x, s[h, 3])
    hinge_hessian(x0, x1, x2, x3, theta[h], k[h], rest[h], limits, blend, gradient, blocks)
    add_element(weight[h], blocks, offsets, values)


@kernel()
def add_across(  # type: ignore[no-untyped-def]
    x, s, sides, shape, theta, length, blend, k, rest, limit, weight, within, across, values, factors
):
    """Add weight (E,) times the blocks across hinges; ``blend`` 0 is exact.

    The factors (E + 1, 2) are those that ``add_within`` takes. Hinges of triangles that fade are added whole,
    with factors 0.
    """
    offsets = np.empty(10, dtype=within.dtype)
    factors[-1, 0] = factors[-1, 1] = 0.0
    for h in range(s.shape[0]):
        fetch(values, across[min(h + AHEAD, s.shape[0] - 1)] >> 1)
        if fades(shape, sides, h):
            factors[h, 0] = factors[h, 1] = 0.0
            hinge_offsets(h, s, sides, within, across, offsets)
            limits = limits_of(limit, sides, h)
            _add_faded(x, h, s, theta, k, rest, limits, blend, weight, offsets, values)
            continue
        one, two = triangles_at(sides, h)
        square = length[h] * length[h]
        stiffness = 2.0 * k[h] * weight[h] / square
        factors[h, 0], factors[h, 1] = stiffness, (1.0 - blend) * stiffness * (theta[h] - rest[h]) * length[h]
        areas = shape[one, 6] * shape[two, 6]
        left = scaled(stiffness * square * square / areas, (shape[one, 0], shape[one, 1], shape[one, 2]))
        right = shape[two, 0], shape[two, 1], shape[two, 2]
        add_outers(values, across[h], 0.0, ((left, right),))


@kernel(inline="always")
def _beyond(hinge, sides, shape, factors):  # type: ignore[no-untyped-def]
    """Beyond a side: its factors, the first times γ at the side's ends in our sense, and the normal."""
    h = Index(hinge >> 1)
    side = sides[h, Index(1 - (hinge & 1))]
    t, (i, j) = Index(side >> 2), _ends(side & 3)
    stiff = factors[h, 0]
    normal = shape[t, 0], shape[t, 1], shape[t, 2]
    return stiff, factors[h, 1], stiff * shape[t, Index(3 + i)], stiff * shape[t, Index(3 + j)], normal


@kernel(forceinline=True)
def _own(n, g, corner, one, other):  # type: ignore[no-untyped-def]
    """R and L of a corner and itself; of the two sides at it ``one`` and ``other``."""
    _, _, turn, slope, _ = corner
    (p, n1, t1), (q, n2, t2) = one, other
    left = (-turn, slope), (1.0, t1), (1.0, t2)
    return ((g, n), (p, n1), (q, n2), *left), left


@kernel(forceinline=True)
def _pair_of(n, g, a, b, side, p_ab, p_ba):  # type: ignore[no-untyped-def]
    """R and L of corners a and b, with the side between them; p are those beyond their opposite sides."""
    ca, la, oa, slope_a, na = a
    cb, lb, ob, slope_b, nb = b
    pa, pb, nm, t = side
    right = (g, n), (0.5 * cb * pb, nm), (-la * p_ab, na), (-ob, slope_a), (-1.0, t)
    left = (0.5 * ca * pa, nm), (-lb * p_ba, nb), (-oa, slope_b), (-1.0, t)
    return right, left


@kernel()
def add_within(x, corners, hinges, sides, shape, factors, offsets, values):  # type: ignore[no-untyped-def]
    """Add the blocks of triangles with ``offsets`` (T, 6).

    Of the blocks n n'ᵀ and n' nᵀ of a side's ends each of its two triangles adds a half.
    """
    for t in range(corners.shape[0]):
        fetch_ahead(t, offsets, values, 6)
        if shape[t, 6] == 0.0:
            continue
        x0, x1, x2 = point(x, corners[t, 0]), point(x, corners[t, 1]), point(x, corners[t, 2])
        e0, e1, e2 = minus(x2, x1), minus(x0, x2), minus(x1, x0)
        n = shape[t, 0], shape[t, 1], shape[t, 2]
        c0, c1, c2 = shape[t, 3], shape[t, 4], shape[t, 5]
        inverse = 1.0 / shape[t, 6]
        l0, l1, l2 = inverse * dot(e0, e0), inverse * dot(e1, e1), inverse * dot(e2, e2)
        m = scaled(inverse, n)
        b0, b1, b2 = cross(m, e0), cross(m, e1), cross(m, e2)  # gradients of the barycentric coordinates
        w0, z0, p01, p02, n0 = _beyond(hinges[t, 0], sides, shape, factors)
        w1, z1, p12, p10, n1 = _beyond(hinges[t, 1], sides, shape, factors)
        w2, z2, p20, p21, n2 = _beyond(hinges[t, 2], sides, shape, factors)
        t0, t1, t2 = scaled(0.5 * z0 / l0, b0), scaled(0.5 * z1 / l1, b1), scaled(0.5 * z2 / l2, b2)
        one = c0, l0, z1 * c2 + z2 * c1 - z0 * l0, b0, n0
        two = c1, l1, z0 * c2 + z2 * c0 - z1 * l1, b1, n1
        three = c2, l2, z0 * c1 + z1 * c0 - z2 * l2, b2, n2
        g00 = w0 * l0 * l0 + w1 * c2 * c2 + w2 * c1 * c1
        g01 = w2 * c0 * c1 - w0 * l0 * c2 - w1 * l1 * c2
        g02 = w1 * c0 * c2 - w0 * l0 * c1 - w2 * l2 * c1
        g11 = w0 * c2 * c2 + w1 * l1 * l1 + w2 * c0 * c0
        g12 = w0 * c1 * c2 - w1 * l1 * c0 - w2 * l2 * c0
        g22 = w0 * c1 * c1 + w1 * c0 * c0 + w2 * l2 * l2
        blocks = (
            _own(n, g00, one, (c2 * p10, n1, t1), (c1 * p20, n2, t2)),
            _pair_of(n, g01, one, two, (p20, p21, n2, t2), p01, p10),
            _pair_of(n, g02, one, three, (p10, p12, n1, t1), p02, p20),
            _own(n, g11, two, (c2 * p01, n0, t0), (c0 * p21, n2, t2)),
            _pair_of(n, g12, two, three, (p01, p02, n0, t0), p12, p21),
            _own(n, g22, three, (c1 * p02, n0, t0), (c0 * p12, n1, t1)),
        )
        add_six(values, offsets, t, n, blocks)
