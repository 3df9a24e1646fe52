"""Material coordinates for surfaces that came without: each rest triangle laid out in its own plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# below this length of x projected into a triangle's plane, y is the better guide
_NEARLY_NORMAL = 0.1


def lay_out(rest: Floats, triangles: NDArray[np.int64]) -> Floats:
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
    uv: Floats = np.einsum("fci,fai->fca", corners, np.stack([first, second], axis=1))
    return uv


def _projected(direction: Floats, normal: Floats) -> Floats:
    return direction - (normal @ direction)[:, None] * normal


def _unit(vectors: Floats) -> Floats:
    # scaled first: the cross product of two tiny sides would underflow when squared
    vectors = vectors / np.abs(vectors).max(axis=1, keepdims=True)
    unit: Floats = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit
