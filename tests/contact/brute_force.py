"""Crossings of triangles and depths of overlaps, by comparing everything with everything."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lyra_petsc.arrays import Array, Ints


def pierced(points: Array, triangles: Ints, others: Array, other_triangles: Ints, *, same: bool) -> Ints:
    """Edges of the first surface that pass through the inside of triangles of the other one: two vertices and
    a triangle (n, 3).

    With ``same``, points of both surfaces are the same, and edges with a corner of the triangle are left out.
    Edges in the plane of a triangle, but for rounding, do not pass through it.
    """
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges = np.unique(np.sort(sides, axis=1), axis=0)
    ends, corners = points[edges], others[other_triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    rows = []
    for begin in range(0, len(edges), 256):
        part = ends[begin : begin + 256]
        near = np.ones((len(part), len(corners)), dtype=bool)
        for axis in range(3):
            near &= part[:, :, axis].min(axis=1)[:, None] <= high[:, axis]
            near &= part[:, :, axis].max(axis=1)[:, None] >= low[:, axis]
        rows.append(np.argwhere(near) + [begin, 0])
    e, t = np.concatenate(rows).T
    if same:
        apart = (edges[e][:, :, None] != other_triangles[t][:, None, :]).all(axis=(1, 2))
        e, t = e[apart], t[apart]
    start, along = ends[e, 0], ends[e, 1] - ends[e, 0]
    a, u, v = corners[t, 0], corners[t, 1] - corners[t, 0], corners[t, 2] - corners[t, 0]
    # start + s along = a + p u + q v, by Cramer's rule
    normal = np.cross(u, v)
    slope = np.einsum("ni,ni->n", along, normal)
    steep = np.abs(slope) > 1e-9 * np.linalg.norm(along, axis=1) * np.linalg.norm(normal, axis=1)
    e, t, start, along, a, u, v, normal, slope = (
        array[steep] for array in (e, t, start, along, a, u, v, normal, slope)
    )
    s = np.einsum("ni,ni->n", a - start, normal) / slope
    p = np.einsum("ni,ni->n", np.cross(along, start - a), v) / slope
    q = np.einsum("ni,ni->n", np.cross(start - a, along), u) / slope
    # at their ends, edges only touch
    through = (s > 0.0) & (s < 1.0) & (p > 0.0) & (q > 0.0) & (p + q < 1.0)
    return np.column_stack([edges[e[through]], t[through]])


def n_crossings(points: Array, triangles: Ints) -> int:
    """Number of edges that pass through triangles of the same surface."""
    return len(pierced(points, triangles, points, triangles, same=True))


def depth_of_overlap(layers: Sequence[tuple[Array, Ints]]) -> float:
    """The largest height [m] along z by which vertices of two layers are on the wrong side of each other,
    which is that of fewer vertices.
    """
    depth = 0.0
    for number, (x, triangles) in enumerate(layers):
        for lower, lower_triangles in layers[:number]:
            above, below = heights_above(x, lower, lower_triangles), heights_above(lower, x, triangles)
            heights = np.concatenate([above, -below])
            right = 1.0 if np.count_nonzero(heights > 0.0) >= np.count_nonzero(heights < 0.0) else -1.0
            depth = max(depth, float(np.nanmax(-right * heights, initial=0.0)))
    return depth


def heights_above(points: Array, x: Array, triangles: Ints) -> Array:
    """Height [m] of points (n, 3) along z above a surface; NaN beside it."""
    a, b, c = (x[triangles[:, k]] for k in range(3))
    area = np.cross((b - a)[:, :2], (c - a)[:, :2])
    offset = points[:, None, :2] - a[:, :2]
    p = np.cross(offset, (c - a)[:, :2]) / area
    q = np.cross((b - a)[:, :2], offset) / area
    inside = (p >= 0.0) & (q >= 0.0) & (p + q <= 1.0)
    z = a[:, 2] + p * (b - a)[:, 2] + q * (c - a)[:, 2]
    heights = np.where(inside, points[:, 2, None] - z, np.nan)
    return np.where(inside.any(axis=1), heights[np.arange(len(points)), inside.argmax(axis=1)], np.nan)


def ray_lengths(start: Array, directions: Array, x: Array, triangles: Ints) -> Array:
    """Distances [m] along unit ``directions`` (n, 3) from one point to the first triangle."""
    a, b, c = (x[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    height, slope = np.einsum("ni,ni->n", a - start, normal), directions @ normal.T
    length = np.divide(height, slope, out=np.full(slope.shape, -1.0), where=slope != 0.0)
    hits = start + length[:, :, None] * directions[:, None, :]
    inside = length > 0.0
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("dni,ni->dn", np.cross(q - p, hits - p), normal) >= 0.0
    return np.where(inside, length, np.inf).min(axis=1)
