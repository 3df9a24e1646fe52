"""Coarser triangle meshes for multigrid: a part of the vertices, and smooth interpolation from them.

A greedy independent set of the vertices stays, on a grid one that is as regular. Every other vertex belongs
to the nearest of its neighbours that stay; triangles whose corners belong to three of them make the coarse
triangles (the dual of that Voronoi diagram on the mesh). A vertex that goes is interpolated by its
barycentric coordinates in the coarse triangle that contains it. Each vertex is then moved halfway to the mean
of its neighbours, as by a subdivision scheme: of linear interpolation alone every coarse edge makes a fold,
whose bending is twice too stiff on each coarser mesh. Small weights are then left out: they make rows of
coarse matrices long.

Functions of arrays, of a whole mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import cached
from lyra_petsc.mesh.partitioner import vertex_graph
from lyra_petsc.mesh.topology import boundary_edges

OUTSIDE = -0.3
"""Smallest barycentric coordinate with which a linear function is continued beyond its triangle."""

FEWER = 0.95
"""Fraction of the vertices for which a less regular choice is taken."""

LEAST_WEIGHT = 0.04
"""Weights below it are left out: on irregular meshes there are many, and without them all levels of a W cycle
have a fifth fewer blocks to read, while iterations hardly grow (of stiff sheets from 26 to 28). The least on
a grid of parallel diagonals, where iterations need it, is 1/24."""

ALIKE = 1e-3
"""Relative difference of squared distances below which they count as equal."""

OBLIQUE = (1.0, 0.618, 0.382)
"""A direction in which no two corners of a square or a cube are equally far, however it lies on the axes."""


@dataclass
class Coarse:
    """A coarse mesh and the interpolation from it, in compressed rows.

    Attributes
    ----------
    vertices : (C,) int64
        The fine vertices that stay.
    triangles : (G, 3) int64
        Into ``vertices``.
    start : (N + 1,) int64
        Where each fine vertex' parents begin.
    parents : (P,) int64
        Coarse vertices that it is interpolated from.
    weights : (P,) float64
        They add up to one for each vertex.
    """

    vertices: Ints
    triangles: Ints
    start: Ints
    parents: Ints
    weights: Array


def coarsen(x: Array, triangles: Ints) -> Coarse:
    """Coarse mesh of vertices x (N, 3) [m] and triangles (F, 3)."""
    n = len(x)
    start, neighbours = vertex_graph([triangles], n)
    border = _borders(n, triangles)
    stays = _fewest(start, neighbours, border)
    vertices = np.flatnonzero(stays)
    label = np.full(n, -1, dtype=np.int64)
    label[vertices] = np.arange(len(vertices))
    owner = _nearest(x, start, neighbours, label)
    coarse = owner[triangles] if len(triangles) else np.zeros((0, 3), dtype=np.int64)
    a, b, c = coarse.T
    coarse = coarse[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(coarse, axis=1), axis=0, return_index=True)
    coarse = coarse[np.sort(first)]
    at, around = _around(len(vertices), coarse)
    parents, weights = np.full((n, 3), -1, dtype=np.int64), np.zeros((n, 3))
    _interpolate(x, start, neighbours, label, owner, vertices, coarse, at, around, parents, weights)
    along = vertex_graph([boundary_edges(triangles).edges], n)
    return Coarse(vertices, coarse, *_smoothed(*along, start, neighbours, border, parents, weights))


def _borders(n: int, triangles: Ints) -> NDArray[np.int8]:
    """2 for corners of the border (ends of no or of one triangle), 1 for other border vertices, else 0."""
    border = np.zeros(n, dtype=np.int8)
    border[boundary_edges(triangles).edges] = 1
    border[np.bincount(triangles.ravel(), minlength=n) < 2] = 2
    return border


def _around(n: int, triangles: Ints) -> tuple[Ints, Ints]:
    """Compressed rows of the triangles at each vertex."""
    order = np.argsort(triangles.ravel(), kind="stable")
    start = np.zeros(n + 1, dtype=np.int64)
    np.cumsum(np.bincount(triangles.ravel(), minlength=n), out=start[1:])
    return start, order // 3


def _fewest(start: Ints, neighbours: Ints, border: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Which vertices (N,) stay: as on a regular grid, or where that leaves many in another order.

    From a corner that no diagonal meets half of a grid of alternating diagonals would stay. On irregular
    meshes fewest stay where those come first that most others can go beside.
    """
    corners, degrees = (np.argsort(-key, kind="stable") for key in (border, np.diff(start)))
    orders = (corners, False), (degrees, False), (corners, True)
    regular, *others = (_independent(start, neighbours, border, *order) for order in orders)
    sparse = min(others, key=np.count_nonzero)
    chosen: NDArray[np.bool_] = sparse if sparse.sum() < FEWER * regular.sum() else regular
    return chosen


