"""The barrier energy of close pairs: pure functions on arrays.

The vector between the nearest points of a pair is g = Σ β_i p_i (`pair_distances`). None to two barycentric
coordinates t_k are free at the
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

from lyra_petsc.contact.barrier_law import barrier, edge_products, mollifier_of
from lyra_petsc.contact.pair_distances import (
    EDGE_EDGE,
    VERTEX_INSIDE,
    VERTEX_PLANE,
    VERTEX_TRIANGLE,
    between,
    box_distance,
    load_points,
    nearest_coefficients,
    nearest_in_triangle,
    nearest_on_segment,
    norm,
    plane_to_triangle,
    stands_behind,
)
from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel, leaf, subkernel
from lyra_petsc.kernels.scatter import AHEAD, add_element, fetch_ahead
from lyra_petsc.kernels.vector3 import combined, dot, minus, point, scaled
from lyra_petsc.kernels.vectors import add_outers

NEGLIGIBLE = 1e-6
"""Weight below which a pair is left out."""

MAX_POINTS = 256
"""Nearest points of one vertex that are compared with each other, at most."""


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
def _add_point(n, nearest, e, first, second, share, delta, b):  # type: ignore[no-untyped-def]
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
    beta[n, 0], beta[n, 1], beta[n, 2] = b
    return n + 1


@leaf()
def _at_corners(i, first, second):  # type: ignore[no-untyped-def]
    """β of the corners of a triangle if those of corner i and of the next are given."""
    if i == 0:
        return first, second, 0.0
    return (0.0, first, second) if i == 1 else (second, 0.0, first)


@leaf()
def _add_triangle(p, points, e, offset, gap, shares, n, nearest):  # type: ignore[no-untyped-def]
    """Add the nearest points of a vertex in triangle e, on its sides and at its corners to the list.

    Returns δ of the triangle and the number of points.
    """
    a, corners = point(p, 0), (point(p, 1), point(p, 2), point(p, 3))
    v, w = nearest_in_triangle(a, corners[0], corners[1], corners[2])
    b = v + w - 1.0, -v, -w
    delta = norm(p, 1.0, b[0], b[1], b[2]) - offset
    if not delta < gap:
        return delta, n
    # a zero coefficient means that the point is on a side, and then it is also nearest on that side
    if b[0] != 0.0 and b[1] != 0.0 and b[2] != 0.0:
        n = _add_point(n, nearest, e, -1 - e, np.int64(0), 1.0, delta, b)
    else:
        weight, first, last = 1.0, -1, 0
        for i in range(3):
            if b[i] == 0.0:
                weight += shares[e, (i + 1) % 3]
            else:
                first, last = i if first < 0 else first, i
        if first == last:
            weight += shares[e, 3 + first]
        n = _add_point(n, nearest, e, points[e, 1 + first], points[e, 1 + last], weight, delta, b)
    limit = (gap + offset) ** 2
    for i in range(3):
        j, opposite = (i + 1) % 3, (i + 2) % 3
        if b[opposite] != 0.0 and shares[e, i] != 0.0:
            t, square = nearest_on_segment(a, corners[i], corners[j])
            if square < limit:
                first, last = points[e, 1 + (i if t < 1.0 else j)], points[e, 1 + (j if t > 0.0 else i)]
                on_side, side_delta = _at_corners(i, t - 1.0, -t), math.sqrt(square) - offset
                n = _add_point(n, nearest, e, first, last, shares[e, i], side_delta, on_side)
    for i in range(3):
        corner = minus(a, corners[i])
        square = dot(corner, corner)
        elsewhere = b[(i + 1) % 3] != 0.0 or b[(i + 2) % 3] != 0.0
        if square < limit and shares[e, 3 + i] != 0.0 and elsewhere:
            at_corner, corner_delta = _at_corners(i, -1.0, 0.0), math.sqrt(square) - offset
            number = points[e, 1 + i]
            n = _add_point(n, nearest, e, number, number, shares[e, 3 + i], corner_delta, at_corner)
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
        derivatives[n, 0], derivatives[n, 1], derivatives[n, 2] = between(p, b0, b1, b2, b3)
        derivatives[n, 3], derivatives[n, 4] = stiffness * slope / d, stiffness * second / (d * d)
        derivatives[n, 5] = mollifier
    return n + 1


@leaf()
def _write_points(x, x_obs, points, n_points, nearest, n_counted, offset, gap, stiffness, n, out, p):  # type: ignore[no-untyped-def]
    """Write the nearest points of a vertex whose weight is not negligible; returns the number of rows in
    ``out``.
    """
    _, pairs, weights, deltas, beta = nearest
    out_pairs, out_weights, out_owned, out_beta, energies, derivatives = out
    for m in range(n_points):
        if abs(weights[m]) <= NEGLIGIBLE:
            continue
        e, delta = pairs[m], deltas[m]
        load_points(x, x_obs, points, e, p)
        owned_weight, d = weights[m] if e < n_counted else 0.0, delta + offset[e]
        b1, b2, b3 = beta[m, 0], beta[m, 1], beta[m, 2]
        n = _write_row(
            n, out_pairs, out_weights, out_owned, out_beta, energies, derivatives,
            e, weights[m], owned_weight, 1.0, b1, b2, b3, p, delta, d, gap[e], stiffness[e], 1.0,
        )  # fmt: skip
    return n


@kernel()
def find_active(x, x_obs, kind, points, offset, gap, stiffness, parallel, shares, n_counted, bound, out):  # type: ignore[no-untyped-def]  # fmt: skip
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
    out : tuple of (capacity,), (capacity,), (capacity,), (capacity, 4), (capacity,), (capacity, 6)
        Output: numbers of pairs (one may occur several times), weight, weight on this rank, β, energy [J] for
        a weight of 1, and derivatives: g [m], b′ / d [N/m] and b″ / d² [N/m³] without mollifier, d = |g| or
        −|g|, and the mollifier.

    Returns
    -------
    n : int
        Number of active pairs; only the first ``capacity`` are written.
    """
    pairs, weights, owned_weights, out_beta, energies, derivatives = out
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
        load_points(x, x_obs, points, e, p)
        if kind[e] == VERTEX_TRIANGLE and points[e, 0] >= 0:
            if points[e, 0] != vertex or n_points > MAX_POINTS - 7:
                n = _write_points(x, x_obs, points, n_points, nearest, *constants, n, out, q)
                n_points, vertex = 0, points[e, 0]
            delta, n_points = _add_triangle(p, points, e, offset[e], gap[e], shares, n_points, nearest)
            bound[e] = delta
            continue
        bound[e] = box_distance(p, kind[e]) - offset[e]
        if bound[e] >= gap[e]:
            continue
        behind = stands_behind(kind[e], p)
        b0, b1, b2, b3 = nearest_coefficients(kind[e], p)
        d = norm(p, b0, b1, b2, b3)
        delta = bound[e] = (-d if behind else d) - offset[e]
        if delta >= gap[e]:
            continue
        owned_weight, mollifier = 1.0 if e < n_counted else 0.0, 1.0
        if kind[e] == EDGE_EDGE:
            mollifier = mollifier_of(p, parallel, slope)[0]
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
    return _write_points(x, x_obs, points, n_points, nearest, *constants, n, out, q)


