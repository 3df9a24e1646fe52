"""Distances between simplices and the barrier energy of close pairs: pure functions on arrays.

A pair consists of four points: a vertex p0 and a triangle p1 p2 p3, or two edges p0 p1 and p2 p3. The vector
between the nearest points of both is g = Σ β_i p_i. None to two barycentric coordinates t_k are free at the
nearest points; their coefficients are γ_k = ∂β/∂t_k. With e_k = Σ γ_ki p_i and A_kl = e_k · e_l the
derivatives of s = ½ |g|², which is minimal over the t_k, are::

    ∂s/∂p_i = β_i g
    ∂²s/∂p_i∂p_j = β_i β_j I − Σ_kl A⁻¹_kl (β_i e_k + γ_ki g)(β_j e_l + γ_lj g)ᵀ

The barrier is a function of δ = |g| − offset::

    b(δ) = k (gap − δ)³ / δ  for 0 < δ < gap, 0 beyond, infinite at δ ≤ 0

as in Li, Ferguson, Schneider, Langlois, Zorin, Panozzo, Jiang & Kaufman, Incremental potential contact, ACM
Trans. Graph. 39 (2020) 49, except that their logarithm grows so slowly that fast points come to rest only at
distances near 0.

The nearest points of parallel edges are not unique. The energy of two edges u and v at an angle θ is
therefore multiplied by the mollifier m = c (2 − c), c = min(1, sin² θ / parallel), so that forces are
continuous. Where parallel edges lie side by side, pairs of vertices and triangles are equally near (same
source, section 5.2, with |u × v|² over rest lengths).

Points of obstacles have negative numbers: ~number in the array of the obstacles' points.

Pairs whose nearest points are the same two vertices, or the same vertex and point of an edge, have the same
energy. They are evaluated once, with a weight that says how often they count.

A vertex of a sheet in front of a surface is repelled once, however many triangles are near, by inclusion and
exclusion: the energies of the triangles, less those of the edges between them, plus those of their inner
vertices (Li, Ferguson, Schneider, Langlois, Zorin, Panozzo, Jiang & Kaufman, Convergent incremental potential
contact, arXiv:2307.15908). In front of a flat surface, where the nearest points of neighbouring triangles
coincide, one pair is left. Each triangle has a share of its sides and corners (`surface_shares`).

In all functions x (n_local, 3) [m] are positions of the sheets' vertices and x_obs (m, 3) [m] those of
the obstacles' points; dx and dx_obs are displacements [m]; kind (E,) and points (E, 4) are the pairs.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import inlined, kernel, leaf
from lyra_petsc.kernels.scatter import AHEAD, add_element, fetch_ahead
from lyra_petsc.kernels.vector3 import combined, cross, dot, minus, scaled
from lyra_petsc.kernels.vectors import add_outers

VERTEX_TRIANGLE, EDGE_EDGE, VERTEX_PLANE, VERTEX_INSIDE = 0, 1, 2, 3
"""Kinds of pairs. A plane is given by a point p1 and a unit normal p2. A vertex inside (of a ball or capsule)
stays within a radius of a segment p1 p2; its distance is −|g|. p3 is not used by these two."""

NEGLIGIBLE = 1e-6
"""Weight below which a pair is left out."""

MAX_POINTS = 256
"""Nearest points of one vertex that are compared with each other, at most."""

CCD_TOLERANCE = 0.1
"""Part of the distance to be covered up to the minimum distance at which continuous collision detection
stops."""

MAX_ADVANCES = 1000
"""Advances of continuous collision detection for one pair, at most: they are short where long displacements
lead past each other."""

BISECTIONS = 30
"""Bisections in the search for the distance at which the barrier has a given force."""

MIN_CHORD = 1e-3
"""Length of a chord over the gap below which it is replaced by the tangent."""

PARALLEL = 1e-12
"""Squared sine of the angle of two edges or triangle sides below which they are treated as parallel."""


@inlined()
def _segment_parameter(p, a, b):  # type: ignore[no-untyped-def]
    """Parameter t of the point of segment a b that is nearest to p: 0 at a, 1 at b."""
    dx = minus(b, a)
    square = dot(dx, dx)
    t = dot(minus(p, a), dx) / square if square > 0.0 else 0.0
    return min(max(t, 0.0), 1.0)


@inlined()
def _nearest_on_segment(p, a, b):  # type: ignore[no-untyped-def]
    """Parameter t of the nearest point of segment a b, and its squared distance from p."""
    t = _segment_parameter(p, a, b)
    g = p[0] - a[0] - t * (b[0] - a[0]), p[1] - a[1] - t * (b[1] - a[1]), p[2] - a[2] - t * (b[2] - a[2])
    return t, dot(g, g)


@inlined()
def _nearest_in_triangle(p, a, b, c):  # type: ignore[no-untyped-def]
    """Barycentric coordinates v and w (of b and c) of the point of a triangle that is nearest to p.

    Regions as in Ericson, Real-time collision detection (2005), 5.1.5.
    """
    ab, ac, ap = minus(b, a), minus(c, a), minus(p, a)
    normal = cross(ab, ac)
    if not dot(normal, normal) > PARALLEL * dot(ab, ab) * dot(ac, ac):
        # degenerate: the nearest point is on a side, and the rest would be dominated by rounding
        t, to_ab = _nearest_on_segment(p, a, b)
        u, to_bc = _nearest_on_segment(p, b, c)
        v, to_ca = _nearest_on_segment(p, c, a)
        if to_ab <= to_bc and to_ab <= to_ca:
            return t, 0.0
        return (1.0 - u, u) if to_bc <= to_ca else (0.0, 1.0 - v)
    d1, d2 = dot(ab, ap), dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0
    bp = minus(p, b)
    d3, d4 = dot(ab, bp), dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0
    cp = minus(p, c)
    d5, d6 = dot(ab, cp), dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0
    if d1 * d4 - d3 * d2 <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return _segment_parameter(p, a, b), 0.0
    if d5 * d2 - d1 * d6 <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return 0.0, _segment_parameter(p, a, c)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        t = _segment_parameter(p, b, c)
        return 1.0 - t, t
    total = va + vb + vc
    return vb / total, vc / total


@kernel()
def _nearest_on_edges(a, b, c, d):  # type: ignore[no-untyped-def]
    """Parameters s and t of the nearest points of edges a b and c d: 0 at a and c, 1 at b and d.

    As in Ericson, 5.1.9.
    """
    u, v, w = minus(b, a), minus(d, c), minus(a, c)
    uu, uv, vv, uw, vw = dot(u, u), dot(u, v), dot(v, v), dot(u, w), dot(v, w)
    det = uu * vv - uv * uv
    if not det > PARALLEL * uu * vv:
        # an end of one of the edges is equally near
        t, to_a = _nearest_on_segment(a, c, d)
        best, s = to_a, 0.0
        other, to_b = _nearest_on_segment(b, c, d)
        if to_b < best:
            best, s, t = to_b, 1.0, other
        other, to_c = _nearest_on_segment(c, a, b)
        if to_c < best:
            best, s, t = to_c, other, 0.0
        other, to_d = _nearest_on_segment(d, a, b)
        if to_d < best:
            s, t = other, 1.0
        return s, t
    s = min(max((uv * vw - vv * uw) / det, 0.0), 1.0)
    t = (uv * s + vw) / vv
    if t < 0.0:
        s, t = min(max(-uw / uu, 0.0), 1.0), 0.0
    elif t > 1.0:
        s, t = min(max((uv - uw) / uu, 0.0), 1.0), 1.0
    return s, t


@leaf()
def _nearest_coefficients(kind, p):  # type: ignore[no-untyped-def]
    """β of the nearest points of a pair at p (4, 3)."""
    a, b = (p[0, 0], p[0, 1], p[0, 2]), (p[1, 0], p[1, 1], p[1, 2])
    c, d = (p[2, 0], p[2, 1], p[2, 2]), (p[3, 0], p[3, 1], p[3, 2])
    if kind == EDGE_EDGE:
        s, t = _nearest_on_edges(a, b, c, d)
        return 1.0 - s, s, t - 1.0, -t
    if kind == VERTEX_INSIDE:
        t = _segment_parameter(a, b, c)
        return 1.0, t - 1.0, -t, 0.0
    v, w = _nearest_in_triangle(a, b, c, d)
    return 1.0, v + w - 1.0, -v, -w


@leaf()
def _norm(p, b0, b1, b2, b3):  # type: ignore[no-untyped-def]
    """|g| for coefficients β."""
    square = 0.0
    for k in range(3):
        g = b0 * p[0, k] + b1 * p[1, k] + b2 * p[2, k] + b3 * p[3, k]
        square += g * g
    return math.sqrt(square)


@leaf()
def distance(kind, p):  # type: ignore[no-untyped-def]
    """Distance of a pair at p (4, 3): |g|, or −|g| inside of a container.

    For a plane it is negative behind the plane; p1 to p3 are overwritten by `_plane_to_triangle`.
    """
    behind = kind == VERTEX_INSIDE
    if kind == VERTEX_PLANE:
        behind = _plane_to_triangle(p)
    b0, b1, b2, b3 = _nearest_coefficients(kind, p)
    length = _norm(p, b0, b1, b2, b3)
    return -length if behind else length


@leaf()
def _free_coordinates(kind, beta, gamma):  # type: ignore[no-untyped-def]
    """Write γ (2, 4) at nearest points with β (4,); returns the number of free coordinates."""
    gamma[:] = 0.0
    free = 0
    if kind == EDGE_EDGE:
        for first in (0, 2):
            if beta[first] != 0.0 and beta[first + 1] != 0.0:
                gamma[free, first], gamma[free, first + 1] = first - 1.0, 1.0 - first
                free += 1
        return free
    last = -1
    for i in range(1, 4):
        if beta[i] != 0.0:
            if last > 0:
                gamma[free, last], gamma[free, i] = 1.0, -1.0
                free += 1
            else:
                last = i
    return free


@leaf()
def box_distance(p, kind):  # type: ignore[no-untyped-def]
    """Distance of the boxes around both simplices of a pair at p (4, 3): a lower bound of the pair's
    distance.

    −∞ for planes and containers.
    """
    if kind > EDGE_EDGE:
        return -math.inf
    square = 0.0
    for k in range(3):
        if kind == EDGE_EDGE:
            low, high = min(p[0, k], p[1, k]), max(p[0, k], p[1, k])
            other_low, other_high = min(p[2, k], p[3, k]), max(p[2, k], p[3, k])
        else:
            low = high = p[0, k]
            other_low, other_high = min(p[1, k], p[2, k], p[3, k]), max(p[1, k], p[2, k], p[3, k])
        apart = max(other_low - high, low - other_high, 0.0)
        square += apart * apart
    return math.sqrt(square)


@leaf()
def _plane_to_triangle(p):  # type: ignore[no-untyped-def]
    """Replace the plane (point p1, normal p2) by a triangle p1 p2 p3 in it around the projection of p0.

    Returns whether p0 lies behind the plane.
    """
    height, axis = 0.0, 0
    length = math.sqrt(
        p[2, 0] ** 2 + p[2, 1] ** 2 + p[2, 2] ** 2
    )  # not 1 within a step in which the plane turns
    n = p[2, 0] / length, p[2, 1] / length, p[2, 2] / length
    for k in range(3):
        height += n[k] * (p[0, k] - p[1, k])
        if abs(n[k]) < abs(n[axis]):
            axis = k
    one = 1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0, 1.0 if axis == 2 else 0.0
    u = cross(n, one)
    v = cross(n, u)
    for k in range(3):
        foot = p[0, k] - height * n[k]
        p[1, k], p[2, k], p[3, k] = foot + u[k], foot + v[k], foot - u[k] - v[k]
    return height < 0.0


@leaf()
def _load_points(x, x_obs, points, e, p):  # type: ignore[no-untyped-def]
    """Copy the points of pair e, vertices of sheets or points of obstacles, to p (4, 3)."""
    for i in range(4):
        number = points[e, i]
        if number >= 0:
            n = Index(number)
            p[i, 0], p[i, 1], p[i, 2] = x[n, 0], x[n, 1], x[n, 2]
        else:
            n = Index(~number)
            p[i, 0], p[i, 1], p[i, 2] = x_obs[n, 0], x_obs[n, 1], x_obs[n, 2]


@kernel(forceinline=True)  # not `inlined`, as δ may be an array
def barrier(delta, gap):  # type: ignore[no-untyped-def]
    """b / k for 0 < δ < gap and its first two derivatives."""
    left, part = gap - delta, gap / delta
    return left**3 / delta, left * left * (-2.0 - part) / delta, 2.0 * (part**3 - 1.0)


@leaf()
def _edge_products(p):  # type: ignore[no-untyped-def]
    """u·u, u·v and v·v for the edges u = p0 p1 and v = p2 p3."""
    uu = uv = vv = 0.0
    for k in range(3):
        u, v = p[1, k] - p[0, k], p[3, k] - p[2, k]
        uu, uv, vv = uu + u * u, uv + u * v, vv + v * v
    return uu, uv, vv


@leaf()
def _mollifier(p, parallel, slope):  # type: ignore[no-untyped-def]
    """m of edges p0 p1 and p2 p3, and m′, m″ with respect to sin² θ, whose gradient is written to slope
    (12,).
    """
    uu, uv, vv = _edge_products(p)
    square = uu * vv
    if not square > 0.0:
        return 0.0, 0.0, 0.0
    c = (square - uv * uv) / (square * parallel)
    if c >= 1.0:
        return 1.0, 0.0, 0.0
    factor = -2.0 * uv / square
    for k in range(3):
        u, v = p[1, k] - p[0, k], p[3, k] - p[2, k]
        to_u, to_v = factor * (v - uv / uu * u), factor * (u - uv / vv * v)
        slope[k], slope[3 + k], slope[6 + k], slope[9 + k] = -to_u, to_u, -to_v, to_v
    return c * (2.0 - c), 2.0 * (1.0 - c) / parallel, -2.0 / (parallel * parallel)


@kernel()
def distances(x, x_obs, kind, points, out):  # type: ignore[no-untyped-def]
    """Write the distance [m] of each pair to out (E,), as from `distance`."""
    p = np.empty((4, 3))
    for e in range(len(out)):
        _load_points(x, x_obs, points, e, p)
        out[e] = distance(kind[e], p)


@leaf()
def _nearest_vertices(kind, points, e, b0, b1, b2, b3):  # type: ignore[no-untyped-def]
    """The nearest vertices of a pair with coefficients β: a vertex, and the ends of an edge or twice a
    vertex.

    Only for pairs whose nearest points are a vertex and not the interior of a triangle.
    """
    if kind == EDGE_EDGE:
        if b0 != 0.0 and b1 != 0.0:  # the vertex belongs to the second edge
            return points[e, 2] if b2 != 0.0 else points[e, 3], points[e, 0], points[e, 1]
        v = points[e, 0] if b0 != 0.0 else points[e, 1]
        lo, hi = points[e, 2] if b2 != 0.0 else points[e, 3], points[e, 3] if b3 != 0.0 else points[e, 2]
        return v, lo, hi
    lo = points[e, 1] if b1 != 0.0 else (points[e, 2] if b2 != 0.0 else points[e, 3])
    hi = points[e, 3] if b3 != 0.0 else (points[e, 2] if b2 != 0.0 else points[e, 1])
    return points[e, 0], lo, hi


@leaf()
def _add_point(n, nearest, e, first, second, share, delta, b1, b2, b3):  # type: ignore[no-untyped-def]
    """Add ``share`` to the weight of a nearest point on the edge ``first`` ``second``, or at a vertex (both
    equal).

    A new point is appended to the lists ``nearest``: key, pair, weight, δ and β. Returns the number of
    points.
    """
    keys, pairs, weights, deltas, beta = nearest
    key = (min(first, second) << 32) | (max(first, second) & 0xFFFFFFFF)  # obstacles' points are below 0
    m = 0
    while m < n and keys[m] != key:
        m += 1
    if m < n:
        weights[m] += share
        return n
    keys[n], pairs[n], weights[n], deltas[n] = key, e, share, delta
    beta[n, 0], beta[n, 1], beta[n, 2] = b1, b2, b3
    return n + 1


@leaf()
def _add_triangle(p, points, e, offset, gap, shares, n, nearest):  # type: ignore[no-untyped-def]
    """Add the nearest points of a vertex in triangle e, on its sides and at its corners to the list.

    Returns δ of the triangle and the number of points.
    """
    a, b = (p[0, 0], p[0, 1], p[0, 2]), (p[1, 0], p[1, 1], p[1, 2])
    c, d = (p[2, 0], p[2, 1], p[2, 2]), (p[3, 0], p[3, 1], p[3, 2])
    i, j, k = points[e, 1], points[e, 2], points[e, 3]
    v, w = _nearest_in_triangle(a, b, c, d)
    b1, b2, b3 = v + w - 1.0, -v, -w
    delta = _norm(p, 1.0, b1, b2, b3) - offset
    if not delta < gap:
        return delta, n
    # a zero coefficient means that the point is on a side, and then it is also nearest on that side
    if b1 != 0.0 and b2 != 0.0 and b3 != 0.0:
        n = _add_point(n, nearest, e, -1 - e, np.int64(0), 1.0, delta, b1, b2, b3)
    else:
        first = i if b1 != 0.0 else (j if b2 != 0.0 else k)
        second = k if b3 != 0.0 else (j if b2 != 0.0 else i)
        weight = 1.0 + (shares[e, 0] if b3 == 0.0 else 0.0) + (shares[e, 1] if b1 == 0.0 else 0.0)
        weight += shares[e, 2] if b2 == 0.0 else 0.0
        if first == second:
            weight += shares[e, 3] if b1 != 0.0 else (shares[e, 4] if b2 != 0.0 else shares[e, 5])
        n = _add_point(n, nearest, e, first, second, weight, delta, b1, b2, b3)
    limit = (gap + offset) ** 2
    if b3 != 0.0 and shares[e, 0] != 0.0:
        t, square = _nearest_on_segment(a, b, c)
        if square < limit:
            first, second, side_delta = i if t < 1.0 else j, j if t > 0.0 else i, math.sqrt(square) - offset
            n = _add_point(n, nearest, e, first, second, shares[e, 0], side_delta, t - 1.0, -t, 0.0)
    if b1 != 0.0 and shares[e, 1] != 0.0:
        t, square = _nearest_on_segment(a, c, d)
        if square < limit:
            first, second, side_delta = j if t < 1.0 else k, k if t > 0.0 else j, math.sqrt(square) - offset
            n = _add_point(n, nearest, e, first, second, shares[e, 1], side_delta, 0.0, t - 1.0, -t)
    if b2 != 0.0 and shares[e, 2] != 0.0:
        t, square = _nearest_on_segment(a, d, b)
        if square < limit:
            first, second, side_delta = k if t < 1.0 else i, i if t > 0.0 else k, math.sqrt(square) - offset
            n = _add_point(n, nearest, e, first, second, shares[e, 2], side_delta, -t, 0.0, t - 1.0)
    corner = minus(a, b)
    square = dot(corner, corner)
    if square < limit and shares[e, 3] != 0.0 and (b2 != 0.0 or b3 != 0.0):
        side_delta = math.sqrt(square) - offset
        n = _add_point(n, nearest, e, i, i, shares[e, 3], side_delta, -1.0, 0.0, 0.0)
    corner = minus(a, c)
    square = dot(corner, corner)
    if square < limit and shares[e, 4] != 0.0 and (b1 != 0.0 or b3 != 0.0):
        side_delta = math.sqrt(square) - offset
        n = _add_point(n, nearest, e, j, j, shares[e, 4], side_delta, 0.0, -1.0, 0.0)
    corner = minus(a, d)
    square = dot(corner, corner)
    if square < limit and shares[e, 5] != 0.0 and (b1 != 0.0 or b2 != 0.0):
        side_delta = math.sqrt(square) - offset
        n = _add_point(n, nearest, e, k, k, shares[e, 5], side_delta, 0.0, 0.0, -1.0)
    return delta, n


@leaf()
def _write_row(  # type: ignore[no-untyped-def]
    n, pairs, weights, owned_weights, beta, energies, derivatives,
    e, weight, owned_weight, b0, b1, b2, b3, p, delta, d, gap, stiffness, mollifier,
):  # fmt: skip
    """Write an active pair to row n of the result, if that has so many rows; returns n + 1."""
    if n < len(pairs):
        energy = slope = second = 0.0
        if delta > 0.0:
            energy, slope, second = barrier(delta, gap)
        elif weight > 0.0:
            energy = slope = np.inf  # also if NaN
        pairs[n], weights[n], owned_weights[n] = e, weight, owned_weight
        energies[n] = mollifier * stiffness * energy
        beta[n, 0], beta[n, 1], beta[n, 2], beta[n, 3] = b0, b1, b2, b3
        for k in range(3):
            derivatives[n, k] = b0 * p[0, k] + b1 * p[1, k] + b2 * p[2, k] + b3 * p[3, k]
        derivatives[n, 3], derivatives[n, 4] = stiffness * slope / d, stiffness * second / (d * d)
        derivatives[n, 5] = mollifier
    return n + 1


@leaf()
def _write_points(x, x_obs, points, n_points, nearest, n_counted, offset, gap, stiffness, n, found, p):  # type: ignore[no-untyped-def]
    """Write the nearest points of a vertex whose weight is not negligible; returns the number of rows in
    ``found``.
    """
    _, pairs, weights, deltas, beta = nearest
    out_pairs, out_weights, out_owned, out_beta, energies, derivatives = found
    for m in range(n_points):
        if abs(weights[m]) <= NEGLIGIBLE:
            continue
        e, delta = pairs[m], deltas[m]
        _load_points(x, x_obs, points, e, p)
        owned_weight, d = weights[m] if e < n_counted else 0.0, delta + offset[e]
        b1, b2, b3 = beta[m, 0], beta[m, 1], beta[m, 2]
        n = _write_row(
            n, out_pairs, out_weights, out_owned, out_beta, energies, derivatives,
            e, weights[m], owned_weight, 1.0, b1, b2, b3, p, delta, d, gap[e], stiffness[e], 1.0,
        )  # fmt: skip
    return n


@kernel()
def find_active(x, x_obs, kind, points, offset, gap, stiffness, parallel, shares, n_counted, bound, found):  # type: ignore[no-untyped-def]  # fmt: skip
    """Find the pairs nearer than the gap; pairs with the same nearest vertices become one, with a weight.

    Parameters
    ----------
    gap : (E,)
        Distance less offset [m] below which pairs repel each other.
    stiffness : (E,)
        The barrier's k [N/m]; the same for all pairs of one vertex of a sheet and triangles.
    shares : (E, 6)
        For a triangle in front of a vertex of a sheet: weights of its sides (0 1), (1 2), (2 0) and of its
        corners. Pairs of one vertex that follow each other are treated together.
    n_counted : int
        Number of the first pairs, which this rank counts.
    bound : (E,)
        Output: lower bound of the distance less offset [m]; exact where it is below the gap.
    found : tuple of (capacity,), (capacity,), (capacity,), (capacity, 4), (capacity,), (capacity, 6)
        Output: numbers of pairs (one may occur several times), weight, weight on this rank, β, energy [J] for
        a weight of 1, and derivatives: g [m], b′ / d [N/m] and b″ / d² [N/m³] without mollifier, d = |g| or
        −|g|, and the mollifier.

    Returns
    -------
    n : int
        Number of active pairs; only the first ``capacity`` are written.
    """
    pairs, weights, owned_weights, out_beta, energies, derivatives = found
    p, q, slope = np.empty((4, 3)), np.empty((4, 3)), np.zeros(12)
    n: Any = np.int64(0)  # the literal 0 has a type of its own, for which callees would be compiled again
    head, link = np.full(len(x), -1), np.full(0, -1)  # linked lists of rows, by a vertex
    # nearest vertex, ends of the edge or twice a second vertex, and the first pair with these
    keys = np.empty((0, 4), dtype=np.int64)
    point_keys, point_pairs = np.empty(MAX_POINTS, np.int64), np.empty(MAX_POINTS, np.int64)
    nearest = point_keys, point_pairs, np.empty(MAX_POINTS), np.empty(MAX_POINTS), np.empty((MAX_POINTS, 3))
    n_points, vertex = n, -1
    constants = n_counted, offset, gap, stiffness
    for e in range(len(kind)):
        _load_points(x, x_obs, points, e, p)
        if kind[e] == VERTEX_TRIANGLE and points[e, 0] >= 0:
            if points[e, 0] != vertex or n_points > MAX_POINTS - 7:
                n = _write_points(x, x_obs, points, n_points, nearest, *constants, n, found, q)
                n_points, vertex = 0, points[e, 0]
            delta, n_points = _add_triangle(p, points, e, offset[e], gap[e], shares, n_points, nearest)
            bound[e] = delta
            continue
        bound[e] = box_distance(p, kind[e]) - offset[e]
        if bound[e] >= gap[e]:
            continue
        behind = kind[e] == VERTEX_INSIDE
        if kind[e] == VERTEX_PLANE:
            behind = _plane_to_triangle(p)
        b0, b1, b2, b3 = _nearest_coefficients(kind[e], p)
        d = _norm(p, b0, b1, b2, b3)
        delta = bound[e] = (-d if behind else d) - offset[e]
        if delta >= gap[e]:
            continue
        owned_weight, mollifier = 1.0 if e < n_counted else 0.0, 1.0
        if kind[e] == EDGE_EDGE:
            mollifier = _mollifier(p, parallel, slope)[0]
        # mollified edges have an energy of their own
        if mollifier == 1.0 and kind[e] <= EDGE_EDGE and (b0 == 0.0 or b1 == 0.0 or b2 == 0.0 or b3 == 0.0):
            v, lo, hi = _nearest_vertices(kind[e], points, e, b0, b1, b2, b3)
            if lo == hi:
                v, lo, hi = max(v, lo), min(v, lo), min(v, lo)
            elif lo > hi:
                lo, hi = hi, lo
            row = Index(max(v, hi) if v < 0 else v)
            other = head[row]
            while other >= 0 and not (
                keys[other, 0] == v
                and keys[other, 1] == lo
                and keys[other, 2] == hi
                and gap[keys[other, 3]] == gap[e]
            ):
                other = link[other]
            if other >= 0:
                if other < len(pairs):
                    share = stiffness[e] / stiffness[keys[other, 3]]
                    weights[other] += share
                    owned_weights[other] += share * owned_weight
                continue
            if n >= len(keys):
                keys, link = _enlarged(keys, link, n)
            keys[n, 0], keys[n, 1], keys[n, 2], keys[n, 3] = v, lo, hi, e
            link[n], head[row] = head[row], n
        d = -d if behind else d
        n = _write_row(
            n, pairs, weights, owned_weights, out_beta, energies, derivatives,
            e, 1.0, owned_weight, b0, b1, b2, b3, p, delta, d, gap[e], stiffness[e], mollifier,
        )  # fmt: skip
    return _write_points(x, x_obs, points, n_points, nearest, *constants, n, found, q)


@kernel()
def _enlarged(keys, link, n):  # type: ignore[no-untyped-def]
    """Copies with more than n + 1 rows."""
    new_keys, new_link = np.empty((2 * n + 64, 4), dtype=np.int64), np.full(2 * n + 64, -1)
    for row in range(len(link)):  # assignments of whole arrays take seconds to compile
        for k in range(4):
            new_keys[row, k] = keys[row, k]
        new_link[row] = link[row]
    return new_keys, new_link


@leaf()
def _vector_between(x, x_obs, kind, points, beta, e, n, p, g):  # type: ignore[no-untyped-def]
    """Copy the points of pair e to p (4, 3) and Σ β_ni p_i to g (3,); returns the distance as `distance`
    does.
    """
    _load_points(x, x_obs, points, e, p)
    behind = kind[e] == VERTEX_INSIDE
    if kind[e] == VERTEX_PLANE:
        behind = _plane_to_triangle(p)
    square = 0.0
    for k in range(3):
        g[k] = beta[n, 0] * p[0, k] + beta[n, 1] * p[1, k] + beta[n, 2] * p[2, k] + beta[n, 3] * p[3, k]
        square += g[k] * g[k]
    return -math.sqrt(square) if behind else math.sqrt(square)


@kernel()
def add_gradient(x, x_obs, kind, points, offset, gap, stiffness, parallel, active, out, obstacle_gradient):  # type: ignore[no-untyped-def]  # fmt: skip
    """Add the gradient [N] of active pairs to out (n_local, 3) and, for obstacles, to obstacle_gradient (m,
    3).

    ``active`` are numbers of pairs, weights, β and derivatives as from `find_active`.
    """
    p, sine_gradient = np.empty((4, 3)), np.zeros(12)
    at, weight, beta, derivatives = active
    for m in range(len(at)):
        e = at[m]
        slope, sine_force = weight[m] * derivatives[m, 3], 0.0
        if kind[e] == EDGE_EDGE:
            _load_points(x, x_obs, points, e, p)
            mollifier, mollifier_slope, _ = _mollifier(p, parallel, sine_gradient)
            if mollifier < 1.0:
                d = _norm(p, beta[m, 0], beta[m, 1], beta[m, 2], beta[m, 3])
                delta = d - offset[e]
                slope *= mollifier
                energy = stiffness[e] * barrier(delta, gap[e])[0] if delta > 0.0 else np.nan
                sine_force = weight[m] * energy * mollifier_slope
        for i in range(4):
            if beta[m, i] == 0.0 and sine_force == 0.0:
                continue
            for k in range(3):
                force = slope * beta[m, i] * derivatives[m, k]
                if sine_force != 0.0:
                    force += sine_force * sine_gradient[3 * i + k]
                if points[e, i] >= 0:
                    out[Index(points[e, i]), k] += force
                else:
                    obstacle_gradient[Index(~points[e, i]), k] += force


@leaf()
def _mollify_hessian(p, beta, g, gap, delta, stiffness, force, convexity, parallel, gradient, h):  # type: ignore[no-untyped-def]
    """Change the Hessian h (4, 4, 3, 3) of the energy of two edges to that of the mollified energy."""
    m, dm, ddm = _mollifier(p, parallel, gradient)
    if m == 1.0:
        return
    energy, exact = (1.0 - convexity) * stiffness * barrier(delta, gap)[0], (1.0 - convexity) * dm * force
    for i in range(4):
        for j in range(4):
            for k in range(3):
                left, s_i = exact * beta[i] * g[k], gradient[3 * i + k]
                for n in range(3):
                    right, s_j = exact * beta[j] * g[n], gradient[3 * j + n]
                    h[i, j, k, n] = m * h[i, j, k, n] + left * s_j + s_i * right + energy * ddm * s_i * s_j
    _add_sine_hessian(p, energy * dm, h)


@leaf()
def _add_sine_hessian(p, factor, h):  # type: ignore[no-untyped-def]
    """Add factor times the Hessian of sin² θ to h (4, 4, 3, 3)."""
    uu, uv, vv = _edge_products(p)
    square = uu * vv
    if not square > 0.0:
        return
    for k in range(3):
        uk, vk = p[1, k] - p[0, k], p[3, k] - p[2, k]
        a, b = vk - uv / uu * uk, uk - uv / vv * vk
        for m in range(3):
            same = 1.0 if k == m else 0.0
            um, vm = p[1, m] - p[0, m], p[3, m] - p[2, m]
            to_u, to_v = vm - 2.0 * uv / uu * um, um - 2.0 * uv / vv * vm
            scale = -2.0 * factor / square
            uu_block = scale * (a * to_u - uv / uu * (uk * to_u + uv * same))
            vv_block = scale * (b * to_v - uv / vv * (vk * to_v + uv * same))
            uv_block = scale * (a * to_v + uv * (same - uk * um / uu))
            for i in range(2):
                for j in range(2):
                    sign = 1.0 if i == j else -1.0
                    h[i, j, k, m] += sign * uu_block
                    h[2 + i, 2 + j, k, m] += sign * vv_block
                    h[i, 2 + j, k, m] += sign * uv_block
                    h[2 + j, i, m, k] += sign * uv_block


@kernel()
def add_hessians(  # type: ignore[no-untyped-def]
    x, x_obs, kind, points, offset, gap, stiffness, parallel, active, convexity, offsets, values
):
    """Add the Hessians [N/m] of active pairs to block rows values (n_blocks, 3, 3); no rows for obstacles.

    ``active`` as in `add_gradient`, ``offsets`` (E, 10) as in `kernels.scatter`. ``convexity`` 0 is exact, 1
    keeps only b″ g gᵀ / |g|² (positive semidefinite).
    """
    p, across, gamma, e = np.empty((4, 3)), np.empty((4, 3)), np.empty((2, 4)), np.zeros((2, 3))
    capacity = p, across, gamma, e, np.empty((4, 4, 3, 3)), np.zeros(12)
    blocks = values.reshape(-1, 9)
    for n in range(len(active[0])):
        fetch_ahead(active[0][Index(min(n + AHEAD, len(active[0]) - 1))], offsets, blocks, 10, 0)
        _add_hessian(
            n, x, x_obs, kind, points, offset, gap, stiffness, parallel,
            active, convexity, offsets, capacity, values, blocks,
        )  # fmt: skip


@leaf()
def _add_hessian(  # type: ignore[no-untyped-def]
    n, x, x_obs, kind, points, offset, gap, stiffness, parallel,
    active, convexity, offsets, work, values, blocks,
):  # fmt: skip
    """Add the Hessian of active pair n; ``work`` holds arrays for intermediate results."""
    at, weight, beta, derivatives = active
    pair, b, g = at[n], beta[n], derivatives[n]
    factor = weight[n] if weight[n] > 0.0 else (1.0 - convexity) * weight[n]
    if factor == 0.0 or not abs(g[3]) < np.inf:
        return
    p, across, gamma, e, h, sine_gradient = work
    slope, is_edges = (1.0 - convexity) * g[3], kind[pair] == EDGE_EDGE
    free = _free_coordinates(kind[pair], b, gamma) if slope != 0.0 else 0
    if free > 0 or is_edges:
        _load_points(x, x_obs, points, pair, p)
    if free > 0 and kind[pair] == VERTEX_PLANE:
        _plane_to_triangle(p)
    _free_directions(gamma, p, free, e)
    if not is_edges or not _is_mollified(p, parallel):
        _add_pair_blocks(factor, points[pair], g, b, slope, free, gamma, e, offsets[pair], across, blocks)
        return
    _pair_hessian(g, b, slope, free, gamma, e, h)
    delta = math.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2) - offset[pair]
    _mollify_hessian(p, b, g, gap[pair], delta, stiffness[pair], g[3], convexity, parallel, sine_gradient, h)
    for i in range(4):
        if points[pair, i] < 0:
            h[i], h[:, i] = 0.0, 0.0
    add_element(factor, h, offsets[pair], values)


@leaf()
def _free_directions(gamma, p, free, e):  # type: ignore[no-untyped-def]
    """e_k of p (4, 3), written to e (2, 3)."""
    for f in range(free):
        for k in range(3):
            e[f, k] = 0.0
            for i in range(4):
                e[f, k] += gamma[f, i] * p[i, k]


@leaf()
def _inverse_metric(free, e):  # type: ignore[no-untyped-def]
    """A⁻¹_00, A⁻¹_01 and A⁻¹_11 of e (2, 3)."""
    if free == 0:
        return 0.0, 0.0, 0.0
    u = e[0, 0] ** 2 + e[0, 1] ** 2 + e[0, 2] ** 2
    if free == 1:
        return 1.0 / u, 0.0, 0.0
    v = e[0, 0] * e[1, 0] + e[0, 1] * e[1, 1] + e[0, 2] * e[1, 2]
    w = e[1, 0] ** 2 + e[1, 1] ** 2 + e[1, 2] ** 2
    det = u * w - v * v
    return w / det, -v / det, u / det


@leaf()
def _add_pair_blocks(factor, points, derivatives, beta, slope, free, gamma, e, offsets, across, blocks):  # type: ignore[no-untyped-def]  # fmt: skip
    """Add the Hessian of a pair that is not mollified, as outer products of two vectors, to blocks (n_blocks,
    9).

    If two coordinates are free, the e_k span the plane perpendicular to g: I − Σ A⁻¹_kl e_k e_lᵀ is g gᵀ /
    |g|². Then ``across`` (4, 3) is Σ A⁻¹_kl γ_ki e_l; it is β_i e + γ_i g if one is free.
    """
    g = derivatives[0], derivatives[1], derivatives[2]
    curvature = factor * derivatives[4]
    slope = factor * slope
    a00, a01, a11 = _inverse_metric(free, e)
    along = curvature if free == 2 else curvature - slope / dot(g, g)
    for i in range(4):
        u, v, w = a00 * gamma[0, i] + a01 * gamma[1, i], a01 * gamma[0, i] + a11 * gamma[1, i], 0.0
        if free == 1:
            u, v, w = beta[i], 0.0, gamma[0, i]
        for k in range(3):
            across[i, k] = u * e[0, k] + v * e[1, k] + w * g[k]
    for j in range(4):
        c, q = beta[j], (across[j, 0], across[j, 1], across[j, 2])
        if c == 0.0 or points[j] < 0:  # γ is 0, too, where β is
            continue
        for i in range(j + 1):
            b, p = beta[i], (across[i, 0], across[i, 1], across[i, 2])
            if b == 0.0 or points[i] < 0:
                continue
            to, own = offsets[(7 - i) * i // 2 + j], b * c * along
            if free == 2:
                own -= slope * dot(p, q)
                left = combined(own, g, -slope * b, q)
                add_outers(blocks, to, 0.0, ((left, g), (g, scaled(-slope * c, p))))
            elif free == 1:
                add_outers(blocks, to, b * c * slope, ((scaled(own, g), g), (scaled(-slope * a00, p), q)))
            else:
                add_outers(blocks, to, b * c * slope, ((scaled(own, g), g),))


@leaf()
def _pair_hessian(derivatives, beta, first, free, gamma, e, h):  # type: ignore[no-untyped-def]
    """Write the Hessian of a pair without mollifier to h (4, 4, 3, 3)."""
    square = derivatives[0] ** 2 + derivatives[1] ** 2 + derivatives[2] ** 2
    along = derivatives[4] - first / square
    a00, a01, a11 = _inverse_metric(free, e)
    for i in range(4):
        for j in range(4):
            both = beta[i] * beta[j]
            for k in range(3):
                c0 = beta[i] * e[0, k] + gamma[0, i] * derivatives[k] if free > 0 else 0.0
                c1 = beta[i] * e[1, k] + gamma[1, i] * derivatives[k] if free > 1 else 0.0
                for m in range(3):
                    d0 = beta[j] * e[0, m] + gamma[0, j] * derivatives[m] if free > 0 else 0.0
                    d1 = beta[j] * e[1, m] + gamma[1, j] * derivatives[m] if free > 1 else 0.0
                    value = along * both * derivatives[k] * derivatives[m] + (first * both if k == m else 0.0)
                    value -= first * (c0 * (a00 * d0 + a01 * d1) + c1 * (a01 * d0 + a11 * d1))
                    h[i, j, k, m] = value


@leaf()
def _is_mollified(p, parallel):  # type: ignore[no-untyped-def]
    """Whether the edges p0 p1 and p2 p3 are so nearly parallel that m < 1."""
    uu, uv, vv = _edge_products(p)
    return not uu * vv - uv * uv >= uu * vv * parallel


@leaf()
def approach_bound(kind, w):  # type: ignore[no-untyped-def]
    """Upper bound of the change of a pair's distance on displacements w (4, 3) [m]; subtracts their mean from
    w.
    """
    for k in range(3):
        mean = 0.25 * (w[0, k] + w[1, k] + w[2, k] + w[3, k])
        for i in range(4):
            w[i, k] -= mean
    first = second = 0.0
    n_first = 2 if kind == EDGE_EDGE else 1
    for i in range(4):
        square = w[i, 0] * w[i, 0] + w[i, 1] * w[i, 1] + w[i, 2] * w[i, 2]
        if i < n_first:
            first = max(first, square)
        else:
            second = max(second, square)
    return math.sqrt(first) + math.sqrt(second)


@leaf()
def _plane_approach_bound(p, w, maximum):  # type: ignore[no-untyped-def]
    """The same bound for a vertex and a plane, per unit of a fraction of w up to ``maximum``."""
    dx = arm = turn = 0.0
    for k in range(3):
        w[0, k] -= w[1, k]
        w[1, k] = 0.0
        dx += w[0, k] * w[0, k]
        arm += (p[0, k] - p[1, k]) ** 2
        turn += w[2, k] * w[2, k]
    if turn > 3.0:
        return math.inf
    # up to this change the interpolated normal has at least half its length
    dx, turn = math.sqrt(dx), 2.0 * math.sqrt(turn)
    return dx + turn * (math.sqrt(arm) + maximum * dx)


@leaf()
def _largest_norm_of(w, lo, hi):  # type: ignore[no-untyped-def]
    """Largest norm of the rows lo to hi of w."""
    square = 0.0
    for i in range(lo, hi):
        square = max(square, w[i, 0] ** 2 + w[i, 1] ** 2 + w[i, 2] ** 2)
    return math.sqrt(square)


@kernel()
def swept_distance_bounds(x, x_obs, dx, dx_obs, kind, points, radius, out):  # type: ignore[no-untyped-def]
    """Write lower bounds of the distances [m] of pairs of simplices on displacements dx, dx_obs to out (E,).

    The vertices of sheets move at the same time; obstacles may be anywhere on their displacements. Bounds
    beyond ``radius`` (E,) [m] are less sharp.
    """
    p, w = np.empty((4, 3)), np.empty((4, 3))
    for e in range(len(out)):
        _load_points(x, x_obs, points, e, p)
        _load_points(dx, dx_obs, points, e, w)
        if points[e].min() >= 0:
            approach = approach_bound(kind[e], w)
        else:
            n_first = 2 if kind[e] == EDGE_EDGE else 1
            approach = _largest_norm_of(w, 0, n_first) + _largest_norm_of(w, n_first, 4)
        out[e] = box_distance(p, kind[e]) - approach
        if out[e] >= radius[e]:
            continue
        d = distance(kind[e], p)
        out[e] = d - approach


@leaf()
def _signed_distance(p, kind, side, beta, n):  # type: ignore[no-untyped-def]
    """Distance of a pair at p (4, 3); writes β (4,) and the unit vector n (3,) in which the distance grows.

    The distance is negative if g points against ``side`` (3,), its earlier direction, unless that is 0.
    """
    behind = kind == VERTEX_INSIDE
    if kind == VERTEX_PLANE:
        behind = _plane_to_triangle(p)
    beta[0], beta[1], beta[2], beta[3] = _nearest_coefficients(kind, p)
    square = along = 0.0
    for k in range(3):
        n[k] = beta[0] * p[0, k] + beta[1] * p[1, k] + beta[2] * p[2, k] + beta[3] * p[3, k]
        square, along = square + n[k] * n[k], along + n[k] * side[k]
    d = -math.sqrt(square) if behind or along < 0.0 else math.sqrt(square)
    for k in range(3):
        n[k] = n[k] / d if d != 0.0 else 0.0
    return d


@leaf()
def _distance_of_force(force, gap):  # type: ignore[no-untyped-def]
    """δ at which −b′ / k is ``force`` [m] > 0, or a little less."""
    # the force is below 2 gap³ / δ² for small δ, so that it exceeds `force` at the lower end
    low, high = min(0.5, 0.1 * math.sqrt(gap / (gap + force))) * gap, gap
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if -barrier(middle, gap)[1] > force:
            low = middle
        else:
            high = middle
    return low


@kernel()
def target_distances(x, x_obs, dx, kind, points, offset, gap, maximum, expected, target, side, loaded):  # type: ignore[no-untyped-def]  # fmt: skip
    """Distances less offset [m] that pairs shall have after Newton's increment dx (n_local, 3) [m].

    Parameters
    ----------
    expected : (E,)
        Expected force over k [m]; NaN: the force of the linear model for the increment.
    maximum : float
        Largest target over the gap.
    target : (E,)
        Output: the distance at which the barrier has the expected force; −∞ for pairs that stay apart.
    side : (E, 3)
        Output: direction of g for pairs of simplices, to recognise pairs that pass through each other; else
        0.
    loaded : (E,)
        Output: whether the pair has a force in the linear model.
    """
    p, n, beta, no_side = np.empty((4, 3)), np.empty(3), np.empty(4), np.zeros(3)
    approach = 2.0 * _largest_norm(dx)
    for e in range(len(kind)):
        target[e], loaded[e] = -math.inf, False
        _load_points(x, x_obs, points, e, p)
        if box_distance(p, kind[e]) - offset[e] - approach >= gap[e]:
            continue
        d = _signed_distance(p, kind[e], no_side, beta, n)
        delta = d - offset[e]
        if not 0.0 < delta < gap[e] + approach:
            continue
        target[e] = maximum * gap[e]
        if kind[e] <= EDGE_EDGE:
            for k in range(3):
                side[e, k] = n[k]
        force = expected[e]
        if math.isnan(force) and delta < gap[e]:
            along = 0.0
            for i in range(4):
                if points[e, i] >= 0:
                    for k in range(3):
                        along += beta[i] * n[k] * dx[Index(points[e, i]), k]
            _, slope, second = barrier(delta, gap[e])
            force = -slope - second * along
        if force > 0.0:
            target[e], loaded[e] = min(target[e], _distance_of_force(force, gap[e])), True


@kernel()
def find_springs(  # type: ignore[no-untyped-def]
    x, x_obs, approach, kind, points, offset, gap, stiffness, parallel, active, n_counted, found
):  # fmt: skip
    """Find one-sided springs, whose length is linear in a step: of active pairs, and of pairs that an
    ``approach`` [m] of their points may activate.

    Parameters
    ----------
    active : tuple
        Numbers, weights, weights on this rank, β and derivatives of the pairs from `find_active`.
    found : tuple of (capacity,), (capacity, 4), (capacity, 3), (capacity,), (capacity,), (capacity,)
        Output: numbers of the pairs, β, unit normals, weight times k [N/m], δ at x [m], and the weight on
        this rank over the weight.

    Returns
    -------
    n_active, n : int
        Number of springs of active pairs, which come first, and of all; only the first ``capacity`` are
        written.
    """
    numbers, beta, normal, spring, length, counted = found
    pair, weight, owned_weight, active_beta, derivatives = active
    p, u, b, no_side, n = np.empty((4, 3)), np.empty(3), np.empty(4), np.zeros(3), 0
    for m in range(len(pair)):
        e = pair[m]
        if not weight[m] > 0.0 or not derivatives[m, 4] > 0.0 or not derivatives[m, 4] < np.inf:
            continue
        if kind[e] == EDGE_EDGE:
            _load_points(x, x_obs, points, e, p)
            if _is_mollified(p, parallel):
                continue
        d = math.sqrt(derivatives[m, 0] ** 2 + derivatives[m, 1] ** 2 + derivatives[m, 2] ** 2)
        d = -d if kind[e] == VERTEX_INSIDE else d
        numbers[n], spring[n], counted[n] = e, weight[m] * stiffness[e], owned_weight[m] / weight[m]
        length[n] = d - offset[e]
        for i in range(4):
            beta[n, i] = active_beta[m, i]
        for k in range(3):
            normal[n, k] = derivatives[m, k] / d
        n += 1
    n_active = n
    for e in range(len(kind)):
        _load_points(x, x_obs, points, e, p)
        if box_distance(p, kind[e]) - offset[e] - approach >= gap[e]:
            continue
        delta = _signed_distance(p, kind[e], no_side, b, u) - offset[e]
        # nearer pairs are active, by themselves or by a pair with the same nearest points
        if not gap[e] <= delta < gap[e] + approach or (kind[e] == EDGE_EDGE and _is_mollified(p, parallel)):
            continue
        if n < len(numbers):
            numbers[n], spring[n], length[n] = e, stiffness[e], delta
            counted[n] = 1.0 if e < n_counted else 0.0
            for i in range(4):
                beta[n, i] = b[i]
            for k in range(3):
                normal[n, k] = u[k]
        n += 1
    return n_active, n


@kernel()
def spring_forces(delta, gap, lower_bound, force, stiffness):  # type: ignore[no-untyped-def]
    """Write −b′ / k [m] and b″ / k at distances (n,) [m]; below lower_bound (n,) [m] the law is its tangent
    there.
    """
    for m in range(len(delta)):
        at = max(delta[m], lower_bound[m])
        if at >= gap[m]:
            force[m] = stiffness[m] = 0.0
            continue
        _, slope, stiffness[m] = barrier(at, gap[m])
        force[m] = stiffness[m] * (at - delta[m]) - slope


@kernel()
def secant_stiffness(delta, gap, lower_bound, force, expected, out):  # type: ignore[no-untyped-def]
    """Slopes (n,) of `spring_forces` between ``force`` (n,) [m] and ``expected`` (n,) [m]; the tangent if
    both agree.
    """
    for m in range(len(delta)):
        _, slope, second = barrier(lower_bound[m], gap[m])
        if expected[m] <= 0.0:
            end = gap[m]
        elif expected[m] >= -slope:
            end = lower_bound[m] - (expected[m] + slope) / second
        else:
            end = _distance_of_force(expected[m], gap[m])
        if abs(end - delta[m]) > MIN_CHORD * gap[m]:
            out[m] = max(0.0, (expected[m] - force[m]) / (delta[m] - end))
        else:
            out[m] = barrier(max(delta[m], lower_bound[m]), gap[m])[2] if delta[m] < gap[m] else 0.0


@kernel()
def add_corrections(x, x_obs, dx, kind, points, offset, gap, target, side, loaded, tolerance, out, weight):  # type: ignore[no-untyped-def]  # fmt: skip
    """Add displacements that separate pairs which are nearer than their targets after dx; returns their
    number.

    Pairs that are loaded in the linear model but leave the gap, because tangents leave curved surfaces, are
    pulled back. Corrections are added to ``out`` (n_local, 3) [m], each times its weight, and weights to
    ``weight`` (n_local, 1). ``target``, ``side``, ``loaded`` as from `target_distances`; pairs that lack less
    than ``tolerance`` times the gap are left as they are.
    """
    p, n, beta, found = np.empty((4, 3)), np.empty(3), np.empty(4), 0
    for e in range(len(kind)):
        if not target[e] > -math.inf:
            continue
        _load_points(x, x_obs, points, e, p)
        for i in range(4):
            if points[e, i] >= 0:
                for k in range(3):
                    p[i, k] += dx[Index(points[e, i]), k]
        shortfall = target[e] + offset[e] - _signed_distance(p, kind[e], side[e], beta, n)
        square = 0.0
        for i in range(4):
            if points[e, i] >= 0:
                square += beta[i] * beta[i]
        leaves = loaded[e] and target[e] - shortfall >= gap[e]
        if not (shortfall > tolerance * gap[e] or leaves) or not square > 0.0:
            continue
        found += 1
        for i in range(4):
            if points[e, i] >= 0 and beta[i] != 0.0:
                row, row_weight = Index(points[e, i]), abs(beta[i])
                weight[row, 0] += row_weight
                for k in range(3):
                    out[row, k] += row_weight * shortfall * beta[i] / square * n[k]
    return found


@leaf()
def _largest_norm(w):  # type: ignore[no-untyped-def]
    """Largest norm of the rows of w (n, 3)."""
    largest = 0.0
    for i in range(len(w)):
        square = w[i, 0] ** 2 + w[i, 1] ** 2 + w[i, 2] ** 2
        if not square <= largest:  # also if NaN
            largest = square
    return math.sqrt(largest)


@leaf()
def largest_approach(dx, dx_obs):  # type: ignore[no-untyped-def]
    """Largest distance [m] by which two points, one of them of a sheet, can approach each other."""
    largest = _largest_norm(dx)
    return largest + max(largest, _largest_norm(dx_obs))


@kernel()
def largest_step(x, x_obs, dx, dx_obs, kind, points, offset, far, keep, maximum):  # type: ignore[no-untyped-def]  # fmt: skip
    """Fraction, up to ``maximum``, of displacements dx, dx_obs on which no pair comes too near.

    Each pair keeps at least the part ``keep`` of its distance less the offset, or of ``far`` (E,) [m] if that
    is less. Additive continuous collision detection: Li, Kaufman & Jiang, Codimensional incremental potential
    contact, ACM Trans. Graph. 40 (2021) 170, algorithm 1. It is 0 for a plane that turns by more than 120°.
    """
    approach = largest_approach(dx, dx_obs)
    return _largest_step(x, x_obs, dx, dx_obs, approach, kind, points, offset, far, keep, maximum)


@kernel()
def _largest_step(x, x_obs, dx, dx_obs, approach, kind, points, offset, far, keep, maximum):  # type: ignore[no-untyped-def]  # fmt: skip
    """`largest_step`, where no two points approach each other by more than ``approach`` [m]."""
    p, w = np.empty((4, 3)), np.empty((4, 3))
    for e in range(len(kind)):
        _load_points(x, x_obs, points, e, p)
        plane = kind[e] == VERTEX_PLANE
        if not plane and maximum * approach <= (1.0 - keep) * (box_distance(p, kind[e]) - offset[e]):
            continue
        _load_points(dx, dx_obs, points, e, w)
        bound = _plane_approach_bound(p, w, maximum) if plane else approach_bound(kind[e], w)
        d = distance(kind[e], p)
        delta = d - offset[e]
        kept = min(delta, far[e])
        if delta - maximum * bound >= keep * kept or bound == 0.0:
            continue
        if not bound < math.inf:
            return 0.0
        minimum, tolerance, t = keep * kept, (1.0 - keep) * CCD_TOLERANCE * kept, 0.0
        # no advance reaches the minimum distance
        advances = 0
        while delta - minimum > tolerance and advances < MAX_ADVANCES:
            advances += 1
            t += (delta - minimum) / bound
            if t >= maximum:
                break
            _load_points(x, x_obs, points, e, p)
            for i in range(4):
                for k in range(3):
                    p[i, k] += t * w[i, k]
            d = distance(kind[e], p)
            delta = d - offset[e]
        maximum = min(maximum, t)
    return maximum


@kernel()
def may_collide(x, x_obs, dx, dx_obs, kind, points, offset, gap, threshold):  # type: ignore[no-untyped-def]
    """Whether any pair may become active on displacements dx, dx_obs.

    Only pairs that approach by more than ``threshold`` [m] count.
    """
    if largest_approach(dx, dx_obs) <= threshold:
        return False
    p, w = np.empty((4, 3)), np.empty((4, 3))
    for e in range(len(kind)):
        _load_points(x, x_obs, points, e, p)
        _load_points(dx, dx_obs, points, e, w)
        bound = _plane_approach_bound(p, w, 1.0) if kind[e] == VERTEX_PLANE else approach_bound(kind[e], w)
        if bound > threshold and distance(kind[e], p) - offset[e] < bound + gap[e]:
            return True
    return False


@leaf()
def _normal_force(p, kind, delta, gap, stiffness, parallel, slope):  # type: ignore[no-untyped-def]
    """Normal force [N] of a pair; 0 unless 0 < δ < gap."""
    if not 0.0 < delta < gap:
        return 0.0
    force = -stiffness * barrier(delta, gap)[1]
    return force * _mollifier(p, parallel, slope)[0] if kind == EDGE_EDGE else force


@leaf()
def counts_singly(kind, points, e):  # type: ignore[no-untyped-def]
    """Whether contact forces of pair e are those of the pair alone: not for a vertex of a sheet and a
    surface.
    """
    return kind[e] == EDGE_EDGE or points[e, 0] < 0


@kernel()
def find_contacts(x, x_obs, kind, points, offset, gap, stiffness, parallel, bound, active, n_counted, found):  # type: ignore[no-untyped-def]  # fmt: skip
    """Find which of the first ``n_counted`` pairs have a contact force; returns their number n.

    For vertices of sheets these are active pairs as from `find_active` (``active``: numbers, weights, β and
    derivatives), for others each pair whose ``bound`` (E,) [m] is below the gap. To the first n rows of
    ``found``, (m, 4), (m, 3), (m,), (m,), (m,), are written β, unit normals towards the first simplex, normal
    forces [N], which may be negative, distances less offset [m], and numbers of pairs.
    """
    p, g, slope, n = np.empty((4, 3)), np.empty(3), np.zeros(12), 0
    beta, normal, force, delta, numbers = found
    pairs, weight, active_beta, derivatives = active
    for m in range(len(pairs) + n_counted):
        e = pairs[m] if m < len(pairs) else m - len(pairs)
        if e >= n_counted or bound[e] >= gap[e] or counts_singly(kind, points, e) != (m >= len(pairs)):
            continue
        if m < len(pairs):
            for k in range(3):
                g[k] = derivatives[m, k]
            d = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
            d = -d if kind[e] == VERTEX_INSIDE else d
            for i in range(4):
                beta[n, i] = active_beta[m, i]
            force[n] = -weight[m] * derivatives[m, 3] * d
        else:
            _load_points(x, x_obs, points, e, p)
            beta[n, 0], beta[n, 1], beta[n, 2], beta[n, 3] = _nearest_coefficients(kind[e], p)
            d = _vector_between(x, x_obs, kind, points, beta, e, n, p, g)
            force[n] = _normal_force(p, kind[e], d - offset[e], gap[e], stiffness[e], parallel, slope)
        if force[n] == 0.0:
            continue
        for k in range(3):
            normal[n, k] = g[k] / d
        delta[n], numbers[n] = d - offset[e], e
        n += 1
    return n


@kernel()
def cancel_negative(kind, vertex, normal, values):  # type: ignore[no-untyped-def]
    """Subtract negative normal forces [N] or stiffnesses [N/m] of pairs, ``values`` (E,), from the positive
    ones on the same side of their vertex; they become 0.

    They occur where the surface in front of a vertex of a sheet is concave, and on a side between triangles
    of which both are the nearest. A vertex between two layers has pairs with both, which are treated
    separately. Pairs of a vertex must follow each other.
    """
    begin = 0
    while begin < len(values):
        end = begin + 1
        while end < len(values) and vertex[end] == vertex[begin] and kind[end] == kind[begin]:
            end += 1
        for j in range(begin, end):
            if not values[j] < 0.0 or kind[j] != VERTEX_TRIANGLE or vertex[j] < 0:
                continue
            positive = 0.0
            for i in range(begin, end):
                if values[i] > 0.0 and dot(normal[i], normal[j]) > 0.0:
                    positive += values[i]
            factor = max(0.0, 1.0 + values[j] / positive) if positive > 0.0 else 0.0
            for i in range(begin, end):
                if values[i] > 0.0 and dot(normal[i], normal[j]) > 0.0:
                    values[i] *= factor
            values[j] = 0.0
        begin = end


@kernel()
def largest_steps(x, x_obs, dx, dx_obs, kind, points, offset, far, keep, out):  # type: ignore[no-untyped-def]
    """Write the `largest_step` of each of the first len(out) pairs alone to out."""
    approach = largest_approach(dx, dx_obs)
    for e in range(len(out)):
        one = slice(e, e + 1)
        pair = kind[one], points[one], offset[one], far[one]
        out[e] = _largest_step(x, x_obs, dx, dx_obs, approach, *pair, keep, 1.0)


@kernel()
def add_normal_forces(points, beta, force, out):  # type: ignore[no-untyped-def]
    """Add the normal force (E,) [N] of each pair to its vertices in out (n_local,), by their shares |β_i|."""
    for e in range(len(force)):
        for i in range(4):
            if points[e, i] >= 0:
                out[Index(points[e, i])] += force[e] * abs(beta[e, i])
