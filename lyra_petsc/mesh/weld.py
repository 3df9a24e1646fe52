"""Vertices that coincide: found, counted, and joined."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.mesh import NamedSet, Sheet
from lyra_petsc.mesh.readers import drop_loose_vertices

# no two directions between vertices of a grid have the same component along it
_OBLIQUE = np.sqrt([1.0, 2.0, 3.0]) / np.sqrt(6.0)


def coincident_with(points: Array, distance: float) -> Ints:
    """For each of points (n, 3) [m] the lowest number of those it coincides with, else its own, (n,).

    Points coincide that are nearer than ``distance`` [m] along each axis, or that others between them join.
    """
    same: Ints = np.arange(len(points))
    along = points @ _OBLIQUE
    order = np.argsort(along, kind="stable")
    close = np.diff(along[order]) <= distance + 1e-15 * np.abs(along).max(initial=0.0)
    near = order[np.append(close, False) | np.insert(close, 0, False)]
    if not len(near):
        return same
    cluster = np.zeros(len(near), dtype=np.int64)
    n_clusters = 0
    while n_clusters <= cluster.max():
        n_clusters = int(cluster.max()) + 1
        for coordinate in points[near].T:
            order = np.lexsort((coordinate, cluster))
            parts = (np.diff(coordinate[order]) > distance) | (np.diff(cluster[order]) != 0)
            cluster[order] = np.concatenate(([0], np.cumsum(parts)))
    lowest = np.full(n_clusters, len(points))
    np.minimum.at(lowest, cluster, near)
    same[near] = lowest[cluster]
    return same


def weld(sheet: Sheet, points: Array, distance: float) -> int:
    """Join the vertices of a sheet that coincide at ``points`` (V, 3) [m] (`coincident_with`); returns how
    many were dropped.
    """
    same = coincident_with(points, distance)
    dropped = int((same != np.arange(len(same))).sum())
    if dropped:
        sheet.triangles = same[sheet.triangles]
        sheet.groups = [
            group if group.dimension == 2 else NamedSet(group.name, group.dimension, same[group.members])
            for group in sheet.groups
        ]
        drop_loose_vertices(sheet, noted=False)
    return dropped
