"""Distances of pairs of simplices and the barrier on them: pure functions on arrays.

A pair is four points: a vertex p0 and a triangle p1 p2 p3, or two edges p0 p1 and p2 p3. The vector between
the nearest points of both is g = Σ β_i p_i. Which of the barycentric coordinates are free there, none to two,
their coefficients γ_k = ∂β/∂t_k tell. With e_k = Σ γ_ki p_i and A_kl = e_k · e_l the derivatives of
s = ½ |g|² are, as s is least over the t_k::

    ∂s/∂p_i = β_i g
    ∂²s/∂p_i∂p_j = β_i β_j I − Σ_kl A⁻¹_kl (β_i e_k + γ_ki g)(β_j e_l + γ_lj g)ᵀ

Barrier, of δ = |g| − offset (as in Li, Ferguson, Schneider, Langlois, Zorin, Panozzo, Jiang & Kaufman,
Incremental potential contact, ACM Trans. Graph. 39 (2020) 49, but for their logarithm, which grows so slowly
that what is fast comes to rest only where no distance is left)::

    b(δ) = k (gap − δ)³ / δ  for 0 < δ < gap, 0 beyond, infinite at δ ≤ 0

The nearest points of parallel edges are not unique. Energies of pairs of edges u and v at an angle θ have the
factor m = c (2 − c), c = sin² θ / parallel up to 1, with which forces stay continuous; where they lie side by
side pairs of vertices and triangles are as near (same source, section 5.2, with |u × v|² over rest lengths).

Points of obstacles have numbers below 0: ~number among the obstacles' points.

Pairs whose nearest points are the same vertices, or a vertex and the same point of an edge, have the same
energy: each is evaluated once, and `meeting` tells how many there are of it.

A vertex of a sheet before a surface feels it once, however many triangles are near: what the triangles give,
less what the edges between them give, plus what the vertices within do (inclusion and exclusion, as Li,
Ferguson, Schneider, Langlois, Zorin, Panozzo, Jiang & Kaufman, Convergent incremental potential contact,
arXiv:2307.15908). Before a flat one, where nearest points of neighbours are the same, one pair is left. A
triangle has a share in each of its sides and corners (`surface_shares`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel, leaf
from lyra_petsc.kernels.scatter import AHEAD, add_element, fetch_ahead
from lyra_petsc.kernels.vectors import add_outers
from lyra_petsc.terms.hinge import combined, cross, dot, minus, scaled

VERTEX_TRIANGLE, EDGE_EDGE, VERTEX_PLANE, VERTEX_INSIDE = 0, 1, 2, 3
"""Kinds of pairs. A plane is a point p1 and a unit normal p2; a vertex inside keeps no more than a radius
from a segment p1 p2, and their distance is minus |g|. p3 counts for nothing there."""

NONE = 1e-6
"""How often a pair counts, at most, that does not count at all."""

TOGETHER = 256
"""Nearest points of a vertex that are compared with each other."""

CLOSE = 0.1
"""Part of the way to the least distance that continuous collision detection may leave."""

ADVANCES = 1000
"""Of it in one way, at most: where ways are long and go past each other, each advance is short."""

BISECTIONS = 30
"""In the search for the distance at which the barrier has a force."""

CHORD = 1e-3
"""Length of a chord over the gap below which it is a tangent."""

PARALLEL = 1e-12
"""Squared sine of the angle of two edges, or sides of a triangle, below which they count as parallel."""


@kernel(inline="always")
def _along(p, a, b):  # type: ignore[no-untyped-def]
    """Where the nearest point of segment a b to p is: 0 at a, 1 at b."""
    way = minus(b, a)
    square = dot(way, way)
    t = dot(minus(p, a), way) / square if square > 0.0 else 0.0
    return min(max(t, 0.0), 1.0)


@kernel(inline="always")
def _to_side(p, a, b):  # type: ignore[no-untyped-def]
    """The same, and the square of the distance."""
    t = _along(p, a, b)
    g = p[0] - a[0] - t * (b[0] - a[0]), p[1] - a[1] - t * (b[1] - a[1]), p[2] - a[2] - t * (b[2] - a[2])
    return t, dot(g, g)


@kernel(forceinline=True)
def _in_triangle(p, a, b, c):  # type: ignore[no-untyped-def]
    """Barycentric coordinates of the nearest point of a triangle to p: the second and the third.

    Regions as in Ericson, Real-time collision detection (2005), 5.1.5.
    """
    ab, ac, ap = minus(b, a), minus(c, a), minus(p, a)
    normal = cross(ab, ac)
    if not dot(normal, normal) > PARALLEL * dot(ab, ab) * dot(ac, ac):
        # the nearest of the sides is as near; what follows would be rounding
        t, to_ab = _to_side(p, a, b)
        u, to_bc = _to_side(p, b, c)
        v, to_ca = _to_side(p, c, a)
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
        return _along(p, a, b), 0.0
    if d5 * d2 - d1 * d6 <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return 0.0, _along(p, a, c)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        t = _along(p, b, c)
        return 1.0 - t, t
    total = va + vb + vc
    return vb / total, vc / total


@kernel()
def _on_edges(a, b, c, d):  # type: ignore[no-untyped-def]
    """Where the nearest points of edges a b and c d are: 0 at a and c, 1 at b and d.

    As in Ericson, 5.1.9.
    """
    u, v, w = minus(b, a), minus(d, c), minus(a, c)
    uu, uv, vv, uw, vw = dot(u, u), dot(u, v), dot(v, v), dot(u, w), dot(v, w)
    det = uu * vv - uv * uv
    if not det > PARALLEL * uu * vv:
        # an end of one of them is as near
        t, to_a = _to_side(a, c, d)
        best, s = to_a, 0.0
        more, to_b = _to_side(b, c, d)
        if to_b < best:
            best, s, t = to_b, 1.0, more
        more, to_c = _to_side(c, a, b)
        if to_c < best:
            best, s, t = to_c, more, 0.0
        more, to_d = _to_side(d, a, b)
        if to_d < best:
            s, t = more, 1.0
        return s, t
    s = min(max((uv * vw - vv * uw) / det, 0.0), 1.0)
    t = (uv * s + vw) / vv
    if t < 0.0:
        s, t = min(max(-uw / uu, 0.0), 1.0), 0.0
    elif t > 1.0:
        s, t = min(max((uv - uw) / uu, 0.0), 1.0), 1.0
    return s, t


@leaf()
def _weights(kind, p):  # type: ignore[no-untyped-def]
    """β of the nearest points of p (4, 3)."""
    a, b = (p[0, 0], p[0, 1], p[0, 2]), (p[1, 0], p[1, 1], p[1, 2])
    c, d = (p[2, 0], p[2, 1], p[2, 2]), (p[3, 0], p[3, 1], p[3, 2])
    if kind == EDGE_EDGE:
        s, t = _on_edges(a, b, c, d)
        return 1.0 - s, s, t - 1.0, -t
    if kind == VERTEX_INSIDE:
        t = _along(a, b, c)
        return 1.0, t - 1.0, -t, 0.0
    v, w = _in_triangle(a, b, c, d)
    return 1.0, v + w - 1.0, -v, -w


@leaf()
def _length(p, b0, b1, b2, b3):  # type: ignore[no-untyped-def]
    """|g|."""
    square = 0.0
    for k in range(3):
        g = b0 * p[0, k] + b1 * p[1, k] + b2 * p[2, k] + b3 * p[3, k]
        square += g * g
    return math.sqrt(square)


@leaf()
def distance(kind, p):  # type: ignore[no-untyped-def]
    """Distance of points p (4, 3): |g|, or −|g| inside.

    Of a plane, whose distance is negative behind it, p1 to p3 become a triangle around the nearest point.
    """
    behind = kind == VERTEX_INSIDE
    if kind == VERTEX_PLANE:
        behind = _around_foot(p)
    b0, b1, b2, b3 = _weights(kind, p)
    length = _length(p, b0, b1, b2, b3)
    return -length if behind else length


@leaf()
def _free(kind, beta, gamma):  # type: ignore[no-untyped-def]
    """γ (2, 4) of the nearest points with β (4,); how many coordinates are free."""
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
def at_least(p, kind):  # type: ignore[no-untyped-def]
    """What the distance of a pair at p (4, 3) is not below: that of the boxes around both; −∞ of others
    than simplices.
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
def _around_foot(p):  # type: ignore[no-untyped-def]
    """Let p1 p2 p3 be a triangle around the foot of p0 in the plane of point p1 and normal p2; whether p0
    lies behind it.
    """
    height, axis = 0.0, 0
    length = math.sqrt(p[2, 0] ** 2 + p[2, 1] ** 2 + p[2, 2] ** 2)  # not 1 while the plane turns
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
def _load(x, others, points, e, p):  # type: ignore[no-untyped-def]
    """Vertices of the sheets and points of obstacles of pair e into p (4, 3)."""
    for i in range(4):
        number = points[e, i]
        if number >= 0:
            n = Index(number)
            p[i, 0], p[i, 1], p[i, 2] = x[n, 0], x[n, 1], x[n, 2]
        else:
            n = Index(~number)
            p[i, 0], p[i, 1], p[i, 2] = others[n, 0], others[n, 1], others[n, 2]


@kernel(inline="always")
def barrier(delta, gap):  # type: ignore[no-untyped-def]
    """b / k of 0 < δ < gap and its first two derivatives."""
    left, part = gap - delta, gap / delta
    return left**3 / delta, left * left * (-2.0 - part) / delta, 2.0 * (part**3 - 1.0)


@leaf()
def _of_edges(p):  # type: ignore[no-untyped-def]
    """u·u, u·v and v·v of edges p0 p1 and p2 p3."""
    uu = uv = vv = 0.0
    for k in range(3):
        u, v = p[1, k] - p[0, k], p[3, k] - p[2, k]
        uu, uv, vv = uu + u * u, uv + u * v, vv + v * v
    return uu, uv, vv


@leaf()
def _mollifier(p, parallel, slope):  # type: ignore[no-untyped-def]
    """m of edges p0 p1 and p2 p3, m′, m″ with respect to sin² θ, whose gradient goes to slope (12,)."""
    uu, uv, vv = _of_edges(p)
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
def distances(x, others, kind, points, out):  # type: ignore[no-untyped-def]
    """|g| [m] of each pair, (E,)."""
    p = np.empty((4, 3))
    for e in range(len(out)):
        _load(x, others, points, e, p)
        out[e] = distance(kind[e], p)


@leaf()
def _ends(kind, points, e, b0, b1, b2, b3):  # type: ignore[no-untyped-def]
    """The nearest parts of a pair with β (4,): a vertex, and the ends of an edge or twice another vertex.

    Only of pairs of which a part is a vertex and the other no interior of a triangle.
    """
    if kind == EDGE_EDGE:
        if b0 != 0.0 and b1 != 0.0:  # the vertex is of the second edge
            return points[e, 2] if b2 != 0.0 else points[e, 3], points[e, 0], points[e, 1]
        v = points[e, 0] if b0 != 0.0 else points[e, 1]
        lo, hi = points[e, 2] if b2 != 0.0 else points[e, 3], points[e, 3] if b3 != 0.0 else points[e, 2]
        return v, lo, hi
    lo = points[e, 1] if b1 != 0.0 else (points[e, 2] if b2 != 0.0 else points[e, 3])
    hi = points[e, 3] if b3 != 0.0 else (points[e, 2] if b2 != 0.0 else points[e, 1])
    return points[e, 0], lo, hi


@leaf()
def _note(number, ends, at, count, apart, beta, e, one, other, share, delta, b1, b2, b3):  # type: ignore[no-untyped-def]  # fmt: skip
    """Count a nearest point on an edge, or twice a vertex, ``share`` times; how many there are."""
    both = (min(one, other) << 32) | (max(one, other) & 0xFFFFFFFF)  # points of obstacles are below 0
    place = 0
    while place < number and ends[place] != both:
        place += 1
    if place < number:
        count[place] += share
        return number
    ends[number], at[number], count[number], apart[number] = both, e, share, delta
    beta[number, 0], beta[number, 1], beta[number, 2] = b1, b2, b3
    return number + 1


