"""Rigid motions of the pieces of a sheet that nothing prescribed prevents."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.mesh.points import Layout
from lyra_petsc.mesh.topology import connected_components

PREVENTED = 1e-10
"""Mean square displacement of prescribed unknowns, relative to that of the piece, above which a motion is
prevented."""


def rigid_motions(layout: Layout, triangles: NDArray[np.int32], x: Array, held: Mask, size: float) -> Array:
    """Rigid motions (m, n_local, 3), linearly independent, that move no prescribed unknown; collective.

    Each moves one piece of the sheet, at positions x (n_local, 3) [m], by displacements d + ω × r / size of
    its vertices with |d|² + |ω|² = 1, where r is the position relative to the centre.

    Parameters
    ----------
    triangles : (T, 3) int
        Local rows of the vertices of each triangle at an owned vertex.
    held : (n_local, 3) bool
        Prescribed unknowns.
    size : float
        Diagonal of the mesh's bounding box [m].
    """
    piece, n_pieces = _pieces(layout, triangles)
    own, motions = slice(0, layout.n_vertices), []
    for number in range(n_pieces):
        here = piece == number
        weight = here[own].astype(np.float64)
        total = layout.global_sum(float(weight.sum()))[0]
        centre = layout.global_sum(*(weight @ x[own])) / total
        fields = [np.where(here[:, None], axis, 0.0) for axis in np.eye(3)]
        fields += [np.where(here[:, None], np.cross(axis, (x - centre) / size), 0.0) for axis in np.eye(3)]
        prescribed = np.array([field[own][held[own]] for field in fields])
        squares = layout.global_sum(*(prescribed @ prescribed.T).ravel()).reshape(6, 6)
        values, vectors = np.linalg.eigh(squares)
        free = vectors[:, values <= PREVENTED * max(1.0, float(values[-1]))]
        motions += list(np.where(held, 0.0, np.tensordot(free.T, np.array(fields), 1)))
    return np.array(motions).reshape(len(motions), *x.shape)


def _pieces(layout: Layout, triangles: NDArray[np.int32]) -> tuple[Ints, int]:
    """Connected piece of each local row (n_local,), -1 for rows of edges, and their number; collective."""
    n = layout.n_local
    part = connected_components(n, np.concatenate([triangles[:, :2], triangles[:, 1:]]).astype(np.int64))
    label = np.empty((n, 3))
    label[:] = layout.global_number[:, None]
    while True:
        least = np.full(n, np.inf)
        np.minimum.at(least, part, label[:, 0])
        nearby = np.broadcast_to(least[part][:, None], (n, 3)).copy()
        layout.update_ghosts(nearby)
        if not any(layout.global_max(float(np.any(nearby != label)))):
            break
        label = nearby
    vertex = layout.are_vertices(layout.global_number)
    known = np.unique(np.concatenate(layout.comm.allgather(np.unique(label[: layout.n_vertices, 0]))))
    return np.where(vertex, np.searchsorted(known, label[:, 0]), -1), len(known)
