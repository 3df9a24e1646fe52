"""Which points of the mesh attachments join, on rank 0: vertices, and points inside triangles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.measures import bounding_diagonal
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.select import select_triangles, select_vertices
from lyra_petsc.scene.attachment_block import AttachmentEnd
from lyra_petsc.scene.schema import Scene

AT_VERTEX = 1e-9
"""Weight of a vertex below which a point of a triangle does not depend on it."""


class MeshPoints(NamedTuple):
    """Points of the sheets.

    Attributes
    ----------
    vertices : (n, 3) int64
        The corners of a triangle; a vertex three times for a vertex.
    weights : (n, 3) float64
        Barycentric coordinates.
    """

    vertices: Ints
    weights: Array

    @classmethod
    def at(cls, vertices: Ints) -> MeshPoints:
        """Vertices (n,)."""
        return cls(np.repeat(vertices[:, None], 3, axis=1), np.tile([1.0, 0.0, 0.0], (len(vertices), 1)))

    def positions(self, x: Array) -> Array:
        """Positions (n, 3) [m] for those of the vertices x (V, 3)."""
        return np.einsum("nc,nci->ni", self.weights, x[self.vertices])


class AttachedPoints(NamedTuple):
    """Pairs of points of one attachment, each as a sum over vertices.

    Attributes
    ----------
    vertices : list of (m,) int64
        Vertices of each pair, each once.
    weights : list of (m,) float64
        The vector from the point of ``to`` to that of ``from`` is the sum of the vertices' positions times
        these weights.
    distance : (n,) float64
        Distance of the points at the start [m].
    """

    vertices: list[Ints]
    weights: list[Array]
    distance: Array


def attached_points(scene: Scene, mesh: Mesh) -> list[AttachedPoints]:
    """The pairs of points of each attachment of a scene.

    Raises
    ------
    InputError
        As `select_vertices`; or a point would be attached to itself.
    """
    return [_attached(scene, mesh, number) for number in range(len(scene.attachments))]


def _attached(scene: Scene, mesh: Mesh, number: int) -> AttachedPoints:
    attachment, key = scene.attachments[number], f"attachments[{number}]"
    here = _points(mesh, attachment.start, f"{key}.from", scene.source)
    places = here.positions(mesh.positions)
    there = _nearest(mesh, attachment.to, places, f"{key}.to", scene.source)
    distance = np.linalg.norm(places - there.positions(mesh.positions), axis=1)
    pairs = [
        _sum_of(*pair)
        for pair in zip(here.vertices, here.weights, there.vertices, there.weights, strict=True)
    ]
    for n, (vertices, _) in enumerate(pairs):
        if not len(vertices):
            raise InputError(
                f"the point at vertex {here.vertices[n, 0]} would be attached to itself; name another sheet "
                "or group in to",
                key=f"{key}.to",
                file=scene.source,
            )
    return AttachedPoints([vertices for vertices, _ in pairs], [weights for _, weights in pairs], distance)


def _sum_of(here: Ints, plus: Array, there: Ints, minus: Array) -> tuple[Ints, Array]:
    """Vertices, each once, and their weights in the difference of two points, without those of no weight."""
    vertices, at = np.unique(np.concatenate([here, there]), return_inverse=True)
    weights = np.bincount(at, np.concatenate([plus, -minus])).astype(np.float64)
    kept = np.abs(weights) > AT_VERTEX
    return vertices[kept], weights[kept]


def _points(mesh: Mesh, end: AttachmentEnd, key: str, file: object | None) -> MeshPoints:
    """The points that an end names."""
    if end.point is None:
        return MeshPoints.at(select_vertices(mesh, end, key=key, file=file))
    triangles = select_triangles(mesh, end.group, key=f"{key}.group", file=file)
    return nearest_on_triangles(np.array([end.point]), mesh, triangles)


def _nearest(mesh: Mesh, end: AttachmentEnd, places: Array, key: str, file: object | None) -> MeshPoints:
    """The point of an end that is nearest to each of the places (n, 3) [m]."""
    if end.point is None and end.group in mesh.groups and mesh.groups[end.group].dimension == 2:
        return nearest_on_triangles(places, mesh, mesh.groups[end.group].triangles)
    points = _points(mesh, end, key, file)
    at = points.positions(mesh.positions)
    # of vertices at the same distance up to round-off the first
    same = 1e-12 * bounding_diagonal(mesh.positions)
    distances = [np.linalg.norm(at - place, axis=1) for place in places]
    rows = np.array([int((away <= away.min() + same).argmax()) for away in distances])
    return MeshPoints(points.vertices[rows], points.weights[rows])


def nearest_on_triangles(places: Array, mesh: Mesh, triangles: Ints) -> MeshPoints:
    """The points of ``triangles`` (m,) of a mesh that are nearest to places (n, 3) [m] at the start."""
    corners = mesh.positions[mesh.triangles[triangles]]
    middle = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    rows, weights = [], []
    for place in places:
        away = np.linalg.norm(middle - place, axis=1)
        near = np.flatnonzero(away - reach <= (away + reach).min())
        of_near = _barycentric(place, corners[near])
        distance = np.linalg.norm(np.einsum("nc,nci->ni", of_near, corners[near]) - place, axis=1)
        first = int(distance.argmin())
        rows.append(triangles[near[first]])
        weights.append(of_near[first])
    return MeshPoints(mesh.triangles[rows], np.array(weights))


def _barycentric(place: Array, corners: Array) -> Array:
    """Barycentric coordinates (n, 3) of the points of triangles (n, 3, 3) [m] that are nearest to a place."""
    n, rows = len(corners), np.arange(len(corners))
    sides = np.roll(corners, -1, axis=1) - corners
    along = np.einsum("nci,nci->nc", place - corners, sides) / np.einsum("nci,nci->nc", sides, sides)
    along = np.clip(along, 0.0, 1.0)
    on_sides = corners + along[:, :, None] * sides
    side = np.linalg.norm(on_sides - place, axis=2).argmin(axis=1)
    weights = np.zeros((n, 3))
    weights[rows, side] = 1.0 - along[rows, side]
    weights[rows, (side + 1) % 3] = along[rows, side]
    normal = np.cross(sides[:, 0], sides[:, 1])
    square = np.einsum("ni,ni->n", normal, normal)
    # areas opposite to the corners, over that of the triangle
    areas = np.stack(
        [
            np.einsum("ni,ni->n", np.cross(sides[:, c], place - corners[:, c]), normal) / square
            for c in (1, 2, 0)
        ],
        axis=1,
    )
    inside = (areas >= 0.0).all(axis=1)
    weights[inside] = areas[inside]
    return weights
