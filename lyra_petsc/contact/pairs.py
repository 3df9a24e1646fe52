"""Near pairs of a vertex and a triangle, or of two edges, in arrays of one length."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Ints


class NearPairs(NamedTuple):
    """The pairs that a search finds.

    Attributes
    ----------
    vertices : (E, 4)
        Numbers of the vertices; for points of obstacles that of the pair's first vertex of a sheet.
    kind, obstacle : (E,)
        Kind (`contact_pairs`), and number of the obstacle, −1 between sheets.
    obstacle_points : (E, 4)
        ~number of points of obstacles, 0 for vertices of sheets.
    surroundings : (E,)
        Code of the triangle's sides and corners (`surface_shares`).
    stiffness, narrowing : (E,)
        Factors of the barrier's stiffness, and by which its gap is smaller, in units of 1 / `AREA_UNITS`.
    """

    vertices: Ints
    kind: Ints
    obstacle: Ints
    obstacle_points: Ints
    surroundings: Ints
    stiffness: Ints
    narrowing: Ints


def no_near_pairs() -> NearPairs:
    """No pairs."""
    one, four = np.empty(0, dtype=np.int64), np.empty((0, 4), dtype=np.int64)
    return NearPairs(four, one, one, four, one, one, one)
