"""The sheet as it is drawn: vertices doubled along the seams of its texture, smooth normals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Surface:
    """Triangles of a sheet, and what is needed to move them.

    Parameters
    ----------
    triangles : (F, 3) int64
    corner_uv : (F, 3, 2) float64, optional
        Texture coordinates; a vertex that has several is drawn several times.

    Attributes
    ----------
    corners : (F, 3) int64
        Triangles in the numbering of the vertices drawn.
    source : (n,) int64
        Vertex of the mesh behind every vertex drawn.
    uv : (n, 2) float64 or None
        Texture coordinates of the vertices drawn.
    """

    def __init__(self, triangles: Indices, n_vertices: int, corner_uv: Array | None = None) -> None:
        self._triangles, self._n_vertices = triangles, n_vertices
        self.uv: Array | None = None
        self.corners: Indices = triangles
        self.source: Indices = np.arange(n_vertices)
        if corner_uv is not None:
            rows = np.column_stack([triangles.ravel().astype(np.float64), corner_uv.reshape(-1, 2)])
            different, drawn = np.unique(rows, axis=0, return_inverse=True)
            self.corners = drawn.reshape(triangles.shape).astype(np.int64)
            self.source = different[:, 0].astype(np.int64)
            self.uv = different[:, 1:]

    def points(self, x: Array) -> Array:
        """(n, 3) positions of the vertices drawn, from those of the mesh (V, 3) [m]."""
        return x[self.source]

    def normals(self, x: Array) -> Array:
        """(n, 3) unit normals of the vertices drawn: the mean of their triangles', by area."""
        corners = x[self._triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        ends, three = self._triangles.ravel(), np.repeat(normals, 3, axis=0)
        summed = np.stack([np.bincount(ends, three[:, k], self._n_vertices) for k in range(3)], axis=1)
        lengths = np.linalg.norm(summed, axis=1, keepdims=True)
        unit = np.divide(summed, lengths, out=np.zeros_like(summed), where=lengths > 0.0)
        return np.asarray(unit[self.source])


def over_whole_sheet(corner_uv: Array) -> Array:
    """Coordinates scaled so that a picture covers the sheet once."""
    low, high = corner_uv.min(axis=(0, 1)), corner_uv.max(axis=(0, 1))
    scaled: Array = (corner_uv - low) / np.where(high > low, high - low, 1.0)
    return scaled