@leaf()
def _around(p, points, e, offset, gap, shares, number, ends, at, count, apart, beta):  # type: ignore[no-untyped-def]
    """Note what is nearest to a vertex in triangle e, on its sides and at its corners; δ and how many."""
    a, b = (p[0, 0], p[0, 1], p[0, 2]), (p[1, 0], p[1, 1], p[1, 2])
    c, d = (p[2, 0], p[2, 1], p[2, 2]), (p[3, 0], p[3, 1], p[3, 2])
    i, j, k = points[e, 1], points[e, 2], points[e, 3]
    v, w = _in_triangle(a, b, c, d)
    b1, b2, b3 = v + w - 1.0, -v, -w
    delta = _length(p, 1.0, b1, b2, b3) - offset
    if not delta < gap:
        return delta, number
    # without a corner it is on the side before that, and there nearest of the side, too
    if b1 != 0.0 and b2 != 0.0 and b3 != 0.0:
        number = _note(number, ends, at, count, apart, beta, e, -1 - e, np.int64(0), 1.0, delta, b1, b2, b3)
    else:
        one = i if b1 != 0.0 else (j if b2 != 0.0 else k)
        other = k if b3 != 0.0 else (j if b2 != 0.0 else i)
        often = 1.0 + (shares[e, 0] if b3 == 0.0 else 0.0) + (shares[e, 1] if b1 == 0.0 else 0.0)
        often += shares[e, 2] if b2 == 0.0 else 0.0
        if one == other:
            often += shares[e, 3] if b1 != 0.0 else (shares[e, 4] if b2 != 0.0 else shares[e, 5])
        number = _note(number, ends, at, count, apart, beta, e, one, other, often, delta, b1, b2, b3)
    limit = (gap + offset) ** 2
    if b3 != 0.0 and shares[e, 0] != 0.0:
        t, square = _to_side(a, b, c)
        if square < limit:
            one, other, near = i if t < 1.0 else j, j if t > 0.0 else i, math.sqrt(square) - offset
            number = _note(
                number, ends, at, count, apart, beta, e, one, other, shares[e, 0], near, t - 1.0, -t, 0.0
            )
    if b1 != 0.0 and shares[e, 1] != 0.0:
        t, square = _to_side(a, c, d)
        if square < limit:
            one, other, near = j if t < 1.0 else k, k if t > 0.0 else j, math.sqrt(square) - offset
            number = _note(
                number, ends, at, count, apart, beta, e, one, other, shares[e, 1], near, 0.0, t - 1.0, -t
            )
    if b2 != 0.0 and shares[e, 2] != 0.0:
        t, square = _to_side(a, d, b)
        if square < limit:
            one, other, near = k if t < 1.0 else i, i if t > 0.0 else k, math.sqrt(square) - offset
            number = _note(
                number, ends, at, count, apart, beta, e, one, other, shares[e, 2], near, -t, 0.0, t - 1.0
            )
    corner = minus(a, b)
    square = dot(corner, corner)
    if square < limit and shares[e, 3] != 0.0 and (b2 != 0.0 or b3 != 0.0):
        near = math.sqrt(square) - offset
        number = _note(number, ends, at, count, apart, beta, e, i, i, shares[e, 3], near, -1.0, 0.0, 0.0)
    corner = minus(a, c)
    square = dot(corner, corner)
    if square < limit and shares[e, 4] != 0.0 and (b1 != 0.0 or b3 != 0.0):
        near = math.sqrt(square) - offset
        number = _note(number, ends, at, count, apart, beta, e, j, j, shares[e, 4], near, 0.0, -1.0, 0.0)
    corner = minus(a, d)
    square = dot(corner, corner)
    if square < limit and shares[e, 5] != 0.0 and (b1 != 0.0 or b2 != 0.0):
        near = math.sqrt(square) - offset
        number = _note(number, ends, at, count, apart, beta, e, k, k, shares[e, 5], near, 0.0, 0.0, -1.0)
    return delta, number


@leaf()
def _write(  # type: ignore[no-untyped-def]
    n, at, often, ours, share, energies, felt,
    e, weight, counted, b0, b1, b2, b3, p, delta, d, gap, stiffness, part,
):  # fmt: skip
    """Write a pair into row n of what is found, if there is one; how many rows there are then."""
    if n < len(at):
        energy = slope = second = 0.0
        if delta > 0.0:
            energy, slope, second = barrier(delta, gap)
        elif weight > 0.0:
            energy = slope = np.inf  # or no number
        at[n], often[n], ours[n], energies[n] = e, weight, counted, part * stiffness * energy
        share[n, 0], share[n, 1], share[n, 2], share[n, 3] = b0, b1, b2, b3
        for k in range(3):
            felt[n, k] = b0 * p[0, k] + b1 * p[1, k] + b2 * p[2, k] + b3 * p[3, k]
        felt[n, 3], felt[n, 4] = stiffness * slope / d, stiffness * second / (d * d)
    return n + 1


@leaf()
def _write_near(  # type: ignore[no-untyped-def]
    x, others, points, number, at, count, apart, beta, n_counted, offset, gap, stiffness, n, found, p
):
    """Write the nearest points of a vertex that count; how many rows of ``found`` there are then."""
    numbers, often, counted, share, energies, felt = found
    for m in range(number):
        if abs(count[m]) <= NONE:
            continue
        e, delta = at[m], apart[m]
        _load(x, others, points, e, p)
        ours, d = count[m] if e < n_counted else 0.0, delta + offset[e]
        b1, b2, b3 = beta[m, 0], beta[m, 1], beta[m, 2]
        n = _write(
            n, numbers, often, counted, share, energies, felt,
            e, count[m], ours, 1.0, b1, b2, b3, p, delta, d, gap[e], stiffness[e], 1.0,
        )  # fmt: skip
    return n


