"""How often sides and corners of triangles count, so that of a surface each place counts once.

Inclusion and exclusion: where n triangles have a side in common it counts −(n − 1) times, and a corner
1 − (its triangles) + Σ (n − 1) over its sides; each of the triangles has the same share in it. In a sheet
that is −1 of a side and 1 of a corner within, and 0 on the border.
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.topology import edge_table

SIDES, CORNERS, TIMES = 3, 63, 7
"""Most triangles that a side and a corner are said to have, and how often a corner counts at most, either
way. More would be another energy, and as smooth."""


def rings(triangles: Ints) -> Ints:
    """What is around each of the triangles (F, 3), in one number (F,) that `shares` reads."""
    if not len(triangles):
        return np.empty(0, dtype=np.int64)
    table, n = edge_table(triangles), int(triangles.max()) + 1
    at_side = np.empty(triangles.size, dtype=np.int64)
    at_side[table.sides] = np.repeat(table.sizes, table.sizes)
    side = table.sides[table.first]
    ends = np.concatenate([triangles[side // 3, side % 3], triangles[side // 3, (side + 1) % 3]])
    at_corner = np.bincount(triangles.ravel(), minlength=n)
    further = np.bincount(ends, np.tile(table.sizes - 1, 2), minlength=n).astype(np.int64)
    times = np.clip(1 - at_corner + further, -TIMES, TIMES)
    out = np.zeros(len(triangles), dtype=np.int64)
    for of, bits in (
        (np.minimum(at_side.reshape(-1, 3), SIDES), 2),
        (np.minimum(at_corner[triangles], CORNERS), 6),
        (times[triangles] + TIMES, 4),
    ):
        for column in of.T:
            out = (out << bits) + column
    return out


def shares(ring: Ints) -> Array:
    """How often the sides, from each corner to the next, and the corners count for each triangle, (F, 6)."""
    read, out = ring.copy(), np.zeros((len(ring), 6))
    times, at_corner, at_side = np.empty((3, 3, len(ring)), dtype=np.int64)
    for of, bits in ((times, 4), (at_corner, 6), (at_side, 2)):
        for column in range(3)[::-1]:
            of[column] = read & ((1 << bits) - 1)
            read = read >> bits
    given = ring > 0
    for k in range(3):
        out[given, k] = -(at_side[k] - 1.0)[given] / at_side[k][given]
        out[given, 3 + k] = (times[k] - TIMES)[given] / at_corner[k][given]
    return out
