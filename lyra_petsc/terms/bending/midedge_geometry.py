"""Geometry of triangles and of the directors on their edges, as arrays over triangles; see ``midedge``."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.terms.bending.midedge_shape import unit

AnyInts = NDArray[np.int32] | NDArray[np.int64]

NO_REST_ROTATION = np.empty((0, 3, 2))
"""Stands for cos ᾱ and sin ᾱ of angles that are all 0."""

SMALLEST_SUM = 1e-4
"""Length of a sum of unit normals below which its direction depends on round-off."""


def areas(material: Array) -> Array:
    """Areas (n,) [m²] of triangles, from the vectors ``material`` (n, 2, 2) [m] along two sides."""
    return 0.5 * np.abs(np.linalg.det(material))


def edge_normals(material: Array) -> tuple[Array, Array]:
    """Outward unit normals (n, 3, 2) of the edges in material axes, and their lengths (n, 3) [m]."""
    one, two = material[:, 0], material[:, 1]
    side = np.stack([two - one, -two, one], axis=1)
    size: Array = np.linalg.norm(side, axis=2)
    return np.stack([side[..., 1], -side[..., 0]], axis=2) / size[..., None], size


def curvatures_of_tangents(material: Array) -> Array:
    """Curvatures κ11, κ22, 2 κ12 [1/m] (second axis) for a unit tangent T_i (third axis), (n, 3, 3)."""
    normal, size = edge_normals(material)
    x, y = normal[..., 0], normal[..., 1]
    weight = (size / areas(material)[:, None])[:, None, :]
    return -np.stack([x * x, y * y, 2.0 * x * y], axis=1) * weight


def normals_of(x: Array, triangles: AnyInts) -> Array:
    """Unit normals (n, 3) of triangles (n, 3)."""
    a, b, c = (x[triangles[:, k]] for k in range(3))
    return unit(np.cross(b - a, c - a))


def director_angles(corners: Array, director: Array) -> tuple[Array, Array, Array, Array]:
    """Angles α (n, 3) [rad] of the directors (n, 3, 3) of triangles with ``corners`` (n, 3, 3) [m].

    Also the unit normals (n, 3), (2A)² (n,) [m⁴] and the edges (n, 3, 3) [m] of the triangles.
    """
    edges = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
    normal = np.cross(edges[:, 1], edges[:, 2])
    square = np.sum(normal * normal, axis=1)
    normal = unit(normal)
    side = np.sum(director * np.cross(unit(edges), normal[:, None, :]), axis=2)
    return np.arctan2(side, np.sum(director * normal[:, None, :], axis=2)), normal, square, edges


def spins_of(frame: Array, edges: Array) -> Array:
    """γ [1/m] of edges (n, 3, 3) [m] as in ``midedge_shape.spin``."""
    square = np.sum(edges * edges, axis=2, keepdims=True)
    along = np.sum(frame * edges, axis=2, keepdims=True)
    return np.asarray(np.cross(edges, frame) / (square + np.sqrt(square) * along))


def rest_rotation_of(data: Mapping[str, Array]) -> Array:
    """cos ᾱ and sin ᾱ (E, 3, 2) of elements; empty if all sheets are flat at rest."""
    return data["rest_rotation"] if data["rest_rotation"][..., 1].any() else NO_REST_ROTATION


def mean_directors(
    x: Array, triangles: AnyInts, number: AnyInts, n_edges: int, rotation: Array, limit: float = np.inf
) -> Array:
    """Unit mean (n_edges, 3) of the triangles' rest directors on each edge.

    A rest director is the triangle's unit normal rotated about the edge by ᾱ; ``rotation`` (F, 3, 2) holds
    cos ᾱ and sin ᾱ, or is empty. Triangles (F, 3) have the edges ``number`` (F, 3). Where rest directors
    cancel, as in a fold of 180° or a cross, and on edges of more than ``limit`` triangles, the rest director
    of the first triangle is taken.
    """
    normals = np.repeat(normals_of(x, triangles)[:, None, :], 3, axis=1)
    if len(rotation):
        along = unit(x[triangles[:, [2, 0, 1]]] - x[triangles[:, [1, 2, 0]]])
        normals = rotation[..., :1] * normals + rotation[..., 1:] * np.cross(along, normals)
    normals, edges = normals.reshape(-1, 3), number.ravel()
    total: Array = np.stack([np.bincount(edges, normals[:, i], n_edges) for i in range(3)], axis=1)
    present, first, count = np.unique(edges, return_index=True, return_counts=True)
    undefined = (np.linalg.norm(total[present], axis=1) < SMALLEST_SUM) | (count > limit)
    total[present[undefined]] = normals[first[undefined]]
    return unit(total)