@cached()
def _spread(start, neighbours, seed, only, border, greedy, state, layer, ordered, most):  # type: ignore[no-untyped-def]
    """Decide the vertices reachable from seed, nearest first; those with border ≥ only.

    Of equally near ones those with most neighbours come first: on a grid of alternating diagonals they are
    every fourth vertex and have two kinds of neighbours, while those with four are half of the vertices.
    If ``greedy``, only those neighbours count that are not decided yet.
    """
    layer[0] = seed
    n = 1
    state[seed] |= 4
    while n > 0:
        for i in range(n):
            v = layer[i]
            most[v] = start[v + 1] - start[v]
            if greedy:
                for k in range(start[v], start[v + 1]):
                    most[v] -= state[neighbours[k]] & 3 > 0
        _by_size(layer[:n], most, ordered)
        m = 0
        for i in range(n):
            v = ordered[i]
            if state[v] & 3 == 0:
                state[v] |= 1
                for k in range(start[v], start[v + 1]):
                    if state[neighbours[k]] & 3 == 0:
                        state[neighbours[k]] |= 2
        for i in range(n):
            v = ordered[i]
            for k in range(start[v], start[v + 1]):
                w = neighbours[k]
                if state[w] & 4 == 0 and border[w] >= only:
                    state[w] |= 4
                    layer[m] = w
                    m += 1
        n = m


@cached()
def _by_size(vertices, size, ordered):  # type: ignore[no-untyped-def]
    """Put the vertices into ``ordered``, those of the largest size (N,) first, others as they stand."""
    most = 0
    for v in vertices:
        most = max(most, size[v])
    at = np.zeros(most + 2, np.int64)
    for v in vertices:
        at[most - size[v] + 1] += 1
    for i in range(most + 1):
        at[i + 1] += at[i]
    for v in vertices:
        i = most - size[v]
        ordered[at[i]] = v
        at[i] += 1


@cached()
def _independent(start, neighbours, border, seeds, greedy):  # type: ignore[no-untyped-def]
    """Which vertices stay: no two neighbours, and all others beside one. Corners first, then borders.

    ``seeds`` (N,) is the order in which vertices are begun with; ``greedy`` as for `_spread`.
    """
    n = len(border)
    state = np.zeros(n, np.uint8)  # 1 stays, 2 goes, 4 was looked at
    layer, ordered, most = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    for only in (2, 1, 0):
        for v in range(n):
            state[v] &= 3
        for v in seeds:
            if border[v] >= only and state[v] & 4 == 0:
                _spread(start, neighbours, v, only, border, greedy, state, layer, ordered, most)
    return (state & 1) > 0


@cached()
def _nearest(x, start, neighbours, label):  # type: ignore[no-untyped-def]
    """Label of the nearest neighbour that stays; its own for those that stay.

    Of equally near ones the farthest along an oblique direction: so squares that have their corners in the
    coarse mesh are all cut alike, and it is as regular as this one.
    """
    owner = label.copy()
    for v in range(len(label)):
        if label[v] < 0:
            best = farthest = np.inf
            for k in range(start[v], start[v + 1]):
                w = neighbours[k]
                if label[w] >= 0:
                    d = (x[v, 0] - x[w, 0]) ** 2 + (x[v, 1] - x[w, 1]) ** 2 + (x[v, 2] - x[w, 2]) ** 2
                    back = -(OBLIQUE[0] * x[w, 0] + OBLIQUE[1] * x[w, 1] + OBLIQUE[2] * x[w, 2])
                    if d < (1.0 - ALIKE) * best or (d < (1.0 + ALIKE) * best and back < farthest):
                        best, farthest, owner[v] = d, back, label[w]
    return owner


