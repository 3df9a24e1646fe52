"""Lengths, areas and material frames of the rest shape."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.mesh import Mesh

SAME_PLACE = 1e-6
"""Fraction of a length (an edge, the sheet) up to which places count as the same: files have six digits."""

SCALE_RATIO = 1.5
"""Ratio of mean lengths from which on a note says that they are not those of one sheet, or as asked for."""

# if the projection of x into the plane of a triangle is shorter, y is projected instead
_NEARLY_NORMAL = 0.1


def triangle_sides(corners: Array) -> tuple[Array, Array]:
    """Vectors (n, d) from the first corner to the second and to the third; ``corners`` is (n, 3, d)."""
    return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]


def rest_matrices(mesh: Mesh, warp_degrees: Array | float = 0.0) -> tuple[Array, Array]:
    """Inverse rest matrices in material axes, and rest areas.

    With ``Dm = [u1 - u0, u2 - u0]`` (columns, in material axes) and ``Ds`` of current positions likewise,
    the deformation gradient is ``F = Ds Dm⁻¹``. The first material axis is the warp: the first axis of
    ``triangle_uv`` rotated by ``warp_degrees`` anticlockwise in the material plane.

    ``det Dm`` is positive for every triangle: where the corners are clockwise in the material plane (a
    mirrored pattern piece) the second material axis is reversed after the rotation. This only changes the
    sign of the shear E_uv, on which the energy of an orthotropic material does not depend.

    Parameters
    ----------
    mesh : Mesh
    warp_degrees : float or (F,) float
        Rotation of the warp direction [°].

    Returns
    -------
    inverse : (F, 2, 2) float64
        Dm⁻¹ [1/m].
    area : (F,) float64
        Rest areas [m²].
    """
    a, b = triangle_sides(mesh.triangle_uv)
    angle = np.radians(np.broadcast_to(np.asarray(warp_degrees, dtype=np.float64), (mesh.n_triangles,)))
    cosine, sine = np.cos(angle), np.sin(angle)
    m00 = cosine * a[:, 0] + sine * a[:, 1]
    m10 = cosine * a[:, 1] - sine * a[:, 0]
    m01 = cosine * b[:, 0] + sine * b[:, 1]
    m11 = cosine * b[:, 1] - sine * b[:, 0]
    # computed from the unrotated sides: areas do not depend on the round-off of the rotation
    determinant = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    mirror = np.where(determinant < 0.0, -1.0, 1.0)
    m10, m11, determinant = mirror * m10, mirror * m11, np.abs(determinant)
    inverse = np.empty((mesh.n_triangles, 2, 2))
    inverse[:, 0, 0] = m11 / determinant
    inverse[:, 0, 1] = -m01 / determinant
    inverse[:, 1, 0] = -m10 / determinant
    inverse[:, 1, 1] = m00 / determinant
    return inverse, 0.5 * determinant


def mean_edge_length(mesh: Mesh) -> float:
    """Mean rest length [m] of the sides of all triangles (an interior edge counts twice)."""
    return float(edge_lengths(mesh).mean())


def edge_lengths(mesh: Mesh) -> Array:
    """Rest lengths (F, 3) [m] of the sides of each triangle."""
    uv = mesh.triangle_uv
    return np.linalg.norm(uv - np.roll(uv, -1, axis=1), axis=2)


def bounding_diagonal(points: Array) -> float:
    """Diagonal [m] of the axis-parallel bounding box of ``points`` (n, d)."""
    return float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))


def plane_coordinates(rest: Array, triangles: Ints) -> Array:
    """Coordinates of the corners of each triangle in the plane of the triangle.

    The first axis is x projected into the plane, or y where x makes less than about 6° with the normal; the
    second is the cross product of the normal and the first. The origin is that of space, so that the
    coordinates on a flat sheet are continuous. A sheet in a plane z = const keeps its x, y.

    Parameters
    ----------
    rest : (V, 3) float64
        Rest surface [m].
    triangles : (F, 3) int64

    Returns
    -------
    (F, 3, 2) float64
        [m].
    """
    corners = rest[triangles]
    height = corners[:, :, 2]
    size = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    if np.ptp(height) <= 1e-12 * size:
        return np.ascontiguousarray(corners[:, :, :2])
    normal = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    first = _projected(np.array([1.0, 0.0, 0.0]), normal)
    steep = np.linalg.norm(first, axis=1) < _NEARLY_NORMAL
    first[steep] = _projected(np.array([0.0, 1.0, 0.0]), normal[steep])
    first = _unit(first)
    second = np.cross(normal, first)
    return np.einsum("fci,fai->fca", corners, np.stack([first, second], axis=1))


def unit_normals(points: Array, triangles: Ints) -> Array:
    """Unit normals (F, 3) of triangles (F, 3) of points (V, 3)."""
    return _unit(np.cross(*triangle_sides(points[triangles])))


def largest_changes(values: Array, triangles: Ints, chosen: Ints) -> Array:
    """Largest difference (n,) between the values (F,) of ``chosen`` (n,) of triangles (F, 3) and those of
    others with which they have a vertex in common.
    """
    corners = np.sort(triangles.ravel())
    owner = np.argsort(triangles.ravel(), kind="stable") // 3
    first, last = (np.searchsorted(corners, triangles[chosen], side) for side in ("left", "right"))
    largest = np.zeros(len(chosen))
    for n, triangle in enumerate(chosen):
        around = np.concatenate([owner[begin:end] for begin, end in zip(first[n], last[n], strict=True)])
        largest[n] = np.abs(values[around] - values[triangle]).max()
    return largest


def _projected(direction: Array, normal: Array) -> Array:
    return direction - (normal @ direction)[:, None] * normal


def _unit(vectors: Array) -> Array:
    # scaling first avoids underflow: the vectors may be cross products of tiny sides
    vectors = vectors / np.abs(vectors).max(axis=1, keepdims=True)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
