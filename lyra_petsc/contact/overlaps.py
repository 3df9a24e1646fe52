"""Overlaps of sheets with obstacles.

An overlap is a vertex, edge or triangle of a sheet that is in an obstacle deeper than rounding (`ROUNDING`
times the largest coordinate); to touch an obstacle is no overlap. Triangle meshes as obstacles, closed or
open, are overlapped by triangles that cross them only (`mutual_crossings`). Contact is not involved.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.contact.crossings import mutual_crossings
from lyra_petsc.kernels.cache import cached, inner
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.mesh.symmetry import Wall
from lyra_petsc.mesh.topology import unique_edges

ROUNDING = 1e-14
"""Depth that may be rounding, over the largest coordinate or radius: about fifty units in the last place."""


class Overlaps(NamedTuple):
    """Vertices, edges and triangles of a sheet that are in an obstacle, wholly or in part.

    Attributes
    ----------
    vertices : (n,) int64
        Indices, ascending.
    edges : (m, 2) int64
        Vertices of the edges, as in `topology.unique_edges`.
    triangles : (k,) int64
        Indices, ascending.
    """

    vertices: Ints
    edges: Ints
    triangles: Ints


def behind_planes(points: Array, triangles: Ints, on_planes: Array, normals: Array) -> Overlaps:
    """Parts of a sheet behind planes, or outside of a box that shall contain it.

    Parameters
    ----------
    points : (V, 3) float64
        Positions of the sheet [m].
    triangles : (F, 3) int64
    on_planes, normals : (n, 3) float64
        A point on each plane [m], and the unit normal towards the free side.
    """
    depth = _rounding(points, on_planes)
    out = np.zeros(len(points), dtype=bool)
    for point, normal in zip(on_planes, normals, strict=True):
        out |= (points - point) @ normal < -depth
    return _with_vertices(out, triangles)


def behind_wall(points: Array, triangles: Ints, wall: Wall) -> Overlaps:
    """Parts of sheets, with positions (V, 3) [m], behind the symmetry plane in which their images begin."""
    out = np.zeros(len(points), dtype=bool)
    out[wall.passed(points)] = True
    return _with_vertices(out, triangles)


def outside_ball(points: Array, triangles: Ints, axis: Array, radius: float) -> Overlaps:
    """Parts of a sheet outside of a sphere or capsule that shall contain it.

    Parameters
    ----------
    points : (V, 3) float64
        Positions of the sheet [m].
    triangles : (F, 3) int64
    axis : (1, 3) or (2, 3) float64
        The centre, or the ends of the axis [m].
    radius : float
        [m].
    """
    distances = _distances(points, _vertices(points), axis[0], axis[-1])
    return _with_vertices(distances > radius + _rounding(points, axis, radius), triangles)


def inside_ball(points: Array, triangles: Ints, axis: Array, radius: float) -> Overlaps:
    """Parts of a sheet inside a sphere or capsule; parameters as of `outside_ball`."""
    bound = radius - _rounding(points, axis, radius)
    low, high = axis.min(axis=0) - radius, axis.max(axis=0) + radius

    def overlap(corners: Ints) -> Mask:
        inside = _boxes_overlap(points, corners, low, high)
        inside[inside] = _distances(points, corners[inside], axis[0], axis[-1]) < bound
        return inside

    return _select(overlap, points, triangles)


def inside_box(points: Array, triangles: Ints, corners: Array) -> Overlaps:
    """Parts of a sheet inside a box of any orientation, by the separating axis theorem.

    Source: Gottschalk, Lin & Manocha, OBBTree, SIGGRAPH 1996.

    Parameters
    ----------
    points : (V, 3) float64
        Positions of the sheet [m].
    triangles : (F, 3) int64
    corners : (8, 3) float64
        Corners of the box [m]; i, j, k ∈ {0, 1} of corner i + 2 j + 4 k are its coordinates along the edges.
    """
    edges = corners[[1, 2, 4]] - corners[0]
    lengths = np.linalg.norm(edges, axis=1)
    local = (points - corners.mean(axis=0)) @ (edges / lengths[:, None]).T
    half = 0.5 * lengths - _rounding(points, corners)

    def overlap(corners: Ints) -> Mask:
        inside = _boxes_overlap(local, corners, -half, half)
        shapes = local[corners[inside]]
        sides = np.roll(shapes, -1, axis=1) - shapes
        axes = [np.cross(sides[:, 0], sides[:, 1])]
        axes += [np.cross(edge, sides[:, k]) for edge, k in itertools.product(np.eye(3), range(3))]
        overlaps = np.ones(len(shapes), dtype=bool)
        for axis in axes:
            projected = np.einsum("nkx,nx->nk", shapes, axis)
            extent = np.abs(axis) @ half
            separated = (projected.min(axis=1) >= extent) | (projected.max(axis=1) <= -extent)
            # an axis is zero for a side parallel to an edge, and for a triangle without area
            overlaps &= ~(separated & axis.any(axis=1))
        inside[inside] = overlaps
        return inside

    return _select(overlap, points, triangles)


def _rounding(points: Array, obstacle: Array, radius: float = 0.0) -> float:
    """Depth [m] that may be rounding, by the largest coordinate of sheet and obstacle."""
    largest = max(float(np.abs(points).max(initial=0.0)), float(np.abs(obstacle).max()), radius)
    return ROUNDING * largest


def _vertices(points: Array) -> Ints:
    """The vertices as triangles (V, 3) whose corners coincide."""
    return np.repeat(np.arange(len(points))[:, None], 3, axis=1)


def _boxes_overlap(points: Array, corners: Ints, low: Array, high: Array) -> Mask:
    """Whether the bounding box of each triangle (n,) overlaps the box from ``low`` to ``high``."""
    x = points[corners]
    return np.asarray(((x.min(axis=1) < high) & (x.max(axis=1) > low)).all(axis=1))


def _with_vertices(out: Mask, triangles: Ints) -> Overlaps:
    """All parts of a sheet with a vertex that is ``out`` (V,) of a convex region."""
    edges = unique_edges(triangles)
    return Overlaps(
        np.flatnonzero(out), edges[out[edges].any(axis=1)], np.flatnonzero(out[triangles].any(axis=1))
    )


def _select(overlap: Callable[[Ints], Mask], points: Array, triangles: Ints) -> Overlaps:
    """Parts of a sheet for which ``overlap`` of triangles (n, 3) is true; vertices and edges have no area."""
    edges = unique_edges(triangles)
    return Overlaps(
        np.flatnonzero(overlap(_vertices(points))),
        edges[overlap(edges[:, [0, 1, 1]])],
        np.flatnonzero(overlap(triangles)),
    )


@cached()
def _distances(points: Any, triangles: Any, start: Any, end: Any) -> Any:
    """Distances (n,) of triangles, which may be degenerate to segments or points, from a segment or point.

    Each is computed from two points, one of either, and so is too small by no more than rounding.
    """
    distances = np.empty(len(triangles))
    along = end - start
    for i in range(len(triangles)):
        a, b, c = points[triangles[i, 0]], points[triangles[i, 1]], points[triangles[i, 2]]
        d = min(
            _segment_distance(a, b, start, end),
            _segment_distance(b, c, start, end),
            _segment_distance(c, a, start, end),
        )
        normal = _cross(b - a, c - a)
        area = _dot(normal, normal)
        if area > 0.0:
            d = min(d, _face_distance(a, b, c, normal, start), _face_distance(a, b, c, normal, end))
            slope = _dot(along, normal)
            s = _dot(a - start, normal) / slope if slope != 0.0 else -1.0
            if 0.0 < s < 1.0:
                d = min(d, _face_distance(a, b, c, normal, start + s * along))
        distances[i] = d
    return distances


@inner()
def _face_distance(a: Any, b: Any, c: Any, normal: Any, point: Any) -> float:
    """Distance of a point from its projection onto a triangle; inf if the projection is outside of it."""
    x = _dot(_cross(b - point, c - point), normal)
    y = _dot(_cross(c - point, a - point), normal)
    z = _dot(_cross(a - point, b - point), normal)
    total = x + y + z
    if not (x >= 0.0 and y >= 0.0 and z >= 0.0 and total > 0.0):
        return np.inf
    gap = (x / total) * (a - point) + (y / total) * (b - point) + (z / total) * (c - point)
    return float(np.sqrt(_dot(gap, gap)))


@inner()
def _segment_distance(a: Any, b: Any, c: Any, d: Any) -> float:
    """Distance of two segments (Ericson, Real-Time Collision Detection, 2005, section 5.1.9)."""
    first, second, offset = b - a, d - c, a - c
    aa, bb, ab = _dot(first, first), _dot(second, second), _dot(first, second)
    ao, bo = _dot(first, offset), _dot(second, offset)
    area = aa * bb - ab * ab
    s = min(max((ab * bo - ao * bb) / area, 0.0), 1.0) if area > 0.0 else 0.0
    t = min(max((ab * s + bo) / bb, 0.0), 1.0) if bb > 0.0 else 0.0
    s = min(max((ab * t - ao) / aa, 0.0), 1.0) if aa > 0.0 else 0.0
    gap = offset + s * first - t * second
    return float(np.sqrt(_dot(gap, gap)))


@inner()
def _cross(a: Any, b: Any) -> Any:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@inner()
def _dot(a: Any, b: Any) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def find_overlaps(
    obstacle: Solid | Container, positions: Array, triangles: Ints, time: float, *, is_box: bool
) -> Overlaps:
    """Overlaps of a sheet at ``positions`` (V, 3) [m] with an obstacle at a time [s].

    ``is_box``: a solid without radius is a box; else it is a mesh, for which only triangles that cross it
    are found.
    """
    sheet, points = (positions, triangles), obstacle.positions(time)
    if isinstance(obstacle, Container):
        if obstacle.kind == "planes":
            return behind_planes(*sheet, points, obstacle.normals_at(time))
        return outside_ball(*sheet, points, obstacle.radius)
    if obstacle.radius > 0.0:
        return inside_ball(*sheet, points, obstacle.radius)
    if is_box:
        return inside_box(*sheet, points)
    crossed = mutual_crossings(*sheet, points, obstacle.triangles)[:, 0]
    return Overlaps(np.empty(0, np.int64), np.empty((0, 2), np.int64), np.unique(crossed))