@subkernel()
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
    load_points(x, x_obs, points, e, p)
    behind = stands_behind(kind[e], p)
    g[0], g[1], g[2] = between(p, beta[n, 0], beta[n, 1], beta[n, 2], beta[n, 3])
    length = math.sqrt(dot(g, g))
    return -length if behind else length


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
            load_points(x, x_obs, points, e, p)
            mollifier, mollifier_slope, _ = mollifier_of(p, parallel, sine_gradient)
            if mollifier < 1.0:
                d = norm(p, beta[m, 0], beta[m, 1], beta[m, 2], beta[m, 3])
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
def _write_mollifier_hessian(p, beta, g, delta, gap, stiffness, convexity, mollifier, gradient, h):  # type: ignore[no-untyped-def]
    """Write the part of the Hessian of the energy of two edges that is due to derivatives of the mollifier to
    h (4, 4, 3, 3).
    """
    _, dm, ddm = mollifier
    energy, exact = (1.0 - convexity) * stiffness * barrier(delta, gap)[0], (1.0 - convexity) * dm * g[3]
    for i in range(4):
        for j in range(4):
            for k in range(3):
                left, s_i = exact * beta[i] * g[k], gradient[3 * i + k]
                for n in range(3):
                    right, s_j = exact * beta[j] * g[n], gradient[3 * j + n]
                    h[i, j, k, n] = left * s_j + s_i * right + energy * ddm * s_i * s_j
    _add_sine_hessian(p, energy * dm, h)


@leaf()
def _add_sine_hessian(p, factor, h):  # type: ignore[no-untyped-def]
    """Add factor times the Hessian of sin² θ to h (4, 4, 3, 3)."""
    uu, uv, vv = edge_products(p)
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
        load_points(x, x_obs, points, pair, p)
    if free > 0 and kind[pair] == VERTEX_PLANE:
        plane_to_triangle(p)
    _free_directions(gamma, p, free, e)
    mollifier = mollifier_of(p, parallel, sine_gradient) if is_edges else (1.0, 0.0, 0.0)
    weighted = mollifier[0] * factor
    _add_pair_blocks(weighted, points[pair], g, b, slope, free, gamma, e, offsets[pair], across, blocks)
    if mollifier[0] == 1.0:
        return
    delta, of_pair = math.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2) - offset[pair], (gap[pair], stiffness[pair])
    _write_mollifier_hessian(p, b, g, delta, *of_pair, convexity, mollifier, sine_gradient, h)
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
def _normal_force(p, kind, delta, gap, stiffness, parallel, slope):  # type: ignore[no-untyped-def]
    """Normal force [N] of a pair; 0 unless 0 < δ < gap."""
    if not 0.0 < delta < gap:
        return 0.0
    force = -stiffness * barrier(delta, gap)[1]
    return force * mollifier_of(p, parallel, slope)[0] if kind == EDGE_EDGE else force


@kernel()
def find_contacts(x, x_obs, kind, points, offset, gap, stiffness, parallel, bound, active, n_counted, out):  # type: ignore[no-untyped-def]  # fmt: skip
    """Find which of the first ``n_counted`` pairs have a contact force; returns their number n.

    For vertices of sheets these are active pairs as from `find_active` (``active``: numbers, weights, β and
    derivatives), for others each pair whose ``bound`` (E,) [m] is below the gap. To the first n rows of
    ``out``, (m, 4), (m, 3), (m,), (m,), (m,), are written β, unit normals towards the first simplex, normal
    forces [N], which may be negative, distances less offset [m], and numbers of pairs.
    """
    p, g, slope, n = np.empty((4, 3)), np.empty(3), np.zeros(12), 0
    beta, normal, force, delta, numbers = out
    pairs, weight, active_beta, derivatives = active
    for m in range(len(pairs) + n_counted):
        e = pairs[m] if m < len(pairs) else m - len(pairs)
        if (
            e >= n_counted
            or bound[e] >= gap[e]
            or (m < len(pairs)) == (kind[e] == EDGE_EDGE or points[e, 0] < 0)
        ):
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
            load_points(x, x_obs, points, e, p)
            beta[n, 0], beta[n, 1], beta[n, 2], beta[n, 3] = nearest_coefficients(kind[e], p)
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