@cached()
def _dot(u, v):  # type: ignore[no-untyped-def]
    """Of vectors of three; numpy's would call the BLAS through SciPy, which need not be there."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@cached()
def _barycentric(p, a, b, c):  # type: ignore[no-untyped-def]
    """Coordinates of p in the plane of the triangle; −∞ where it has no area."""
    u, v, w = b - a, c - a, p - a
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    det = uu * vv - uv * uv
    if not det > 1e-12 * uu * vv:
        return -np.inf, -np.inf, -np.inf
    uw, vw = _dot(u, w), _dot(v, w)
    s, t = (vv * uw - uv * vw) / det, (uu * vw - uv * uw) / det
    return 1.0 - s - t, s, t


@cached()
def _interpolate(x, start, neighbours, label, owner, vertices, triangles, at, around, parents, weights):  # type: ignore[no-untyped-def]  # fmt: skip
    for v in range(len(label)):
        if label[v] >= 0:
            parents[v, 0], weights[v, 0] = label[v], 1.0
            continue
        best = OUTSIDE
        for k in range(start[v], start[v + 1]):
            near = label[neighbours[k]]
            if near < 0:
                continue
            for m in range(at[near], at[near + 1]):
                t = triangles[around[m]]
                q = _barycentric(x[v], x[vertices[t[0]]], x[vertices[t[1]]], x[vertices[t[2]]])
                least = min(q[0], min(q[1], q[2]))
                if least > best:
                    best = least
                    for i in range(3):
                        parents[v, i], weights[v, i] = t[i], q[i]
                        if abs(q[i]) < 1e-3:
                            parents[v, i], weights[v, i] = -1, 0.0
        if best == OUTSIDE:
            parents[v, 0], weights[v, 0] = owner[v], 1.0
            _between(x, start, neighbours, label, vertices, v, parents, weights)
        total = weights[v, 0] + weights[v, 1] + weights[v, 2]
        for i in range(3):
            weights[v, i] /= total


@cached()
def _between(x, start, neighbours, label, vertices, v, parents, weights):  # type: ignore[no-untyped-def]
    """Where there is no triangle: on the line between two neighbours that stay, if v is near one."""
    best = 0.25
    for k in range(start[v], start[v + 1]):
        for m in range(start[v], k):
            i, j = label[neighbours[k]], label[neighbours[m]]
            if i < 0 or j < 0:
                continue
            a, u = x[vertices[i]], x[vertices[j]] - x[vertices[i]]
            s = _dot(x[v] - a, u) / max(_dot(u, u), 1e-300)
            if min(s, 1.0 - s) > best:
                best = min(s, 1.0 - s)
                parents[v, 0], parents[v, 1], parents[v, 2] = i, j, -1
                weights[v, 0], weights[v, 1], weights[v, 2] = 1.0 - s, s, 0.0


@cached()
def _without_small(parents, weights, lo, hi):  # type: ignore[no-untyped-def]
    """Leave out the small ones of the weights lo..hi, whose sum stays; where they then end."""
    before = after = 0.0
    end = lo
    for p in range(lo, hi):
        before += weights[p]
        if abs(weights[p]) >= LEAST_WEIGHT:
            parents[end], weights[end] = parents[p], weights[p]
            after += weights[p]
            end += 1
    for p in range(lo, end):
        weights[p] *= before / after
    return end


@cached()
def _smoothed(along_start, along_ends, start, neighbours, border, parents, weights):  # type: ignore[no-untyped-def]  # fmt: skip
    """Compressed rows of (parents, weights) (N, 3), each halfway to its neighbours' mean.

    Vertices of the border look along the border only, or the sheet would shrink, and corners stay.
    """
    n = len(border)
    first = np.zeros(n + 1, np.int64)
    seen, at = np.full(n, -1, np.int64), np.zeros(n, np.int64)
    out = np.empty(4 * n + 16, np.int64)
    share = np.empty(len(out))
    q = np.int64(0)  # 0 has a type of its own, for which what takes it is compiled once more
    for v in range(n):
        around, begin = neighbours, start
        if border[v] > 0:
            around, begin = along_ends, along_start
        degree = 0 if border[v] > 1 else begin[v + 1] - begin[v]
        most = 3 * (degree + 1)
        if q + most > len(out):
            bigger, more = np.empty(2 * len(out) + most, np.int64), np.empty(2 * len(out) + most)
            for i in range(q):  # arrays as a whole would take seconds to compile
                bigger[i], more[i] = out[i], share[i]
            out, share = bigger, more
        for k in range(-1, degree):
            w = v if k < 0 else around[begin[v] + k]
            part = 1.0 if degree == 0 else (0.5 if k < 0 else 0.5 / degree)
            for i in range(3):
                p = parents[w, i]
                if p < 0:
                    continue
                if seen[p] != v:
                    seen[p], at[p] = v, q
                    out[q], share[q] = p, 0.0
                    q += 1
                share[at[p]] += part * weights[w, i]
        q = _without_small(out, share, first[v], q)
        first[v + 1] = q
    return first, out[:q].copy(), share[:q].copy()
