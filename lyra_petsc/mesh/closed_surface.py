"""Closed surfaces of triangles: their holes, and a common orientation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.topology import connected_components, edge_table, side_vertices


class Hole(NamedTuple):
    """A boundary curve of a surface that should be closed.

    Attributes
    ----------
    centre : (3,)
        Mean position [m] of its vertices.
    length : float [m]
    n_edges : int
    """

    centre: Array
    length: float
    n_edges: int


def holes(points: Array, triangles: Ints) -> list[Hole]:
    """The boundary curves of triangles (F, 3), longest first; curves with a common vertex are one."""
    table = edge_table(triangles)
    ends = side_vertices(triangles, table.sides[table.first[table.sizes == 1]])[:, :2]
    vertices, own = np.unique(ends, return_inverse=True)
    own = own.reshape(-1, 2)
    curve = connected_components(len(vertices), own)[own[:, 0]]
    lengths = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)
    curves = [curve == number for number in np.unique(curve)]
    listed = [
        Hole(points[ends[mine, 0]].mean(axis=0), float(lengths[mine].sum()), int(mine.sum()))
        for mine in curves
    ]
    return sorted(listed, key=lambda hole: -hole.length)


def branches(triangles: Ints) -> Ints:
    """Edges (m, 2) at which more than two of triangles (F, 3) meet."""
    table = edge_table(triangles)
    return side_vertices(triangles, table.sides[table.first[table.sizes > 2]])[:, :2]


def outward(points: Array, triangles: Ints) -> tuple[Ints, int]:
    """The triangles (F, 3) of a closed surface, its normals outwards, and the number of those that were
    turned; -1 if they have no common orientation, as on a Klein bottle.

    Each of its pieces encloses a positive volume.
    """
    table = edge_table(triangles)
    first, second = table.sides[table.first], table.sides[table.first + 1]
    # two triangles are oriented alike if they pass through their common edge in opposite directions
    start = triangles.reshape(-1)
    alike = start[first] != start[second]
    # as two nodes for each triangle, the one as it is and the one turned: connected nodes hold together
    n = len(triangles)
    one, other = first // 3, second // 3
    other_as_is, other_turned = np.where(alike, (other, other + n), (other + n, other))
    links = np.concatenate([np.stack([one, other_as_is], axis=1), np.stack([one + n, other_turned], axis=1)])
    component = connected_components(2 * n, links)
    if (component[:n] == component[n:]).any():
        return triangles, -1
    turned = (
        component[:n] > component[n:]
    )  # of the two components of a piece the lower has its first triangle
    piece = np.unique(np.minimum(component[:n], component[n:]), return_inverse=True)[1]
    corners = points[triangles] - points[triangles].mean(axis=(0, 1))
    sixth = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    volume = np.bincount(piece, np.where(turned, -sixth, sixth))
    turned = turned != (volume < 0.0)[piece]
    return np.where(turned[:, None], triangles[:, ::-1], triangles), int(turned.sum())