@kernel()
def meeting(x, others, kind, points, offset, gap, stiffness, parallel, shares, n_counted, least, found):  # type: ignore[no-untyped-def]  # fmt: skip
    """Find the pairs nearer than the gap, one of all those whose nearest points are on the same vertices.

    Parameters
    ----------
    gap : (E,)
        Below which distances less the offset [m] pairs feel each other.
    stiffness : (E,)
        The barrier's k [N/m]: the same of all pairs of one vertex, and of all others.
    shares : (E, 6)
        Of a triangle before a vertex of a sheet: how often its sides, from each corner to the next, and its
        corners count. Pairs of a vertex next to each other are looked at together.
    n_counted : int
        The first pairs, which this rank counts.
    least : (E,)
        What the distance less the offset [m] is not below; exactly that where it is below the gap.
    found : tuple of (room,), (room,), (room,), (room, 4), (room,), (room, 5)
        Numbers of the pairs, of which one may be there several times; how often each counts, and how often
        for this rank; β and the energy [J] of one pair; g, b′ / d and b″ / d² where it does not fade.

    Returns
    -------
    n : int
        How many there are: the first rows of ``found``, as many as have room.
    """
    numbers, often, for_us, share, energies, felt = found
    p, q, slope = np.empty((4, 3)), np.empty((4, 3)), np.zeros(12)
    n: Any = np.int64(0)  # 0 has a type of its own, for which all that takes it is compiled once more
    first, following = np.full(len(x), -1), np.full(0, -1)  # lists, by a vertex
    alike = np.empty((0, 3), dtype=np.int64)  # nearest vertex and edge, or a second vertex twice
    ends, at, count = np.empty(TOGETHER, np.int64), np.empty(TOGETHER, np.int64), np.empty(TOGETHER)
    apart, beta, number, vertex = np.empty(TOGETHER), np.empty((TOGETHER, 3)), n, -1
    for e in range(len(kind)):
        _load(x, others, points, e, p)
        if kind[e] == VERTEX_TRIANGLE and points[e, 0] >= 0:
            if points[e, 0] != vertex or number > TOGETHER - 7:
                n = _write_near(
                    x,
                    others,
                    points,
                    number,
                    at,
                    count,
                    apart,
                    beta,
                    n_counted,
                    offset,
                    gap,
                    stiffness,
                    n,
                    found,
                    q,
                )
                number, vertex = 0, points[e, 0]
            delta, number = _around(
                p, points, e, offset[e], gap[e], shares, number, ends, at, count, apart, beta
            )
            least[e] = delta
            continue
        least[e] = at_least(p, kind[e]) - offset[e]
        if least[e] >= gap[e]:
            continue
        behind = kind[e] == VERTEX_INSIDE
        if kind[e] == VERTEX_PLANE:
            behind = _around_foot(p)
        b0, b1, b2, b3 = _weights(kind[e], p)
        d = _length(p, b0, b1, b2, b3)
        delta = least[e] = (-d if behind else d) - offset[e]
        if delta >= gap[e]:
            continue
        ours, part = 1.0 if e < n_counted else 0.0, 1.0
        if kind[e] == EDGE_EDGE:
            part = _mollifier(p, parallel, slope)[0]
        # edges whose energy fades are not like others
        if part == 1.0 and kind[e] <= EDGE_EDGE and (b0 == 0.0 or b1 == 0.0 or b2 == 0.0 or b3 == 0.0):
            v, lo, hi = _ends(kind[e], points, e, b0, b1, b2, b3)
            if lo == hi:
                v, lo, hi = max(v, lo), min(v, lo), min(v, lo)
            elif lo > hi:
                lo, hi = hi, lo
            row = Index(max(v, hi) if v < 0 else v)
            other = first[row]
            while other >= 0 and (alike[other, 0] != v or alike[other, 1] != lo or alike[other, 2] != hi):
                other = following[other]
            if other >= 0:
                if other < len(numbers):
                    often[other] += 1.0
                    for_us[other] += ours
                continue
            if n >= len(alike):
                alike, following = _longer(alike, following, n)
            alike[n, 0], alike[n, 1], alike[n, 2] = v, lo, hi
            following[n], first[row] = first[row], n
        d = -d if behind else d
        n = _write(
            n, numbers, often, for_us, share, energies, felt,
            e, 1.0, ours, b0, b1, b2, b3, p, delta, d, gap[e], stiffness[e], part,
        )  # fmt: skip
    return _write_near(
        x, others, points, number, at, count, apart, beta, n_counted, offset, gap, stiffness, n, found, q
    )


@kernel()
def _longer(alike, following, n):  # type: ignore[no-untyped-def]
    """Copies with room for a row n and as many more."""
    more, after = np.empty((2 * n + 64, 3), dtype=np.int64), np.full(2 * n + 64, -1)
    for row in range(len(following)):  # arrays as a whole would take seconds to compile
        more[row, 0], more[row, 1], more[row, 2] = alike[row, 0], alike[row, 1], alike[row, 2]
        after[row] = following[row]
    return more, after


@leaf()
def _between(x, others, kind, points, beta, e, n, p, g):  # type: ignore[no-untyped-def]
    """Points of pair e into p (4, 3) and Σ β_ni p_i into g (3,); the distance, as `distance` gives it."""
    _load(x, others, points, e, p)
    behind = kind[e] == VERTEX_INSIDE
    if kind[e] == VERTEX_PLANE:
        behind = _around_foot(p)
    square = 0.0
    for k in range(3):
        g[k] = beta[n, 0] * p[0, k] + beta[n, 1] * p[1, k] + beta[n, 2] * p[2, k] + beta[n, 3] * p[3, k]
        square += g[k] * g[k]
    return -math.sqrt(square) if behind else math.sqrt(square)


@kernel()
def add_gradient(x, others, kind, points, offset, gap, stiffness, parallel, met, out, pull):  # type: ignore[no-untyped-def]  # fmt: skip
    """Add the gradient [N] of what `meeting` found to rows of out (n_local, 3), of obstacles' points to pull.

    ``met`` are numbers of pairs, how often each counts, β, and what is felt there.
    """
    p, more = np.empty((4, 3)), np.zeros(12)
    at, weight, beta, felt = met
    for m in range(len(at)):
        e = at[m]
        slope, turn = weight[m] * felt[m, 3], 0.0
        if kind[e] == EDGE_EDGE:
            _load(x, others, points, e, p)
            part, first, _ = _mollifier(p, parallel, more)
            if part < 1.0:
                d = _length(p, beta[m, 0], beta[m, 1], beta[m, 2], beta[m, 3])
                delta = d - offset[e]
                slope *= part
                energy = stiffness[e] * barrier(delta, gap[e])[0] if delta > 0.0 else np.nan
                turn = weight[m] * energy * first
        for i in range(4):
            if beta[m, i] == 0.0 and turn == 0.0:
                continue
            for k in range(3):
                force = slope * beta[m, i] * felt[m, k]
                if turn != 0.0:
                    force += turn * more[3 * i + k]
                if points[e, i] >= 0:
                    out[Index(points[e, i]), k] += force
                else:
                    pull[Index(~points[e, i]), k] += force


@leaf()
def _add_fading(p, beta, g, gap, delta, stiffness, force, blend, parallel, slope, h):  # type: ignore[no-untyped-def]
    """Let the Hessian h (4, 4, 3, 3) of two edges whose energy does not fade be that where it does."""
    part, once, twice = _mollifier(p, parallel, slope)
    if part == 1.0:
        return
    energy, exact = (1.0 - blend) * stiffness * barrier(delta, gap)[0], (1.0 - blend) * once * force
    for i in range(4):
        for j in range(4):
            for k in range(3):
                pull, to = exact * beta[i] * g[k], slope[3 * i + k]
                for m in range(3):
                    push, by = exact * beta[j] * g[m], slope[3 * j + m]
                    h[i, j, k, m] = part * h[i, j, k, m] + pull * by + to * push + energy * twice * to * by
    _add_turn(p, energy * once, h)


