"""Weights of the sides and corners of triangles such that each point of a surface counts once.

Inclusion and exclusion: a side common to n triangles has the weight −(n − 1), a corner 1 − (number of its
triangles) + Σ (n − 1) over its sides; the triangles share it equally. In a sheet that is −1 for inner sides,
1 for inner corners, and 0 at the boundary.
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.topology import edge_table

MAX_SIDE, MAX_CORNER, MAX_WEIGHT = 3, 63, 7
"""Largest stored numbers of triangles at a side and at a corner, and largest absolute weight of a corner.
Beyond them the energy has other weights and is equally smooth."""


def rings(triangles: Ints) -> Ints:
    """Code of the surroundings of each of the triangles (F, 3), one number (F,) that `shares` decodes."""
    if not len(triangles):
        return np.empty(0, dtype=np.int64)
    table, n_points = edge_table(triangles), int(triangles.max()) + 1
    at_side = np.empty(triangles.size, dtype=np.int64)
    at_side[table.sides] = np.repeat(table.sizes, table.sizes)
    side = table.sides[table.first]
    ends = np.concatenate([triangles[side // 3, side % 3], triangles[side // 3, (side + 1) % 3]])
    at_corner = np.bincount(triangles.ravel(), minlength=n_points)
    side_sums = np.bincount(ends, np.tile(table.sizes - 1, 2), minlength=n_points).astype(np.int64)
    weight = np.clip(1 - at_corner + side_sums, -MAX_WEIGHT, MAX_WEIGHT)
    out = np.zeros(len(triangles), dtype=np.int64)
    for values, bits in (
        (np.minimum(at_side.reshape(-1, 3), MAX_SIDE), 2),
        (np.minimum(at_corner[triangles], MAX_CORNER), 6),
        (weight[triangles] + MAX_WEIGHT, 4),
    ):
        for column in values.T:
            out = (out << bits) + column
    return out


def shares(ring: Ints) -> Array:
    """Shares of each triangle in the weights of its sides (0 1), (1 2), (2 0) and of its corners, (F, 6)."""
    code, out = ring.copy(), np.zeros((len(ring), 6))
    weight, at_corner, at_side = np.empty((3, 3, len(ring)), dtype=np.int64)
    for values, bits in ((weight, 4), (at_corner, 6), (at_side, 2)):
        for column in range(3)[::-1]:
            values[column] = code & ((1 << bits) - 1)
            code = code >> bits
    coded = ring > 0
    for k in range(3):
        out[coded, k] = -(at_side[k] - 1.0)[coded] / at_side[k][coded]
        out[coded, 3 + k] = (weight[k] - MAX_WEIGHT)[coded] / at_corner[k][coded]
    return out
