"""The triangles that hinges join, found from the hinges' points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Ints32 = NDArray[np.int32]


class HingeTriangles(NamedTuple):
    """T triangles of E hinges; a side is four times its triangle plus the corner that it lies opposite to.

    Attributes
    ----------
    corners : (T, 3) int32
        As their hinges run around them: the first triangle's along the edge, the second's against it.
    sides : (E + 1, 2) int32
        Side on which each hinge has its first and its second triangle; the last row is padding.
    hinges : (T, 3) int32
        Of the side opposite to each corner: twice its hinge, plus 1 in the second triangle; 2 E: none.
    """

    corners: Ints32
    sides: Ints32
    hinges: Ints32


def triangles_of(stencil: Ints32, places: NDArray[np.int64]) -> HingeTriangles:
    """The triangles of hinges (E, 4): (0, 1, 2) and (1, 0, 3).

    The two opposite vertices stand at ``places`` (E, 2) among their triangles' corners. So all ranks have
    these in the same order, and what they compute of one triangle, each for its own corners, balances to the
    last digit. Hinges that disagree about a triangle's corners have one each.
    """
    n = len(stencil)
    ways = np.concatenate([stencil[:, [0, 1, 2]], stencil[:, [1, 0, 3]]])
    opposite = places.T.ravel()
    corners = np.take_along_axis(ways, (np.arange(3) - opposite[:, None] + 2) % 3, axis=1)
    low, middle, high = np.sort(corners, axis=1).T
    n_points = int(stencil.max(initial=0)) + 1
    # by their points as elements are ordered, then by what runs around the same points in the same way
    sense = 3 * np.argmax(corners == low[:, None], axis=1) + np.argmax(corners == middle[:, None], axis=1)
    by = np.lexsort((opposite, sense, high, low.astype(np.int64) * n_points + middle))
    same = (corners[by[1:]] == corners[by[:-1]]).all(axis=1)
    again = same & (opposite[by[1:]] == opposite[by[:-1]])  # two hinges on one side have a triangle each
    first = np.concatenate([np.ones(min(2 * n, 1), dtype=bool), ~same | again])
    number = np.empty(2 * n, dtype=np.int32)
    number[by] = np.cumsum(first, dtype=np.int32) - 1
    kept = corners[by[first]]
    hinges = np.full((len(kept), 3), 2 * n, dtype=np.int32)
    hinges[number, opposite] = 2 * np.tile(np.arange(n, dtype=np.int32), 2) + np.repeat([0, 1], n)
    sides = np.zeros((n + 1, 2), dtype=np.int32)
    sides[:n] = (4 * number + opposite).reshape(2, n).T
    return HingeTriangles(np.ascontiguousarray(kept, dtype=np.int32), sides, hinges)