@leaf()
def _add_turn(p, factor, h):  # type: ignore[no-untyped-def]
    """Add factor times the Hessian of sin² θ to h (4, 4, 3, 3)."""
    uu, uv, vv = _of_edges(p)
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
            one = scale * (a * to_u - uv / uu * (uk * to_u + uv * same))
            other = scale * (b * to_v - uv / vv * (vk * to_v + uv * same))
            mixed = scale * (a * to_v + uv * (same - uk * um / uu))
            for i in range(2):
                for j in range(2):
                    sign = 1.0 if i == j else -1.0
                    h[i, j, k, m] += sign * one
                    h[2 + i, 2 + j, k, m] += sign * other
                    h[i, 2 + j, k, m] += sign * mixed
                    h[2 + j, i, m, k] += sign * mixed


@kernel()
def add_hessians(x, others, kind, points, offset, gap, stiffness, parallel, met, blend, offsets, values):  # type: ignore[no-untyped-def]  # fmt: skip
    """Add the Hessians [N/m] of what `meeting` found to block rows values (n_blocks, 3, 3).

    ``met`` as of `add_gradient`; ``offsets`` (E, 10) as of `kernels.scatter`. No rows for obstacles.
    ``blend`` 0 is exact, 1 keeps b″ g gᵀ / |g|² only (positive semidefinite).
    """
    p, across, gamma, e = np.empty((4, 3)), np.empty((4, 3)), np.empty((2, 4)), np.zeros((2, 3))
    room = p, across, gamma, e, np.empty((4, 4, 3, 3)), np.zeros(12)
    blocks = values.reshape(-1, 9)
    for n in range(len(met[0])):
        fetch_ahead(met[0][Index(min(n + AHEAD, len(met[0]) - 1))], offsets, blocks, 10, 0)
        _add_hessian(
            n, x, others, kind, points, offset, gap, stiffness, parallel,
            met, blend, offsets, room, values, blocks,
        )  # fmt: skip


@leaf()
def _add_hessian(  # type: ignore[no-untyped-def]
    n, x, others, kind, points, offset, gap, stiffness, parallel, met, blend, offsets, room, values, blocks
):  # fmt: skip
    """Add that of row n of what was found; what ``room`` holds is of no use later."""
    at, weight, beta, felt = met
    pair, b, g = at[n], beta[n], felt[n]
    factor = weight[n] if weight[n] > 0.0 else (1.0 - blend) * weight[n]
    if factor == 0.0 or not abs(g[3]) < np.inf:
        return
    p, across, gamma, e, h, slope = room
    first, edges = (1.0 - blend) * g[3], kind[pair] == EDGE_EDGE
    free = _free(kind[pair], b, gamma) if first != 0.0 else 0
    if free > 0 or edges:
        _load(x, others, points, pair, p)
    if free > 0 and kind[pair] == VERTEX_PLANE:
        _around_foot(p)
    _directions(gamma, p, free, e)
    if not edges or not _fades(p, parallel):
        _add_outers(factor, points[pair], g, b, first, free, gamma, e, offsets[pair], across, blocks)
        return
    _hessian(g, b, first, free, gamma, e, h)
    delta = math.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2) - offset[pair]
    _add_fading(p, b, g, gap[pair], delta, stiffness[pair], g[3], blend, parallel, slope, h)
    for i in range(4):
        if points[pair, i] < 0:
            h[i], h[:, i] = 0.0, 0.0
    add_element(factor, h, offsets[pair], values)


@leaf()
def _directions(gamma, p, free, e):  # type: ignore[no-untyped-def]
    """e_k of p (4, 3) into e (2, 3)."""
    for f in range(free):
        for k in range(3):
            e[f, k] = 0.0
            for i in range(4):
                e[f, k] += gamma[f, i] * p[i, k]


@leaf()
def _inverse(free, e):  # type: ignore[no-untyped-def]
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
def _add_outers(factor, points, felt, beta, first, free, gamma, e, offsets, across, blocks):  # type: ignore[no-untyped-def]  # fmt: skip
    """Add that of a pair which does not fade, as products of two vectors, to blocks (n_blocks, 9).

    Where two coordinates are free the e_k span what is across g: I − Σ A⁻¹_kl e_k e_lᵀ is g gᵀ / |g|². Let
    ``across`` (4, 3) be Σ A⁻¹_kl γ_ki e_l then, and β_i e + γ_i g where one is.
    """
    g = felt[0], felt[1], felt[2]
    second = factor * felt[4]
    first = factor * first
    a00, a01, a11 = _inverse(free, e)
    along = second if free == 2 else second - first / dot(g, g)
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
                own -= first * dot(p, q)
                left = combined(own, g, -first * b, q)
                add_outers(blocks, to, 0.0, ((left, g), (g, scaled(-first * c, p))))
            elif free == 1:
                add_outers(blocks, to, b * c * first, ((scaled(own, g), g), (scaled(-first * a00, p), q)))
            else:
                add_outers(blocks, to, b * c * first, ((scaled(own, g), g),))


@leaf()
def _hessian(felt, beta, first, free, gamma, e, h):  # type: ignore[no-untyped-def]
    """Let h (4, 4, 3, 3) be that of a pair, were it not to fade."""
    square = felt[0] ** 2 + felt[1] ** 2 + felt[2] ** 2
    along = felt[4] - first / square
    a00, a01, a11 = _inverse(free, e)
    for i in range(4):
        for j in range(4):
            both = beta[i] * beta[j]
            for k in range(3):
                c0 = beta[i] * e[0, k] + gamma[0, i] * felt[k] if free > 0 else 0.0
                c1 = beta[i] * e[1, k] + gamma[1, i] * felt[k] if free > 1 else 0.0
                for m in range(3):
                    d0 = beta[j] * e[0, m] + gamma[0, j] * felt[m] if free > 0 else 0.0
                    d1 = beta[j] * e[1, m] + gamma[1, j] * felt[m] if free > 1 else 0.0
                    value = along * both * felt[k] * felt[m] + (first * both if k == m else 0.0)
                    value -= first * (c0 * (a00 * d0 + a01 * d1) + c1 * (a01 * d0 + a11 * d1))
                    h[i, j, k, m] = value


