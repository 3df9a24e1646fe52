"""Edges of a triangle mesh: hinges (of two triangles), boundary edges (of one), junctions (of more)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints


class Hinges(NamedTuple):
    """Interior edges with their two opposite vertices.

    Attributes
    ----------
    vertices : (H, 4) int64
        ``[a, b, c, d]``: edge a-b in the direction of the first triangle (a, b, c), and the opposite vertex
        d of the second triangle, which is (b, a, d) where orientation is consistent.
    triangles : (H, 2) int64
        First and second triangle; the first has the lower index.
    """

    vertices: Ints
    triangles: Ints


class BoundaryEdges(NamedTuple):
    """Edges that belong to one triangle only.

    Attributes
    ----------
    edges : (B, 2) int64
        Vertices, in the direction of the triangle.
    triangles : (B,) int64
        The triangle of each edge.
    opposite : (B,) int64
        The third vertex of the triangle.
    """

    edges: Ints
    triangles: Ints
    opposite: Ints


class EdgeTable(NamedTuple):
    """All sides of triangles, grouped by undirected edge.

    Side ``3 t + k`` goes from corner k to corner k + 1 of triangle t.

    Attributes
    ----------
    sides : (3F,) int64
        Numbers of the sides; those of one edge are consecutive and ascending.
    first : (E,) int64
        Index in ``sides`` of the first side of each edge.
    sizes : (E,) int64
        Number of sides (and of triangles) of each edge.
    """

    sides: Ints
    first: Ints
    sizes: Ints


def edge_table(triangles: Ints) -> EdgeTable:
    """Group the sides of ``triangles`` (F, 3) by undirected edge; one sort of 3F numbers."""
    start = triangles.reshape(-1)
    end = np.roll(triangles, -1, axis=1).reshape(-1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    span = int(high.max()) + 1 if len(high) else 1
    key = low.astype(np.int64) * span + high
    sides = np.argsort(key, kind="stable")
    key = key[sides]
    first = np.flatnonzero(np.concatenate(([True], key[1:] != key[:-1]))) if len(key) else sides
    sizes = np.diff(np.append(first, len(key)))
    return EdgeTable(sides, first, sizes)


def side_vertices(triangles: Ints, sides: Ints) -> Ints:
    """Start, end and opposite vertex of the given sides: (n, 3)."""
    triangle, corner = np.divmod(sides, 3)
    return np.stack([triangles[triangle, (corner + shift) % 3] for shift in range(3)], axis=1)


def hinges(triangles: Ints) -> Hinges:
    """All edges of exactly two of ``triangles`` (F, 3), ordered by the first triangle and its corner."""
    table = edge_table(triangles)
    begin = table.first[table.sizes == 2]
    first, second = table.sides[begin], table.sides[begin + 1]
    order = np.argsort(first)
    first, second = first[order], second[order]
    vertices = np.concatenate(
        [side_vertices(triangles, first), side_vertices(triangles, second)[:, 2:]], axis=1
    )
    return Hinges(vertices, np.stack([first // 3, second // 3], axis=1))


def enclosed_volumes(points: Array, triangles: Ints, piece: Ints) -> Array:
    """Volume (n,) [m³] that each closed ``piece`` (F,), numbered from 0, of triangles (F, 3) encloses.

    It is negative where normals point inwards, and 0 for pieces with a boundary, and for flat ones.
    """
    corners = points[triangles] - points.mean(axis=0)
    sixth = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    volume = np.bincount(piece, sixth) / 6.0
    volume[np.abs(volume) < 1e-12 * np.bincount(piece, np.abs(sixth))] = 0.0  # round-off
    volume[piece[boundary_edges(triangles).triangles]] = 0.0
    return volume


def junctions(triangles: Ints) -> list[Ints]:
    """For each edge of more than two of ``triangles`` (F, 3), these triangles, ascending."""
    table = edge_table(triangles)
    many = np.flatnonzero(table.sizes > 2)
    return [np.sort(table.sides[table.first[e] :][: table.sizes[e]] // 3) for e in many]


def boundary_edges(triangles: Ints) -> BoundaryEdges:
    """All edges of ``triangles`` (F, 3) that belong to one triangle, ordered by triangle and corner."""
    table = edge_table(triangles)
    sides = np.sort(table.sides[table.first[table.sizes == 1]])
    vertices = side_vertices(triangles, sides)
    return BoundaryEdges(vertices[:, :2], sides // 3, vertices[:, 2])


def unique_edges(triangles: Ints) -> Ints:
    """All edges of ``triangles`` (F, 3), each once, as pairs of vertices (E, 2), lower vertex first."""
    table = edge_table(triangles)
    return np.sort(side_vertices(triangles, table.sides[table.first])[:, :2], axis=1)


def connected_pieces(triangles: Ints, patch: Ints | None = None) -> Ints:
    """Number (F,), from 0 on, of the piece of each of triangles (F, 3): those that common vertices join,
    within each ``patch`` (F,) if patches are given.
    """
    node = triangles
    if patch is not None:
        patch_corners = np.column_stack([np.repeat(patch, 3), triangles.ravel()])
        node = np.unique(patch_corners, axis=0, return_inverse=True)[1].reshape(-1, 3)
    links = np.concatenate([node[:, :2], node[:, 1:]])
    component = connected_components(int(node.max(initial=-1)) + 1, links)
    return np.unique(component[node[:, 0]], return_inverse=True)[1].astype(np.int64)


def connected_components(n: int, pairs: Ints) -> Ints:
    """Lowest number (n,) of the component of each of n nodes that are connected by pairs (m, 2)."""
    component: Ints = np.arange(n)
    while len(pairs):
        low, high = np.sort(component[pairs], axis=1).T
        np.minimum.at(component, high, low)  # joins whole components, as these are their lowest numbers
        while not np.array_equal(component, shorter := component[component]):
            component = shorter
        pairs = pairs[component[pairs[:, 0]] != component[pairs[:, 1]]]
    return component


def walk(edges: Ints) -> Ints:
    """Vertices of a curve of edges (m, 2) in order, from its end of lower number; of a closed one from the
    lowest, which is at both ends.
    """
    around: dict[int, list[int]] = {}
    for a, b in edges.tolist():
        around.setdefault(a, []).append(b)
        around.setdefault(b, []).append(a)
    ends = [vertex for vertex, others in around.items() if len(others) == 1]
    path = [min(ends or around)]
    before = -1
    while len(path) <= len(edges):
        following = [vertex for vertex in around[path[-1]] if vertex != before]
        before = path[-1]
        path.append(min(following))
    return np.array(path, dtype=np.int64)
