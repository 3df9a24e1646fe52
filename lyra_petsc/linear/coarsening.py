"""Coarse triangle meshes for multigrid: a subset of the vertices, and smooth interpolation from them.

The coarse vertices are a greedy independent set, regular on a regular grid. Each fine vertex belongs to its
nearest coarse neighbour; fine triangles whose corners belong to three coarse vertices give the coarse
triangles (the dual of this Voronoi diagram on the mesh). A fine vertex is interpolated by its barycentric
coordinates in the coarse triangle that contains it. The result is then averaged, half with the mean of the
neighbours, as in a subdivision scheme: with linear interpolation alone each coarse edge is a fold, and
bending is twice too stiff on each coarser mesh. Finally small weights are dropped, as they lengthen the rows
of coarse matrices.

All functions take arrays of a whole mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import cached, inner
from lyra_petsc.linear.pattern import row_pointers
from lyra_petsc.mesh.partitioner import vertex_graph
from lyra_petsc.mesh.topology import boundary_edges

MIN_BARYCENTRIC = -0.3
"""Smallest barycentric coordinate up to which a vertex outside a triangle is extrapolated from it."""

SPARSER = 0.95
"""Ratio of the vertices of a less regular choice to those of the regular one below which it is taken."""

MIN_WEIGHT = 0.04
"""Smaller weights are dropped: irregular meshes have many of them, and without them all levels of a W cycle
have a fifth fewer blocks, while iterations hardly increase (for stiff sheets from 26 to 28). The smallest
weight on a grid of parallel diagonals, 1/24, is needed for convergence."""

EQUAL = 1e-3
"""Relative difference of squared distances below which they count as equal."""

OBLIQUE = (1.0, 0.618, 0.382)
"""A direction in which the corners of an axis-aligned square or cube have different coordinates."""


@dataclass
class CoarseMesh:
    """A coarse mesh and the interpolation from it, in compressed rows.

    Attributes
    ----------
    vertices : (C,) int64
        Fine vertices that are coarse vertices.
    triangles : (G, 3) int64
        Coarse triangles, as indices into ``vertices``.
    start : (N + 1,) int64
        Row pointers of the fine vertices.
    parents : (P,) int64
        Coarse vertices from which a fine vertex is interpolated.
    weights : (P,) float64
        Their sum is one for each fine vertex.
    """

    vertices: Ints
    triangles: Ints
    start: Ints
    parents: Ints
    weights: Array


def coarsen(x: Array, triangles: Ints) -> CoarseMesh:
    """Coarse mesh of vertices x (N, 3) [m] and triangles (F, 3)."""
    n = len(x)
    start, neighbours = vertex_graph([triangles], n)
    border = _border_level(n, triangles)
    vertices = np.flatnonzero(_choose_coarse(start, neighbours, border))
    label = np.full(n, -1, dtype=np.int64)  # number among the coarse vertices
    label[vertices] = np.arange(len(vertices))
    owner = _nearest_coarse(x, start, neighbours, label)
    coarse = owner[triangles] if len(triangles) else np.zeros((0, 3), dtype=np.int64)
    a, b, c = coarse.T
    coarse = coarse[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(coarse, axis=1), axis=0, return_index=True)
    coarse = coarse[np.sort(first)]
    first, incident = _incident_triangles(len(vertices), coarse)
    parents, weights = np.full((n, 3), -1, dtype=np.int64), np.zeros((n, 3))
    _interpolate(x, start, neighbours, label, owner, vertices, coarse, first, incident, parents, weights)
    along = vertex_graph([boundary_edges(triangles).edges], n)
    return CoarseMesh(vertices, coarse, *_smooth(*along, start, neighbours, border, parents, weights))


def _border_level(n: int, triangles: Ints) -> NDArray[np.int8]:
    """2 for corners (vertices of at most one triangle), 1 for other border vertices, 0 for interior ones."""
    border = np.zeros(n, dtype=np.int8)
    border[boundary_edges(triangles).edges] = 1
    border[np.bincount(triangles.ravel(), minlength=n) < 2] = 2
    return border


def _incident_triangles(n: int, triangles: Ints) -> tuple[Ints, Ints]:
    """Compressed rows of the triangles at each of n vertices."""
    order = np.argsort(triangles.ravel(), kind="stable")
    return row_pointers(np.bincount(triangles.ravel(), minlength=n)), order // 3


def _choose_coarse(start: Ints, neighbours: Ints, border: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Mask (N,) of the coarse vertices: the regular choice, or the sparsest if it has clearly fewer vertices.

    Started from a corner without a diagonal, the regular choice keeps half of a grid of alternating
    diagonals. On irregular meshes choosing vertices with most undecided neighbours first keeps fewest.
    """
    corners, degrees = (np.argsort(-key, kind="stable") for key in (border, np.diff(start)))
    orders = (corners, False), (degrees, False), (corners, True)
    regular, *others = (_independent(start, neighbours, border, *order) for order in orders)
    sparse = min(others, key=np.count_nonzero)
    chosen: NDArray[np.bool_] = sparse if sparse.sum() < SPARSER * regular.sum() else regular
    return chosen