@leaf()
def _fades(p, parallel):  # type: ignore[no-untyped-def]
    """Whether the energy of two edges does."""
    uu, uv, vv = _of_edges(p)
    return not uu * vv - uv * uv >= uu * vv * parallel


@leaf()
def speed(kind, w):  # type: ignore[no-untyped-def]
    """How much the distance of a pair changes at most on the ways w (4, 3) [m], without what is common."""
    for k in range(3):
        mean = 0.25 * (w[0, k] + w[1, k] + w[2, k] + w[3, k])
        for i in range(4):
            w[i, k] -= mean
    one = other = 0.0
    begins = 2 if kind == EDGE_EDGE else 1
    for i in range(4):
        square = w[i, 0] * w[i, 0] + w[i, 1] * w[i, 1] + w[i, 2] * w[i, 2]
        if i < begins:
            one = max(one, square)
        else:
            other = max(other, square)
    return math.sqrt(one) + math.sqrt(other)


@leaf()
def _plane_speed(p, w, most):  # type: ignore[no-untyped-def]
    """The same of a vertex and a plane, up to a fraction ``most`` of the ways."""
    way = arm = turn = 0.0
    for k in range(3):
        w[0, k] -= w[1, k]
        w[1, k] = 0.0
        way += w[0, k] * w[0, k]
        arm += (p[0, k] - p[1, k]) ** 2
        turn += w[2, k] * w[2, k]
    if turn > 3.0:
        return math.inf
    # up to there the normal on its way has at least half its length
    way, turn = math.sqrt(way), 2.0 * math.sqrt(turn)
    return way + turn * (math.sqrt(arm) + most * way)


@leaf()
def _longest(w, lo, hi):  # type: ignore[no-untyped-def]
    square = 0.0
    for i in range(lo, hi):
        square = max(square, w[i, 0] ** 2 + w[i, 1] ** 2 + w[i, 2] ** 2)
    return math.sqrt(square)


@kernel()
def approaches(x, others, way, others_way, kind, points, reach, out):  # type: ignore[no-untyped-def]
    """What the distances [m] of pairs of simplices are not below, (E,), on ways (n_local, 3), (m, 3) [m].

    Both parts of a sheet are as far on their ways as each other, obstacles anywhere on theirs. From
    ``reach`` (E,) on it may be any number beyond.
    """
    p, w = np.empty((4, 3)), np.empty((4, 3))
    for e in range(len(out)):
        _load(x, others, points, e, p)
        _load(way, others_way, points, e, w)
        if points[e].min() >= 0:
            nearer = speed(kind[e], w)
        else:
            begins = 2 if kind[e] == EDGE_EDGE else 1
            nearer = _longest(w, 0, begins) + _longest(w, begins, 4)
        out[e] = at_least(p, kind[e]) - nearer
        if out[e] >= reach[e]:
            continue
        d = distance(kind[e], p)
        out[e] = d - nearer


@leaf()
def _ahead_of(p, kind, before, beta, n):  # type: ignore[no-untyped-def]
    """Distance of a pair at p (4, 3), its β (4,), and the unit vector n (3,) in which it grows; the distance
    is negative where the pair has passed what was on the side ``before`` (3,), unless that is 0.
    """
    behind = kind == VERTEX_INSIDE
    if kind == VERTEX_PLANE:
        behind = _around_foot(p)
    beta[0], beta[1], beta[2], beta[3] = _weights(kind, p)
    square = along = 0.0
    for k in range(3):
        n[k] = beta[0] * p[0, k] + beta[1] * p[1, k] + beta[2] * p[2, k] + beta[3] * p[3, k]
        square, along = square + n[k] * n[k], along + n[k] * before[k]
    d = -math.sqrt(square) if behind or along < 0.0 else math.sqrt(square)
    for k in range(3):
        n[k] = n[k] / d if d != 0.0 else 0.0
    return d


@leaf()
def _where(force, gap):  # type: ignore[no-untyped-def]
    """δ at which −b′ / k of the barrier is ``force`` [m] > 0, or a little less."""
    # near 0 the force is below 2 gap³ / δ², and beyond that more than it would be there
    low, high = min(0.5, 0.1 * math.sqrt(gap / (gap + force))) * gap, gap
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if -barrier(middle, gap)[1] > force:
            low = middle
        else:
            high = middle
    return low


@kernel()
def target_distances(x, others, way, kind, points, offset, gap, most, foreseen, aim, before, presses):  # type: ignore[no-untyped-def]  # fmt: skip
    """Least distances less the offsets (E,) [m] that pairs should have after a ``way`` (n_local, 3) [m] of
    Newton's.

    Where the barrier's force over k [m] is what it is in the linear model, that is ``foreseen`` (E,), or no
    number where that is Newton's own; else at the part ``most`` of the gap, which no aim is beyond; −∞ of
    pairs that stay apart. On which side (E, 3) parts are that would pass each other; 0 where distances tell.
    Whether a pair presses (E,) in the linear model.
    """
    p, n, beta, none = np.empty((4, 3)), np.empty(3), np.empty(4), np.zeros(3)
    nearer = 2.0 * _farthest(way)
    for e in range(len(kind)):
        aim[e], presses[e] = -math.inf, False
        _load(x, others, points, e, p)
        if at_least(p, kind[e]) - offset[e] - nearer >= gap[e]:
            continue
        d = _ahead_of(p, kind[e], none, beta, n)
        delta = d - offset[e]
        if not 0.0 < delta < gap[e] + nearer:
            continue
        aim[e] = most * gap[e]
        if kind[e] <= EDGE_EDGE:
            for k in range(3):
                before[e, k] = n[k]
        force = foreseen[e]
        if math.isnan(force) and delta < gap[e]:
            along = 0.0
            for i in range(4):
                if points[e, i] >= 0:
                    for k in range(3):
                        along += beta[i] * n[k] * way[Index(points[e, i]), k]
            _, slope, second = barrier(delta, gap[e])
            force = -slope - second * along
        if force > 0.0:
            aim[e], presses[e] = min(aim[e], _where(force, gap[e])), True


