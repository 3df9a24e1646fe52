"""The near pairs of a search as those of the barrier."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.contact import surface_shares
from lyra_petsc.contact.contact_search import EDGE_GAP
from lyra_petsc.contact.contact_setup import AREA_UNITS, Barrier
from lyra_petsc.contact.obstacle_points import Obstacles
from lyra_petsc.contact.pair_distances import EDGE_EDGE, VERTEX_TRIANGLE
from lyra_petsc.contact.pairs import BarrierPairs, NearPairs


def barrier_pairs(
    near: NearPairs, stencil: NDArray[np.int32], barrier: Barrier, obstacles: Obstacles, obstacle_x: Array
) -> BarrierPairs:
    """The pairs with vertices in local rows ``stencil`` (E, 4); obstacle_x (k, m, 3) [m] are positions of the
    obstacles' points in a step.
    """
    kind, obstacle = near.kind, near.obstacle
    points = np.where(near.obstacle_points < 0, near.obstacle_points, stencil)
    narrowing = near.narrowing / AREA_UNITS
    offset = barrier.thickness / narrowing + obstacles.radius[obstacle]
    # distance from the image in a wall over that from the wall: k (g − 2 d)³ / 2 d = 4 k (g / 2 − d)³ / d
    image_scale = np.where(obstacle >= obstacles.first_wall, 2.0, 1.0)
    scale = image_scale * narrowing
    gap = np.where(_are_secondary(kind, obstacle, points, obstacles), EDGE_GAP, 1.0) * barrier.gap / scale
    stiffness = barrier.stiffness / AREA_UNITS * near.stiffness * image_scale**2 * narrowing
    largest = np.append(np.abs(obstacle_x).max(axis=(0, 2)), 0.0)
    of_points = largest[np.where(points < 0, ~points, -1)]
    coordinate = np.maximum(np.abs(offset), of_points.max(axis=1))
    constants = offset, gap, stiffness, scale, surface_shares.shares(near.surroundings), coordinate
    return BarrierPairs(near.vertices, kind, obstacle, points, *constants)


def _are_secondary(kind: Ints, obstacle: Ints, points: Ints, obstacles: Obstacles) -> Mask:
    """Which pairs (E,) have the gap `EDGE_GAP`: two edges of sheets, and edges and points of obstacles where
    their triangles are smooth.
    """
    out: Mask = (kind == EDGE_EDGE) & (obstacle < 0)
    corners = np.flatnonzero((kind == VERTEX_TRIANGLE) & (points[:, 0] < 0))
    out[corners] = obstacles.smooth_points[~points[corners, 0]]
    edges = np.flatnonzero((kind == EDGE_EDGE) & (obstacle >= 0))
    ends = np.sort(~points[edges, 2:], axis=1)
    keys = ends[:, 0] * obstacles.n_points + ends[:, 1]
    first, last = (np.searchsorted(obstacles.smooth_edges, keys, side=s) for s in ("left", "right"))
    out[edges] = first < last
    return out