@inner()
def _decide_from(start, neighbours, seed, only, border, greedy, state, layer, ordered, degree):  # type: ignore[no-untyped-def]
    """Decide on the vertices with border ≥ only that are reachable from seed, breadth first.

    Within a layer, vertices with most neighbours come first: on a grid of alternating diagonals those with
    eight are a quarter of the vertices, those with four half of them. If ``greedy``, only neighbours that are
    not decided yet count.
    """
    layer[0] = seed
    n = 1
    state[seed] |= 4
    while n > 0:
        for i in range(n):
            v = layer[i]
            degree[v] = start[v + 1] - start[v]
            if greedy:
                for k in range(start[v], start[v + 1]):
                    degree[v] -= state[neighbours[k]] & 3 > 0
        _sort_descending(layer[:n], degree, ordered)
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


@inner()
def _sort_descending(vertices, key, ordered):  # type: ignore[no-untyped-def]
    """ordered = vertices by descending key (N,), stable (counting sort)."""
    largest = 0
    for v in vertices:
        largest = max(largest, key[v])
    at = np.zeros(largest + 2, np.int64)
    for v in vertices:
        at[largest - key[v] + 1] += 1
    for i in range(largest + 1):
        at[i + 1] += at[i]
    for v in vertices:
        i = largest - key[v]
        ordered[at[i]] = v
        at[i] += 1


@cached()
def _independent(start, neighbours, border, seeds, greedy):  # type: ignore[no-untyped-def]
    """Mask of a maximal independent set of vertices; corners are decided first, then other border vertices.

    ``seeds`` (N,) is the order in which vertices are tried as seeds; ``greedy`` as for `_decide_from`.
    """
    n = len(border)
    state = np.zeros(n, np.uint8)  # bits: 1 coarse, 2 not coarse, 4 visited
    layer, ordered, degree = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    for only in (2, 1, 0):
        for v in range(n):
            state[v] &= 3
        for v in seeds:
            if border[v] >= only and state[v] & 4 == 0:
                _decide_from(start, neighbours, v, only, border, greedy, state, layer, ordered, degree)
    return (state & 1) > 0


@cached()
def _nearest_coarse(x, start, neighbours, label):  # type: ignore[no-untyped-def]
    """Label (N,) of each vertex' nearest coarse neighbour; of a coarse vertex its own.

    Of equally near ones the farthest along an oblique direction, so that all squares of coarse vertices get
    the same diagonal and the coarse mesh of a regular grid is regular.
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
                    if d < (1.0 - EQUAL) * best or (d < (1.0 + EQUAL) * best and back < farthest):
                        best, farthest, owner[v] = d, back, label[w]
    return owner


@inner()
def _dot(u, v):  # type: ignore[no-untyped-def]
    """Dot product of 3-vectors; numpy's needs SciPy in numba, which need not be installed."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@inner()
