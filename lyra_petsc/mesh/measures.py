"""Lengths, areas and material frames of the rest shape."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.mesh import Mesh

# below this length of x projected into a triangle's plane, y is the better guide
_NEARLY_NORMAL = 0.1


def triangle_sides(corners: Array) -> tuple[Array, Array]:
    """The two sides (n, d) each that leave the first corner; ``corners`` is (n, 3, d)."""
    return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]


def rest_matrices(mesh: Mesh, warp_degrees: Array | float = 0.0) -> tuple[Array, Array]:
    """Inverse rest matrices in material axes, and rest areas.

    With ``Dm = [u1 - u0, u2 - u0]`` (columns, in material axes) and ``Ds`` the same of current
    positions, the deformation gradient is ``F = Ds Dm⁻¹``. The first material axis is the warp:
    the first axis of ``triangle_uv`` rotated by ``warp_degrees`` anticlockwise in that plane.

    ``det Dm`` is positive for every triangle: where the corners run clockwise in the material plane
    (a mirrored pattern piece) the second material axis is reversed, after the rotation. That changes
    the sign of the shear E_uv only, hence no energy of an orthotropic material.

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
    # from the unrotated sides, so that areas do not depend on the warp's round-off
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
    """Mean rest length [m] of the triangles' sides (interior edges count twice)."""
    return float(edge_lengths(mesh).mean())


def edge_lengths(mesh: Mesh) -> Array:
    """Rest lengths (F, 3) [m] of the triangles' sides (interior edges are there twice)."""
    uv = mesh.triangle_uv
    return np.linalg.norm(uv - np.roll(uv, -1, axis=1), axis=2)


def bounding_diagonal(points: Array) -> float:
    """Diagonal [m] of the axis-parallel bounding box of ``points`` (n, d)."""
    return float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))


def plane_coordinates(rest: Array, triangles: Ints) -> Array:
    """Coordinates of each triangle's corners in its own plane.

    The first axis is x projected into the plane, or y where the plane is nearly normal to x (x makes
    less than about 6° with the normal); the second is the normal times the first. Coordinates are
    measured from the origin, so those of a flat sheet are continuous. A sheet flat in xy gets its x, y.

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


def _projected(direction: Array, normal: Array) -> Array:
    return direction - (normal @ direction)[:, None] * normal


def _unit(vectors: Array) -> Array:
    # scaled first: the cross product of two tiny sides would underflow when squared
    vectors = vectors / np.abs(vectors).max(axis=1, keepdims=True)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
