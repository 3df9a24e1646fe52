"""Distances between the simplices of pairs: pure functions on arrays.

A pair consists of four points: a vertex p0 and a triangle p1 p2 p3, or two edges p0 p1 and p2 p3. The vector
between the nearest points of both is g = Σ β_i p_i.

Points of obstacles have negative numbers: ~number in the array of the obstacles' points.

In all functions x (n_local, 3) [m] are positions of the sheets' vertices and x_obs (m, 3) [m] those of
the obstacles' points; dx and dx_obs are displacements [m]; kind (E,) and points (E, 4) are the pairs.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import inlined, kernel, leaf, subkernel
from lyra_petsc.kernels.vector3 import cross, dot, minus

VERTEX_TRIANGLE, EDGE_EDGE, VERTEX_PLANE, VERTEX_INSIDE = 0, 1, 2, 3
"""Kinds of pairs. A plane is given by a point p1 and a unit normal p2. A vertex inside (of a ball or capsule)
stays within a radius of a segment p1 p2; its distance is −|g|. p3 is not used by these two."""

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
def nearest_on_segment(p, a, b):  # type: ignore[no-untyped-def]
    """Parameter t of the nearest point of segment a b, and its squared distance from p."""
    t = _segment_parameter(p, a, b)
    g = p[0] - a[0] - t * (b[0] - a[0]), p[1] - a[1] - t * (b[1] - a[1]), p[2] - a[2] - t * (b[2] - a[2])
    return t, dot(g, g)


@inlined()
def nearest_in_triangle(p, a, b, c):  # type: ignore[no-untyped-def]
    """Barycentric coordinates v and w (of b and c) of the point of a triangle that is nearest to p.

    Regions as in Ericson, Real-time collision detection (2005), 5.1.5.
    """
    ab, ac, ap = minus(b, a), minus(c, a), minus(p, a)
    normal = cross(ab, ac)
    if not dot(normal, normal) > PARALLEL * dot(ab, ab) * dot(ac, ac):
        # degenerate: the nearest point is on a side, and the rest would be dominated by rounding
        t, to_ab = nearest_on_segment(p, a, b)
        u, to_bc = nearest_on_segment(p, b, c)
        v, to_ca = nearest_on_segment(p, c, a)
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


@subkernel()
def _nearest_on_edges(a, b, c, d):  # type: ignore[no-untyped-def]
    """Parameters s and t of the nearest points of edges a b and c d: 0 at a and c, 1 at b and d.

    As in Ericson, 5.1.9.
    """
    u, v, w = minus(b, a), minus(d, c), minus(a, c)
    uu, uv, vv, uw, vw = dot(u, u), dot(u, v), dot(v, v), dot(u, w), dot(v, w)
    det = uu * vv - uv * uv
    if not det > PARALLEL * uu * vv:
        # an end of one of the edges is equally near
        t, to_a = nearest_on_segment(a, c, d)
        best, s = to_a, 0.0
        other, to_b = nearest_on_segment(b, c, d)
        if to_b < best:
            best, s, t = to_b, 1.0, other
        other, to_c = nearest_on_segment(c, a, b)
        if to_c < best:
            best, s, t = to_c, other, 0.0
        other, to_d = nearest_on_segment(d, a, b)
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
def nearest_coefficients(kind, p):  # type: ignore[no-untyped-def]
    """β of the nearest points of a pair at p (4, 3)."""
    a, b = (p[0, 0], p[0, 1], p[0, 2]), (p[1, 0], p[1, 1], p[1, 2])
    c, d = (p[2, 0], p[2, 1], p[2, 2]), (p[3, 0], p[3, 1], p[3, 2])
    if kind == EDGE_EDGE:
        s, t = _nearest_on_edges(a, b, c, d)
        return 1.0 - s, s, t - 1.0, -t
    if kind == VERTEX_INSIDE:
        t = _segment_parameter(a, b, c)
        return 1.0, t - 1.0, -t, 0.0
    v, w = nearest_in_triangle(a, b, c, d)
    return 1.0, v + w - 1.0, -v, -w


@leaf()
def between(p, b0, b1, b2, b3):  # type: ignore[no-untyped-def]
    """g for coefficients β and points p (4, 3)."""
    return (
        b0 * p[0, 0] + b1 * p[1, 0] + b2 * p[2, 0] + b3 * p[3, 0],
        b0 * p[0, 1] + b1 * p[1, 1] + b2 * p[2, 1] + b3 * p[3, 1],
        b0 * p[0, 2] + b1 * p[1, 2] + b2 * p[2, 2] + b3 * p[3, 2],
    )


@leaf()
def norm(p, b0, b1, b2, b3):  # type: ignore[no-untyped-def]
    """|g| for coefficients β and points p (4, 3)."""
    g = between(p, b0, b1, b2, b3)
    return math.sqrt(dot(g, g))


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
def plane_to_triangle(p):  # type: ignore[no-untyped-def]
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
def stands_behind(kind, p):  # type: ignore[no-untyped-def]
    """Whether the distance of a pair at p (4, 3) is negative: inside of a container, or behind a plane, which
    `plane_to_triangle` overwrites.
    """
    return plane_to_triangle(p) if kind == VERTEX_PLANE else kind == VERTEX_INSIDE


@leaf()
def distance(kind, p):  # type: ignore[no-untyped-def]
    """Distance of a pair at p (4, 3): |g|, or −|g| inside of a container.

    For a plane it is negative behind the plane; p1 to p3 are overwritten by `plane_to_triangle`.
    """
    behind = stands_behind(kind, p)
    b0, b1, b2, b3 = nearest_coefficients(kind, p)
    length = norm(p, b0, b1, b2, b3)
    return -length if behind else length


@leaf()
def signed_distance(p, kind, side, beta, n):  # type: ignore[no-untyped-def]
    """Distance of a pair at p (4, 3); writes β (4,) and the unit vector n (3,) in which the distance grows.

    The distance is negative if g points against ``side`` (3,), its earlier direction, unless that is 0.
    """
    behind = stands_behind(kind, p)
    beta[0], beta[1], beta[2], beta[3] = nearest_coefficients(kind, p)
    g = between(p, beta[0], beta[1], beta[2], beta[3])
    length = math.sqrt(dot(g, g))
    d = -length if behind or dot(g, side) < 0.0 else length
    for k in range(3):
        n[k] = g[k] / d if d != 0.0 else 0.0
    return d


@leaf()
def load_points(x, x_obs, points, e, p):  # type: ignore[no-untyped-def]
    """Copy the points of pair e, vertices of sheets or points of obstacles, to p (4, 3)."""
    for i in range(4):
        number = points[e, i]
        if number >= 0:
            n = Index(number)
            p[i, 0], p[i, 1], p[i, 2] = x[n, 0], x[n, 1], x[n, 2]
        else:
            n = Index(~number)
            p[i, 0], p[i, 1], p[i, 2] = x_obs[n, 0], x_obs[n, 1], x_obs[n, 2]


@kernel()
def distances(x, x_obs, kind, points, out):  # type: ignore[no-untyped-def]
    """Write the distance [m] of each pair to out (E,), as from `distance`."""
    p = np.empty((4, 3))
    for e in range(len(out)):
        load_points(x, x_obs, points, e, p)
        out[e] = distance(kind[e], p)


@leaf()
def largest_norm(w, begin, end):  # type: ignore[no-untyped-def]
    """Largest norm of the rows ``begin`` to ``end`` of w (n, 3)."""
    largest = 0.0
    for i in range(begin, end):
        square = w[i, 0] ** 2 + w[i, 1] ** 2 + w[i, 2] ** 2
        if not square <= largest:  # also if NaN
            largest = square
    return math.sqrt(largest)


@leaf()
def approach_bound(kind, w):  # type: ignore[no-untyped-def]
    """Upper bound of the change of a pair's distance on displacements w (4, 3) [m]; subtracts their mean from
    w.
    """
    for k in range(3):
        mean = 0.25 * (w[0, k] + w[1, k] + w[2, k] + w[3, k])
        for i in range(4):
            w[i, k] -= mean
    n_first = 2 if kind == EDGE_EDGE else 1
    return largest_norm(w, 0, n_first) + largest_norm(w, n_first, 4)


@leaf()
def plane_approach_bound(p, w, maximum):  # type: ignore[no-untyped-def]
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
def approach_of_pair(kind, p, w, maximum):  # type: ignore[no-untyped-def]
    """Upper bound of the change of a pair's distance from p on displacements w, (4, 3) [m] each, over the
    fraction of w, up to ``maximum``; changes w.
    """
    return plane_approach_bound(p, w, maximum) if kind == VERTEX_PLANE else approach_bound(kind, w)


@kernel()
def swept_distance_bounds(x, x_obs, dx, dx_obs, kind, points, radius, out):  # type: ignore[no-untyped-def]
    """Write lower bounds of the distances [m] of pairs of simplices on displacements dx, dx_obs to out (E,).

    The vertices of sheets move at the same time; obstacles may be anywhere on their displacements. Bounds
    beyond ``radius`` (E,) [m] are less sharp.
    """
    p, w = np.empty((4, 3)), np.empty((4, 3))
    for e in range(len(out)):
        load_points(x, x_obs, points, e, p)
        load_points(dx, dx_obs, points, e, w)
        if points[e].min() >= 0:
            approach = approach_bound(kind[e], w)
        else:
            n_first = 2 if kind[e] == EDGE_EDGE else 1
            approach = largest_norm(w, 0, n_first) + largest_norm(w, n_first, 4)
        out[e] = box_distance(p, kind[e]) - approach
        if out[e] >= radius[e]:
            continue
        d = distance(kind[e], p)
        out[e] = d - approach