def _barycentric(p, a, b, c):  # type: ignore[no-untyped-def]
    """Barycentric coordinates of p, projected onto the triangle's plane; −∞ for a triangle without area."""
    u, v, w = b - a, c - a, p - a
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    det = uu * vv - uv * uv
    if not det > 1e-12 * uu * vv:
        return -np.inf, -np.inf, -np.inf
    uw, vw = _dot(u, w), _dot(v, w)
    s, t = (vv * uw - uv * vw) / det, (uu * vw - uv * uw) / det
    return 1.0 - s - t, s, t


@cached()
def _interpolate(x, start, neighbours, label, owner, vertices, triangles, first, incident, parents, weights):  # type: ignore[no-untyped-def]  # fmt: skip
    """Up to three parents and weights (N, 3) of each vertex, from the best of the coarse triangles nearby."""
    for v in range(len(label)):
        if label[v] >= 0:
            parents[v, 0], weights[v, 0] = label[v], 1.0
            continue
        best = MIN_BARYCENTRIC
        for k in range(start[v], start[v + 1]):
            near = label[neighbours[k]]
            if near < 0:
                continue
            for m in range(first[near], first[near + 1]):
                t = triangles[incident[m]]
                q = _barycentric(x[v], x[vertices[t[0]]], x[vertices[t[1]]], x[vertices[t[2]]])
                smallest = min(q[0], min(q[1], q[2]))
                if smallest > best:
                    best = smallest
                    for i in range(3):
                        parents[v, i], weights[v, i] = t[i], q[i]
                        if abs(q[i]) < 1e-3:
                            parents[v, i], weights[v, i] = -1, 0.0
        if best == MIN_BARYCENTRIC:
            parents[v, 0], weights[v, 0] = owner[v], 1.0
            _interpolate_on_line(x, start, neighbours, label, vertices, v, parents, weights)
        total = weights[v, 0] + weights[v, 1] + weights[v, 2]
        for i in range(3):
            weights[v, i] /= total


@inner()
def _interpolate_on_line(x, start, neighbours, label, vertices, v, parents, weights):  # type: ignore[no-untyped-def]
    """Interpolate vertex v linearly between two coarse neighbours, if it lies well between two of them."""
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


@inner()
def _drop_small(parents, weights, lo, hi):  # type: ignore[no-untyped-def]
    """Drop small weights among lo..hi, and rescale the others to the same sum; returns their new end."""
    before = after = 0.0
    end = lo
    for p in range(lo, hi):
        before += weights[p]
        if abs(weights[p]) >= MIN_WEIGHT:
            parents[end], weights[end] = parents[p], weights[p]
            after += weights[p]
            end += 1
    for p in range(lo, end):
        weights[p] *= before / after
    return end


@cached()
def _smooth(along_start, along_ends, start, neighbours, border, parents, weights):  # type: ignore[no-untyped-def]  # fmt: skip
    """Compressed rows of (parents, weights) (N, 3), each averaged with the mean of its neighbours.

    Border vertices only use neighbours along the border, as the sheet would shrink otherwise; corners stay.
    """
    n = len(border)
    first = np.zeros(n + 1, np.int64)
    seen, at = np.full(n, -1, np.int64), np.zeros(n, np.int64)
    out = np.empty(4 * n + 16, np.int64)
    share = np.empty(len(out))
    q = np.int64(0)  # a literal 0 has another type, for which functions would be compiled again
    for v in range(n):
        around, begin = neighbours, start
        if border[v] > 0:
            around, begin = along_ends, along_start
        degree = 0 if border[v] > 1 else begin[v + 1] - begin[v]
        needed = 3 * (degree + 1)
        if q + needed > len(out):
            larger_out, larger_share = (
                np.empty(2 * len(out) + needed, np.int64),
                np.empty(2 * len(out) + needed),
            )
            for i in range(q):  # assignments of slices would take seconds to compile
                larger_out[i], larger_share[i] = out[i], share[i]
            out, share = larger_out, larger_share
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
        q = _drop_small(out, share, first[v], q)
        first[v + 1] = q
    return first, out[:q].copy(), share[:q].copy()
