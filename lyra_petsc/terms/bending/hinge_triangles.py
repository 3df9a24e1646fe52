"""The triangles that hinges join, found from the hinges' vertices."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Ints32 = NDArray[np.int32]


class HingeTriangles(NamedTuple):
    """The T triangles of E hinges. A side has the number 4 triangle + opposite corner (0, 1, 2).

    Attributes
    ----------
    corners : (T, 3) int32
        Vertices, in the orientation in which a hinge's first triangle runs along its edge and the second
        against it.
    sides : (E + 1, 2) int32
        Sides of the first and second triangle at each hinge; the last row is padding.
    hinges : (T, 3) int32
        For the side opposite each corner: 2 hinge, plus 1 in the hinge's second triangle; 2 E if there is no
        hinge.
    """

    corners: Ints32
    sides: Ints32
    hinges: Ints32


def triangles_of(stencil: Ints32, opposite_corners: NDArray[np.int64]) -> HingeTriangles:
    """The triangles (0, 1, 2) and (1, 0, 3) of hinges (E, 4).

    ``opposite_corners`` (E, 2) are the corners (0, 1, 2) of the opposite vertices in their triangles in the
    mesh. With them all ranks order a triangle's corners alike, so that forces that two ranks compute for
    different corners of one triangle balance to the last digit. Hinges that order a triangle's corners
    differently get a copy of it each.
    """
    n = len(stencil)
    triangles = np.concatenate([stencil[:, [0, 1, 2]], stencil[:, [1, 0, 3]]])
    opposite = opposite_corners.T.ravel()
    corners = np.take_along_axis(triangles, (np.arange(3) - opposite[:, None] + 2) % 3, axis=1)
    low, middle, high = np.sort(corners, axis=1).T
    n_points = int(stencil.max(initial=0)) + 1
    # sorted by vertices, as elements are, then by orientation
    sense = 3 * np.argmax(corners == low[:, None], axis=1) + np.argmax(corners == middle[:, None], axis=1)
    order = np.lexsort((opposite, sense, high, low.astype(np.int64) * n_points + middle))
    same = (corners[order[1:]] == corners[order[:-1]]).all(axis=1)
    # two hinges on the same side have a triangle each
    same &= opposite[order[1:]] != opposite[order[:-1]]
    first = np.concatenate([np.ones(min(2 * n, 1), dtype=bool), ~same])
    number = np.empty(2 * n, dtype=np.int32)
    number[order] = np.cumsum(first, dtype=np.int32) - 1
    kept = corners[order[first]]
    hinges = np.full((len(kept), 3), 2 * n, dtype=np.int32)
    hinges[number, opposite] = 2 * np.tile(np.arange(n, dtype=np.int32), 2) + np.repeat([0, 1], n)
    sides = np.zeros((n + 1, 2), dtype=np.int32)
    sides[:n] = (4 * number + opposite).reshape(2, n).T
    return HingeTriangles(np.ascontiguousarray(kept, dtype=np.int32), sides, hinges)
