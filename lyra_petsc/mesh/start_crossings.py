"""What of a sheet is in an obstacle, and start positions that contact cannot begin with.

Overlaps are geometry alone, independent of contact: vertices, edges and triangles of a sheet that are in an
obstacle deeper than rounding counts (`ROUNDING` of the largest coordinate); what touches is not. Of obstacles
that are triangle meshes, closed or open, only crossing them is overlap: `mutual_crossings`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.errors import InputError
from lyra_petsc.kernels.cache import cached
from lyra_petsc.mesh.crossings import mutual_crossings, self_crossings
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.mesh.topology import unique_edges
from lyra_petsc.scene.schema import Scene

ROUNDING = 1e-14
"""Depth that may be rounding, over the largest coordinate and radius: some fifty units in the last place."""


class Overlaps(NamedTuple):
    """What is in an obstacle, wholly or in part.

    Attributes
    ----------
    vertices : (n,) int64
        Rows of the sheet's points, ascending.
    edges : (m, 2) int64
        Vertices of the edges, as `topology.unique_edges` has them.
    triangles : (k,) int64
        Rows of the sheet's triangles, ascending.
    """

    vertices: Ints
    edges: Ints
    triangles: Ints


def beyond_planes(points: Array, triangles: Ints, on_planes: Array, normals: Array) -> Overlaps:
    """What is behind a plane, or out of a box that contains the sheet.

    Parameters
    ----------
    points : (V, 3) float64
        Of the sheet [m].
    triangles : (F, 3) int64
    on_planes, normals : (n, 3) float64
        A point on each plane [m], and a unit vector towards the side that is free.
    """
    depth = _rounding(points, on_planes)
    out = np.zeros(len(points), dtype=bool)
    for point, normal in zip(on_planes, normals, strict=True):
        out |= (points - point) @ normal < -depth
    return _of_vertices(out, triangles)


def out_of_ball(points: Array, triangles: Ints, axis: Array, radius: float) -> Overlaps:
    """What is out of a sphere or a capsule that contains the sheet.

    Parameters
    ----------
    points : (V, 3) float64
        Of the sheet [m].
    triangles : (F, 3) int64
    axis : (1, 3) or (2, 3) float64
        The centre, or the ends of the axis [m].
    radius : float
        [m].
    """
    distances = _distances(points, _vertices(points), axis[0], axis[-1])
    return _of_vertices(distances > radius + _rounding(points, axis, radius), triangles)


def in_ball(points: Array, triangles: Ints, axis: Array, radius: float) -> Overlaps:
    """What is nearer to a centre or an axis than a radius; parameters as of `out_of_ball`."""
    reach = radius - _rounding(points, axis, radius)
    low, high = axis.min(axis=0) - radius, axis.max(axis=0) + radius

    def within(corners: Ints) -> Mask:
        inside = _boxes_meet(points, corners, low, high)
        inside[inside] = _distances(points, corners[inside], axis[0], axis[-1]) < reach
        return inside

    return _of_simplices(within, points, triangles)


def in_box(points: Array, triangles: Ints, corners: Array) -> Overlaps:
    """What is in a box of any orientation, by axes that separate (Gottschalk, Lin & Manocha 1996).

    Parameters
    ----------
    points : (V, 3) float64
        Of the sheet [m].
    triangles : (F, 3) int64
    corners : (8, 3) float64
        Of the box [m]; corner i + 2 j + 4 k is at the upper end of its first, second and third edge where
        i, j and k are 1.
    """
    edges = corners[[1, 2, 4]] - corners[0]
    lengths = np.linalg.norm(edges, axis=1)
    local = (points - corners.mean(axis=0)) @ (edges / lengths[:, None]).T
    half = 0.5 * lengths - _rounding(points, corners)

    def within(rows: Ints) -> Mask:
        inside = _boxes_meet(local, rows, -half, half)
        shapes = local[rows[inside]]
        sides = np.roll(shapes, -1, axis=1) - shapes
        axes = [np.cross(sides[:, 0], sides[:, 1])]
        axes += [np.cross(along, sides[:, k]) for along, k in itertools.product(np.eye(3), range(3))]
        meets = np.ones(len(shapes), dtype=bool)
        for axis in axes:
            places = np.einsum("nkx,nx->nk", shapes, axis)
            reach = np.abs(axis) @ half
            apart = (places.min(axis=1) >= reach) | (places.max(axis=1) <= -reach)
            meets &= ~(apart & axis.any(axis=1))  # parallel sides and triangles without area give none
        inside[inside] = meets
        return inside

    return _of_simplices(within, points, triangles)


def _rounding(points: Array, obstacle: Array, radius: float = 0.0) -> float:
    largest = max(float(np.abs(points).max(initial=0.0)), float(np.abs(obstacle).max()), radius)
    return ROUNDING * largest


def _vertices(points: Array) -> Ints:
    """(V, 3) vertices as triangles of one point each."""
    return np.repeat(np.arange(len(points))[:, None], 3, axis=1)


def _boxes_meet(points: Array, corners: Ints, low: Array, high: Array) -> Mask:
    """(n,) whether the boxes of triangles have points within a box."""
    of = points[corners]
    return np.asarray(((of.min(axis=1) < high) & (of.max(axis=1) > low)).all(axis=1))


def _of_vertices(out: Mask, triangles: Ints) -> Overlaps:
    """What has a vertex among those that are out of something convex."""
    edges = unique_edges(triangles)
    return Overlaps(
        np.flatnonzero(out), edges[out[edges].any(axis=1)], np.flatnonzero(out[triangles].any(axis=1))
    )


def _of_simplices(within: Any, points: Array, triangles: Ints) -> Overlaps:
    """What is in, by a function of triangles; vertices and edges are triangles without area."""
    edges = unique_edges(triangles)
    return Overlaps(
        np.flatnonzero(within(_vertices(points))),
        edges[within(edges[:, [0, 1, 1]])],
        np.flatnonzero(within(triangles)),
    )


@cached()
def _distances(points: Any, triangles: Any, start: Any, end: Any) -> Any:
    """(n,) distances of triangles, which may be segments or points, from a segment or point.

    Each is that of two points of both, the nearest up to rounding: never too small by more.
    """
    distances = np.empty(len(triangles))
    along = end - start
    for i in range(len(triangles)):
        a, b, c = points[triangles[i, 0]], points[triangles[i, 1]], points[triangles[i, 2]]
        least = min(
            _between_segments(a, b, start, end),
            _between_segments(b, c, start, end),
            _between_segments(c, a, start, end),
        )
        normal = _cross(b - a, c - a)
        area = _dot(normal, normal)
        if area > 0.0:
            least = min(least, _within(a, b, c, normal, start), _within(a, b, c, normal, end))
            climb = _dot(along, normal)
            share = _dot(a - start, normal) / climb if climb != 0.0 else -1.0
            if 0.0 < share < 1.0:
                least = min(least, _within(a, b, c, normal, start + share * along))
        distances[i] = least
    return distances


@cached()
def _within(a: Any, b: Any, c: Any, normal: Any, point: Any) -> float:
    """Distance of a point from its projection onto a triangle; inf if that is beside the triangle."""
    x = _dot(_cross(b - point, c - point), normal)
    y = _dot(_cross(c - point, a - point), normal)
    z = _dot(_cross(a - point, b - point), normal)
    total = x + y + z
    if not (x >= 0.0 and y >= 0.0 and z >= 0.0 and total > 0.0):
        return np.inf
    gap = (x / total) * (a - point) + (y / total) * (b - point) + (z / total) * (c - point)
    return float(np.sqrt(_dot(gap, gap)))


@cached()
def _between_segments(a: Any, b: Any, c: Any, d: Any) -> float:
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


@cached()
def _cross(a: Any, b: Any) -> Any:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@cached()
def _dot(a: Any, b: Any) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


NAMED = 3
"""Triangles, or pairs of them, that a message names."""


def refuse_crossings(
    scene: Scene, mesh: Mesh, positions: Array, obstacles: Sequence[Solid | Container]
) -> None:
    """Refuse a start in which triangles cross, or are in an obstacle.

    Parameters
    ----------
    scene : Scene
        With ``contact``.
    mesh : Mesh
    positions : (V, 3) float64
        Of its vertices at t = 0 [m].
    obstacles : sequence of Solid or Container
        As `obstacles.made` makes them.

    Raises
    ------
    InputError
        The first triangles, and where they are.
    """
    assert scene.contact is not None
    triangles = mesh.triangles

    def refuse(key: str, count: str, named: Iterable[str], remedy: str) -> None:
        first = ", ".join(named)
        message = f"at the start {count} (counted from 0, the first: {first}); {remedy}"
        raise InputError(message, file=scene.source, key=key)

    def around(*numbers: int) -> str:
        x, y, z = positions[triangles[list(numbers)]].mean(axis=(0, 1))
        return f"around ({x:.4g}, {y:.4g}, {z:.4g}) m"

    if scene.contact.self and len(pairs := self_crossings(positions, triangles)):
        refuse(
            "contact",
            _counted(len(pairs), "pair", "of triangles", "cross"),
            (f"{a} and {b} {around(a, b)}" for a, b in pairs[:NAMED].tolist()),
            "move the sheets apart, or give self: false",
        )
    remedy = "move the sheet, or the obstacle"
    for obstacle in obstacles:
        key, shape = f"obstacles.{obstacle.name}", (scene.obstacles or {})[obstacle.name]
        if shape.mesh is not None and isinstance(obstacle, Solid):
            pairs = mutual_crossings(positions, triangles, obstacle.points, obstacle.triangles)
            if len(pairs):
                named = (f"{a} and {b} {around(a)}" for a, b in pairs[:NAMED].tolist())
                count = _counted(len(pairs), "pair", "of a triangle of the sheet and one of it", "cross")
                refuse(key, count, named, remedy)
            continue
        inside = find_overlaps(obstacle, positions, triangles, 0.0, is_box=shape.box is not None).triangles
        if len(inside):
            where = "into it" if isinstance(obstacle, Solid) else "beyond it"
            named = (f"{a} {around(a)}" for a in inside[:NAMED].tolist())
            refuse(
                key, f"{_counted(len(inside), 'triangle', 'of the sheet', 'reach')} {where}", named, remedy
            )


def find_overlaps(
    obstacle: Solid | Container, positions: Array, triangles: Ints, time: float, *, is_box: bool
) -> Overlaps:
    """What of a sheet at positions (V, 3) [m] is at a time [s] where an obstacle does not let it.

    ``is_box`` tells a box from a mesh, of which only the triangles that cross it are found.
    """
    sheet, points = (positions, triangles), obstacle.positions(time)
    if isinstance(obstacle, Container):
        if obstacle.kind == "planes":
            return beyond_planes(*sheet, points, obstacle.normals_at(time))
        return out_of_ball(*sheet, points, obstacle.radius)
    if obstacle.radius > 0.0:
        return in_ball(*sheet, points, obstacle.radius)
    if is_box:
        return in_box(*sheet, points)
    crossed = mutual_crossings(*sheet, points, obstacle.triangles)[:, 0]
    return Overlaps(np.empty(0, np.int64), np.empty((0, 2), np.int64), np.unique(crossed))


def _counted(count: int, noun: str, of: str, verb: str) -> str:
    """Subject and verb."""
    return f"{count} {noun} {of} {verb}es" if count == 1 else f"{count} {noun}s {of} {verb}"
