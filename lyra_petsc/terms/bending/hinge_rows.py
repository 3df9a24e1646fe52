"""Hessians of hinges, assembled by triangles directly into block rows.

A hinge has ∂θ/∂x_c = ω_c n at the corners of each of its triangles. Its Hessian k' ∇θ ∇θᵀ + z ∂²θ, with
k' = 2 k w w and z = 2 k (θ − θ̄), consists of blocks *within* each of the two triangles and one block *across*
the edge, which couples the two opposite vertices. All blocks within a triangle of normal n have the form
n Rᵀ + L nᵀ, for each of its sides: six blocks are added for three hinges, which have thirty. ∂²θ is as in
``hinge.triangle_derivatives``.

Let c be the cotangents of the corners' angles, i and j the ends of a side of length √s, K the corner opposite
it, and ℓ = c_i + c_j. Then ω is (c_j, c_i, −ℓ)/√s at (i, j, K), and the side contributes k'/s and z/√s times
products of γ = (c_j, c_i, −ℓ).
"""

from __future__ import annotations

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import inlined, kernel
from lyra_petsc.kernels.scatter import AHEAD, fetch_ahead
from lyra_petsc.kernels.vector3 import cross, dot, minus, point, scaled
from lyra_petsc.kernels.vectors import add_outers, add_six, fetch
from lyra_petsc.terms.bending.hinge_shape import fades, triangles_at


@inlined()
def ends(corner):  # type: ignore[no-untyped-def]
    """The two other corners of a triangle, in its orientation."""
    return (corner + 1 if corner < 2 else 0), (corner - 1 if corner > 0 else 2)


@kernel()
def add_across(sides, shape, theta, length, convexity, k, rest, weight, across, values, factors):  # type: ignore[no-untyped-def]
    """Add weight (E,) times the blocks across the hinges' edges; ``convexity`` 0 is exact.

    Writes ``factors`` (E + 1, 2), k'/s and z/√s times the weight, for ``add_within``; 0 for hinges that fade,
    which are left out.
    """
    n = len(k)
    factors[-1, 0] = factors[-1, 1] = 0.0
    for h in range(n):
        fetch(values, across[min(h + AHEAD, n - 1)] >> 1)
        if fades(shape, sides, h):
            factors[h, 0] = factors[h, 1] = 0.0
            continue
        one, two = triangles_at(sides, h)
        square = length[h] * length[h]
        stiffness = 2.0 * k[h] * weight[h] / square
        turned = (1.0 - convexity) * stiffness * (theta[h] - rest[h]) * length[h]
        factors[h, 0], factors[h, 1] = stiffness, turned
        areas = shape[one, 6] * shape[two, 6]
        left = scaled(stiffness * square * square / areas, (shape[one, 0], shape[one, 1], shape[one, 2]))
        right = shape[two, 0], shape[two, 1], shape[two, 2]
        add_outers(values, across[h], 0.0, ((left, right),))


@inlined()
def _beyond_side(hinge, sides, shape, factors):  # type: ignore[no-untyped-def]
    """Data of the triangle beyond a side: the hinge's two factors, the first of them times γ of that triangle
    at the side's two ends (in the order of this triangle), and the normal.
    """
    h = Index(hinge >> 1)
    side = sides[h, Index(1 - (hinge & 1))]
    t, (i, j) = Index(side >> 2), ends(side & 3)
    stiff = factors[h, 0]
    normal = shape[t, 0], shape[t, 1], shape[t, 2]
    return stiff, factors[h, 1], stiff * shape[t, Index(3 + i)], stiff * shape[t, Index(3 + j)], normal


@inlined()
def _diagonal_block(n, g, corner, one, other):  # type: ignore[no-untyped-def]
    """R and L of the diagonal block of a corner, with the two sides ``one`` and ``other`` at it."""
    _, _, turn, slope, _ = corner
    (p, n1, t1), (q, n2, t2) = one, other
    left = (-turn, slope), (1.0, t1), (1.0, t2)
    return ((g, n), (p, n1), (q, n2), *left), left


@inlined()
def _off_diagonal_block(n, g, a, b, side, p_ab, p_ba):  # type: ignore[no-untyped-def]
    """R and L of the block of corners a and b, with the side between them.

    p_ab and p_ba are the values at b and a beyond the sides opposite a and b.
    """
    ca, la, oa, slope_a, na = a
    cb, lb, ob, slope_b, nb = b
    pa, pb, nm, t = side
    right = (g, n), (0.5 * cb * pb, nm), (-la * p_ab, na), (-ob, slope_a), (-1.0, t)
    left = (0.5 * ca * pa, nm), (-lb * p_ba, nb), (-oa, slope_b), (-1.0, t)
    return right, left


@kernel()
def add_within(x, corners, hinges, sides, shape, factors, offsets, values):  # type: ignore[no-untyped-def]
    """Add the blocks within triangles at ``offsets`` (T, 6), with the ``factors`` of `add_across`.

    The blocks n n'ᵀ and n' nᵀ of a side's ends are shared: each of the two triangles adds one half.
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
        w0, z0, p01, p02, n0 = _beyond_side(hinges[t, 0], sides, shape, factors)
        w1, z1, p12, p10, n1 = _beyond_side(hinges[t, 1], sides, shape, factors)
        w2, z2, p20, p21, n2 = _beyond_side(hinges[t, 2], sides, shape, factors)
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
            _diagonal_block(n, g00, one, (c2 * p10, n1, t1), (c1 * p20, n2, t2)),
            _off_diagonal_block(n, g01, one, two, (p20, p21, n2, t2), p01, p10),
            _off_diagonal_block(n, g02, one, three, (p10, p12, n1, t1), p02, p20),
            _diagonal_block(n, g11, two, (c2 * p01, n0, t0), (c0 * p21, n2, t2)),
            _off_diagonal_block(n, g12, two, three, (p01, p02, n0, t0), p12, p21),
            _diagonal_block(n, g22, three, (c1 * p02, n0, t0), (c0 * p12, n1, t1)),
        )
        add_six(values, offsets, t, n, blocks)