@kernel()
def one_sided(x, others, way, kind, points, offset, gap, stiffness, parallel, met, n_counted, found):  # type: ignore[no-untyped-def]  # fmt: skip
    """Springs with the law of the barrier on distances that are linear in a step: of what touches, and of
    what may after a ``way`` (n_local, 3) [m].

    Parameters
    ----------
    met : tuple
        Numbers, how often they count, for this rank too, β and what is felt of the pairs of `meeting`.
    found : tuple of (room,), (room, 4), (room, 3), (room,), (room,), (room,)
        Numbers of the pairs, β, unit normals, how often each counts times its k [N/m], δ at x [m],
        and how often they count for this rank.

    Returns
    -------
    n, m : int
        How many there are: the first rows of ``found``, of which n touch.
    """
    numbers, beta, normal, spring, length, counted = found
    at, often, ours, given, felt = met
    p, u, b, none, n = np.empty((4, 3)), np.empty(3), np.empty(4), np.zeros(3), 0
    for m in range(len(at)):
        e = at[m]
        if not often[m] > 0.0 or not felt[m, 4] > 0.0 or not felt[m, 4] < np.inf:
            continue
        if kind[e] == EDGE_EDGE:
            _load(x, others, points, e, p)
            if _fades(p, parallel):
                continue
        d = math.sqrt(felt[m, 0] ** 2 + felt[m, 1] ** 2 + felt[m, 2] ** 2)
        d = -d if kind[e] == VERTEX_INSIDE else d
        numbers[n], spring[n], counted[n] = e, often[m] * stiffness[e], ours[m] / often[m]
        length[n] = d - offset[e]
        for i in range(4):
            beta[n, i] = given[m, i]
        for k in range(3):
            normal[n, k] = felt[m, k] / d
        n += 1
    first, nearer = n, 2.0 * _farthest(way)
    for e in range(len(kind)):
        _load(x, others, points, e, p)
        if at_least(p, kind[e]) - offset[e] - nearer >= gap[e]:
            continue
        delta = _ahead_of(p, kind[e], none, b, u) - offset[e]
        # what is nearer was met, by itself or by one whose nearest points are the same
        if not gap[e] <= delta < gap[e] + nearer or (kind[e] == EDGE_EDGE and _fades(p, parallel)):
            continue
        if n < len(numbers):
            numbers[n], spring[n], length[n] = e, stiffness[e], delta
            counted[n] = 1.0 if e < n_counted else 0.0
            for i in range(4):
                beta[n, i] = b[i]
            for k in range(3):
                normal[n, k] = u[k]
        n += 1
    return first, n


@kernel()
def law(delta, gap, least, force, stiffness):  # type: ignore[no-untyped-def]
    """−b′ / k [m] and b″ / k of distances (n,) [m], below ``least`` (n,) [m] along the tangent there."""
    for m in range(len(delta)):
        at = max(delta[m], least[m])
        if at >= gap[m]:
            force[m] = stiffness[m] = 0.0
            continue
        _, slope, stiffness[m] = barrier(at, gap[m])
        force[m] = stiffness[m] * (at - delta[m]) - slope


@kernel()
def chords(delta, gap, least, force, expected, out):  # type: ignore[no-untyped-def]
    """Slopes (n,) of `law`, from where it is ``force`` (n,) [m] to where it is ``expected`` (n,) [m]; the
    tangent's where that is the same.
    """
    for m in range(len(delta)):
        _, slope, second = barrier(least[m], gap[m])
        if expected[m] <= 0.0:
            there = gap[m]
        elif expected[m] >= -slope:
            there = least[m] - (expected[m] + slope) / second
        else:
            there = _where(expected[m], gap[m])
        if abs(there - delta[m]) > CHORD * gap[m]:
            out[m] = max(0.0, (expected[m] - force[m]) / (delta[m] - there))
        else:
            out[m] = barrier(max(delta[m], least[m]), gap[m])[2] if delta[m] < gap[m] else 0.0


@kernel()
def add_corrections(x, others, way, kind, points, offset, gap, aim, before, presses, least, out, count):  # type: ignore[no-untyped-def]  # fmt: skip
    """How pairs that are nearer than they should be after a way are to be pushed apart; how many there are.

    And those that press in the linear model, but leave the gap, as tangents of what is round do, pulled back.

    Added to ``out`` (n_local, 3) [m], each push times what is added to ``count`` (n_local,), its weight.
    ``aim``, ``before``, ``presses`` as of `target_distances`; what is short by less than ``least`` times the
    gap stays.
    """
    p, n, beta, found = np.empty((4, 3)), np.empty(3), np.empty(4), 0
    for e in range(len(kind)):
        if not aim[e] > -math.inf:
            continue
        _load(x, others, points, e, p)
        for i in range(4):
            if points[e, i] >= 0:
                for k in range(3):
                    p[i, k] += way[Index(points[e, i]), k]
        short = aim[e] + offset[e] - _ahead_of(p, kind[e], before[e], beta, n)
        square = 0.0
        for i in range(4):
            if points[e, i] >= 0:
                square += beta[i] * beta[i]
        leaves = presses[e] and aim[e] - short >= gap[e]
        if not (short > least * gap[e] or leaves) or not square > 0.0:
            continue
        found += 1
        for i in range(4):
            if points[e, i] >= 0 and beta[i] != 0.0:
                row, share = Index(points[e, i]), abs(beta[i])
                count[row] += share
                for k in range(3):
                    out[row, k] += share * short * beta[i] / square * n[k]
    return found


@leaf()
def _farthest(ways):  # type: ignore[no-untyped-def]
    """Length [m] of the longest of ways (n, 3)."""
    most = 0.0
    for i in range(len(ways)):
        square = ways[i, 0] ** 2 + ways[i, 1] ** 2 + ways[i, 2] ** 2
        if not square <= most:  # or no number
            most = square
    return math.sqrt(most)


@leaf()
def approach(way, others_way):  # type: ignore[no-untyped-def]
    """By how much [m] two points, one of them of a sheet, come nearer at most."""
    farthest = _farthest(way)
    return farthest + max(farthest, _farthest(others_way))


@kernel()
def free_fraction(x, others, way, others_way, kind, points, offset, far, keep, most):  # type: ignore[no-untyped-def]  # fmt: skip
    """Fraction, up to ``most``, of ways (n_local, 3), (m, 3) [m] along which no pair comes too near.

    Each keeps at least the part ``keep`` of its distance less the offset, or of ``far`` (E,) [m] where that
    is less. Additive continuous collision
    detection: Li, Kaufman & Jiang, Codimensional incremental potential contact, ACM Trans. Graph. 40 (2021)
    170, algorithm 1. Of a plane that turns by more than 120° nothing is free.
    """
    nearer = approach(way, others_way)
    return _pairs_free_fraction(x, others, way, others_way, nearer, kind, points, offset, far, keep, most)


