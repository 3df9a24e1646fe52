"""From one mesh to another of the same sheets: where a vertex of the one lies in the triangles of the other.

Rest shapes are compared, sheet by sheet: each point goes to the nearest triangle of its sheet and gets
the barycentric weights of the nearest place in it. On flat sheets that is linear interpolation in
material coordinates; where a curved outline or surface is cut into different triangles the points are
projected onto the nearest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.experiments.study.samples import Samples, Surface, scatter
from lyra_petsc.parallel import on_root

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

CANDIDATES = 12
"""Triangles with the nearest centroids among which the nearest triangle is looked for."""


@dataclass
class Transfer:
    """This rank's part: corners and weights for its slab of points.

    Attributes
    ----------
    wanted : (m,) int64
        Vertices of the other mesh that this rank reads, ascending.
    corner : (n, 3) int64
        Numbers in ``wanted``.
    weight : (n, 3) float64
    """

    wanted: Ints
    corner: Ints
    weight: Array

    def rows(self, comm: MPI.Comm, samples: Samples, sample: int) -> Array:
        """Positions (n, 3) [m] of the other mesh's surface at this rank's points; collective."""
        found = samples.rows(comm, sample, self.wanted)
        interpolated: Array = np.einsum("nc,nci->ni", self.weight, found[self.corner])
        return interpolated


def make_transfer(
    comm: MPI.Comm,
    points: Surface | None,
    point_sheets: Sequence[int],
    other: Surface | None,
    other_sheets: Sequence[int],
) -> Transfer:
    """Plan the way from ``other`` to the vertices of ``points``; collective, set up on rank 0.

    Parameters
    ----------
    points, other : Surface
        Needed on rank 0 only.
    point_sheets, other_sheets : sequence of int
        Vertices of each sheet, which are numbered consecutively.
    """
    found = on_root(comm, lambda: _locate(points, point_sheets, other, other_sheets), share=False)
    corner, weight = (scatter(comm, rows) for rows in found or (None, None))
    wanted, inverse = np.unique(corner, return_inverse=True)
    return Transfer(wanted, inverse.reshape(corner.shape).astype(np.int64), weight)


def _locate(
    points: Surface | None, point_sheets: Sequence[int], other: Surface | None, other_sheets: Sequence[int]
) -> tuple[Ints, Array]:
    """Corners (n, 3) and weights (n, 3) for every vertex of ``points``."""
    assert points is not None
    assert other is not None
    corner = np.empty((len(points.rest), 3), dtype=np.int64)
    weight = np.empty((len(points.rest), 3))
    ends, others = np.cumsum(point_sheets), np.cumsum(other_sheets)
    for sheet, stop in enumerate(ends):
        mine = slice(int(stop) - point_sheets[sheet], int(stop))
        low, high = int(others[sheet]) - other_sheets[sheet], int(others[sheet])
        inside = (other.triangles[:, 0] >= low) & (other.triangles[:, 0] < high)
        corner[mine], weight[mine] = _nearest(points.rest[mine], other.rest, other.triangles[inside])
    return corner, weight


def _nearest(places: Array, vertices: Array, triangles: Ints) -> tuple[Ints, Array]:
    from scipy.spatial import cKDTree

    corners = vertices[triangles]
    count = min(CANDIDATES, len(triangles))
    _, near = cKDTree(corners.mean(axis=1)).query(places, k=count)
    near = np.asarray(near).reshape(len(places), count)
    best = np.full(len(places), np.inf)
    chosen = np.zeros(len(places), dtype=np.int64)
    weight = np.zeros((len(places), 3))
    for candidate in near.T:
        weights = barycentric(places, corners[candidate])
        distance = np.linalg.norm(np.einsum("nc,nci->ni", weights, corners[candidate]) - places, axis=1)
        nearer = distance < best
        best[nearer], chosen[nearer] = distance[nearer], candidate[nearer]
        weight[nearer] = weights[nearer]
    return triangles[chosen], weight


def barycentric(places: Array, corners: Array) -> Array:
    """Weights (n, 3) of the nearest place in each triangle; ``corners`` is (n, 3, 3), ``places`` (n, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    u, v, w = b - a, c - a, places - a
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    wu, wv = _dot(w, u), _dot(w, v)
    area = uu * vv - uv * uv
    s, t = (vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area
    weights: Array = np.stack([1.0 - s - t, s, t], axis=1)
    outside = (weights < 0.0).any(axis=1)
    if outside.any():
        weights[outside] = _on_sides(places[outside], corners[outside])
    return weights


def _on_sides(places: Array, corners: Array) -> Array:
    """Weights of the nearest place on the three sides."""
    best = np.full(len(places), np.inf)
    weights = np.zeros((len(places), 3))
    for k in range(3):
        start, side = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        along = np.clip(_dot(places - start, side) / _dot(side, side), 0.0, 1.0)
        distance = np.linalg.norm(start + along[:, None] * side - places, axis=1)
        nearer = distance < best
        best[nearer] = distance[nearer]
        weights[nearer] = 0.0
        weights[nearer, k] = 1.0 - along[nearer]
        weights[nearer, (k + 1) % 3] = along[nearer]
    return weights


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", a, b))
