"""Closed surfaces of triangles: their holes, the gaps of seams, and a common orientation."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.topology import connected_components, edge_table, side_vertices, walk

if TYPE_CHECKING:
    from lyra_petsc.mesh.seams import SeamSide, SewnCurves


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
    ends = _boundary(triangles)
    vertices, own = np.unique(ends, return_inverse=True)
    own = own.reshape(-1, 2)
    curve = connected_components(len(vertices), own)[own[:, 0]]
    lengths = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)
    curves = [curve == number for number in np.unique(curve)]
    listed = [
        Hole(points[ends[mine]].mean(axis=(0, 1)), float(lengths[mine].sum()), int(mine.sum()))
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


def _boundary(triangles: Ints) -> Ints:
    """Edges (m, 2) of one triangle."""
    table = edge_table(triangles)
    return side_vertices(triangles, table.sides[table.first[table.sizes == 1]])[:, :2]


def sewn_shut(triangles: Ints, seams: Sequence[SewnCurves]) -> Ints:
    """Triangles (F, 3), and those that fill the gaps of seams between them, and the corners between gaps.

    Between its sides a seam has a strip of triangles, and at its ends an edge from one side to the other;
    curves of such edges alone are filled, too. The vertices are those of both sides, so that a strip is as
    wide as its seam is open, and encloses nothing once the seam is closed.
    """
    boundary = {frozenset(edge) for edge in _boundary(triangles).tolist()}
    strips, ends = [triangles], set()
    for sewn in seams:
        one, other = (side.vertices.tolist() for side in sewn.sides)
        if all(frozenset(edge) in boundary for path in (one, other) for edge in pairwise(path)):
            strips.append(_strip(*sewn.sides))
            ends |= {frozenset((one[at], other[at])) for at in (0, -1)}
    shut = np.concatenate(strips)
    shut = shut[(shut != np.roll(shut, 1, axis=1)).all(axis=1)]  # where both sides have a vertex in common
    rows = [edge for edge in _boundary(shut).tolist() if frozenset(edge) in ends]
    left = np.array(rows, dtype=np.int64).reshape(-1, 2)
    curve = connected_components(int(triangles.max()) + 1, left)[left[:, 0]]
    for number in np.unique(curve):
        if (np.bincount(left[curve == number].ravel()) % 2 == 0).all():
            corner = walk(left[curve == number])[:-1]
            fan = [(corner[0], *edge) for edge in pairwise(corner[1:].tolist())]
            shut = np.concatenate([shut, np.array(fan, dtype=np.int64).reshape(-1, 3)])
    return shut


def _strip(one: SeamSide, other: SeamSide) -> Ints:
    """Triangles (m, 3) between the sides of a seam, one for each edge, in the order of their middles."""
    middle, opposite = ((0.5 * (side.place[:-1] + side.place[1:]) / side.length) for side in (one, other))
    passed = other.vertices[np.searchsorted(opposite, middle, side="left")]
    reached = one.vertices[np.searchsorted(middle, opposite, side="right")]
    return np.concatenate(
        [
            np.stack([one.vertices[:-1], one.vertices[1:], passed], axis=1),
            np.stack([reached, other.vertices[1:], other.vertices[:-1]], axis=1),
        ]
    )