@kernel()
def _pairs_free_fraction(x, others, way, others_way, nearer, kind, points, offset, far, keep, most):  # type: ignore[no-untyped-def]  # fmt: skip
    """The same; no two points come nearer by more than ``nearer`` [m]."""
    p, w = np.empty((4, 3)), np.empty((4, 3))
    for e in range(len(kind)):
        _load(x, others, points, e, p)
        plane = kind[e] == VERTEX_PLANE
        if not plane and most * nearer <= (1.0 - keep) * (at_least(p, kind[e]) - offset[e]):
            continue
        _load(way, others_way, points, e, w)
        pace = _plane_speed(p, w, most) if plane else speed(kind[e], w)
        d = distance(kind[e], p)
        left = d - offset[e]
        counts = min(left, far[e])
        if left - most * pace >= keep * counts or pace == 0.0:
            continue
        if not pace < math.inf:
            return 0.0
        least, enough, t = keep * counts, (1.0 - keep) * CLOSE * counts, 0.0
        # each advance is shorter than what is left of the way to the least distance
        advances = 0
        while left - least > enough and advances < ADVANCES:
            advances += 1
            t += (left - least) / pace
            if t >= most:
                break
            _load(x, others, points, e, p)
            for i in range(4):
                for k in range(3):
                    p[i, k] += t * w[i, k]
            d = distance(kind[e], p)
            left = d - offset[e]
        most = min(most, t)
    return most


@kernel()
def may_collide(x, others, way, others_way, kind, points, offset, gap, far):  # type: ignore[no-untyped-def]
    """Whether any pair may come into its gap on ways (n_local, 3), (m, 3) [m] on which its parts come nearer
    to each other by more than ``far`` [m].
    """
    if approach(way, others_way) <= far:
        return False
    p, w = np.empty((4, 3)), np.empty((4, 3))
    for e in range(len(kind)):
        _load(x, others, points, e, p)
        _load(way, others_way, points, e, w)
        pace = _plane_speed(p, w, 1.0) if kind[e] == VERTEX_PLANE else speed(kind[e], w)
        if pace > far and distance(kind[e], p) - offset[e] < pace + gap[e]:
            return True
    return False


@leaf()
def _force(p, kind, delta, gap, stiffness, parallel, slope):  # type: ignore[no-untyped-def]
    """Normal force [N] of a pair; 0 out of the barrier's reach."""
    if not 0.0 < delta < gap:
        return 0.0
    force = -stiffness * barrier(delta, gap)[1]
    return force * _mollifier(p, parallel, slope)[0] if kind == EDGE_EDGE else force


@leaf()
def alone(kind, points, e):  # type: ignore[no-untyped-def]
    """Whether what touches is told pair by pair: not of a vertex of a sheet before something."""
    return kind[e] == EDGE_EDGE or points[e, 0] < 0


@kernel()
def find_contacts(x, others, kind, points, offset, gap, stiffness, parallel, least, met, n_counted, found):  # type: ignore[no-untyped-def]  # fmt: skip
    """Find which of the first ``n_counted`` pairs touch.

    Of vertices of sheets those that `meeting` found, ``met`` being their numbers, how often each counts, and
    β; of others each whose distance less the offset is not below ``least`` (E,) [m]. β, unit normals towards
    the first simplex, normal forces [N], which may be negative, and numbers of pairs go to the first rows of
    ``found``, (m, 4), (m, 3), (m,) and (m,), as many as are returned.
    """
    p, g, slope, n = np.empty((4, 3)), np.empty(3), np.zeros(12), 0
    beta, normal, force, at = found
    numbers, weight, given, felt = met
    for m in range(len(numbers) + n_counted):
        e = numbers[m] if m < len(numbers) else m - len(numbers)
        if e >= n_counted or least[e] >= gap[e] or alone(kind, points, e) != (m >= len(numbers)):
            continue
        if m < len(numbers):
            for k in range(3):
                g[k] = felt[m, k]
            d = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
            d = -d if kind[e] == VERTEX_INSIDE else d
            for i in range(4):
                beta[n, i] = given[m, i]
            force[n] = -weight[m] * felt[m, 3] * d
        else:
            _load(x, others, points, e, p)
            beta[n, 0], beta[n, 1], beta[n, 2], beta[n, 3] = _weights(kind[e], p)
            d = _between(x, others, kind, points, beta, e, n, p, g)
            force[n] = _force(p, kind[e], d - offset[e], gap[e], stiffness[e], parallel, slope)
        if force[n] == 0.0:
            continue
        for k in range(3):
            normal[n, k] = g[k] / d
        at[n] = e
        n += 1
    return n


@kernel()
def share_negative(kind, vertex, normal, force):  # type: ignore[no-untyped-def]
    """Take negative normal forces (E,) [N] off the positive ones that the vertex feels from the same side.

    They stand where the surface before a vertex of a sheet is hollow; what is left there is 0. A vertex
    between two layers feels both, each for itself. Pairs of a vertex are next to each other.
    """
    begin = 0
    while begin < len(force):
        end = begin + 1
        while end < len(force) and vertex[end] == vertex[begin] and kind[end] == kind[begin]:
            end += 1
        for j in range(begin, end):
            if not force[j] < 0.0 or kind[j] != VERTEX_TRIANGLE or vertex[j] < 0:
                continue
            positive = 0.0
            for i in range(begin, end):
                if force[i] > 0.0 and dot(normal[i], normal[j]) > 0.0:
                    positive += force[i]
            left = max(0.0, 1.0 + force[j] / positive) if positive > 0.0 else 0.0
            for i in range(begin, end):
                if force[i] > 0.0 and dot(normal[i], normal[j]) > 0.0:
                    force[i] *= left
            force[j] = 0.0
        begin = end


@kernel()
def free_fractions(x, others, way, others_way, kind, points, offset, far, keep, out):  # type: ignore[no-untyped-def]
    """What `free_fraction` gives for each of the first len(out) pairs alone."""
    nearer = approach(way, others_way)
    for e in range(len(out)):
        one = slice(e, e + 1)
        pair = kind[one], points[one], offset[one], far[one]
        out[e] = _pairs_free_fraction(x, others, way, others_way, nearer, *pair, keep, 1.0)


@kernel()
def add_normal_forces(points, beta, force, out):  # type: ignore[no-untyped-def]
    """Add the normal force (E,) [N] of each pair to its vertices in out (n_local,), by their shares |β_i|."""
    for e in range(len(force)):
        for i in range(4):
            if points[e, i] >= 0:
                out[Index(points[e, i])] += force[e] * abs(beta[e, i])
