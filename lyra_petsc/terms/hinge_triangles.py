"""The triangles that hinges join, found from the hinges' points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Ints32 = NDArray[np.int32]


class HingeTriangles(NamedTuple):
    """T triangles of E hinges; a side is four times its triangle plus the corner that it lies opposite to.

    A triangle is found in all hinges that run through its corners in the same sense; where the sheet's
    triangles do not agree about its upper side, some are here twice, with other hinges each.

    Attributes
    ----------
    corners : (T, 3) int32
        Ascending.
    turned : (T,) int8
        −1 where the hinges run through the ascending corners the other way round, else 1.
    sides : (E + 1, 2) int32
        Side on which each hinge has its first and its second triangle; the last row is nobody's.
    hinges : (T, 3) int32
        Of the side opposite to each corner: twice its hinge, plus 1 in the second triangle; 2 E: none.
    """

    corners: Ints32
    turned: NDArray[np.int8]
    sides: Ints32
    hinges: Ints32


def triangles_of(stencil: Ints32) -> HingeTriangles:
    """The triangles of hinges (E, 4): (0, 1, 2) and (1, 0, 3)."""
    n = len(stencil)
    ways = np.concatenate([stencil[:, [0, 1, 2]], stencil[:, [1, 0, 3]]])
    order = np.argsort(ways, axis=1, kind="stable").astype(np.int8)
    corners = np.take_along_axis(ways, order, axis=1)
    opposite = np.argmax(order == 2, axis=1)
    odd = (order[:, 0] > order[:, 1]) ^ (order[:, 1] > order[:, 2]) ^ (order[:, 0] > order[:, 2])
    # two hinges on one side of a triangle have a triangle each
    n_points = int(stencil.max(initial=0)) + 1
    first_two = corners[:, 0] * np.int64(n_points) + corners[:, 1]
    by = np.lexsort((8 * corners[:, 2].astype(np.int64) + 4 * odd + opposite, first_two))
    same = np.all(corners[by[1:]] == corners[by[:-1]], axis=1) & (odd[by[1:]] == odd[by[:-1]])
    again = same & (opposite[by[1:]] == opposite[by[:-1]])
    first = np.concatenate([np.ones(min(2 * n, 1), dtype=bool), ~same | again])
    number = np.empty(2 * n, dtype=np.int32)
    number[by] = np.cumsum(first, dtype=np.int32) - 1
    kept = by[first]
    hinges = np.full((len(kept), 3), 2 * n, dtype=np.int32)
    hinges[number, opposite] = 2 * np.tile(np.arange(n, dtype=np.int32), 2) + np.repeat([0, 1], n)
    sides = np.zeros((n + 1, 2), dtype=np.int32)
    sides[:n] = (4 * number + opposite).reshape(2, n).T
    turned = np.where(odd[kept], -1, 1).astype(np.int8)
    return HingeTriangles(np.ascontiguousarray(corners[kept], dtype=np.int32), turned, sides, hinges)
