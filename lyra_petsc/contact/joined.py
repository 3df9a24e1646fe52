"""Vertices that seams hold together without making them one: contact leaves out pairs of their parts once
the seam is closed, and keeps them apart by less and less before.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.contact.crossings import self_crossings, still_cross

SEAM_WIDTH = 0.1
"""Part of the way to the middle of its triangle by which a corner at a seam is moved before two triangles
there are judged: they meet at the seam, up to its gap, and the sag of a curved seam between its vertices."""


class JoinedVertices:
    """Which vertices are held together, and by threads of which lengths.

    Parameters
    ----------
    pairs : (n, 2) int64
        Numbers of vertices; of a pair that several threads hold together the longest one counts.
    lengths : callable or None
        Lengths (n,) [m] of the threads of the pairs at a time [s]; without it the threads have none.
    """

    def __init__(self, pairs: Ints, lengths: Callable[[float], Array] | None = None) -> None:
        both = np.concatenate([pairs, pairs[:, ::-1]]).astype(np.int64)
        self._span = int(both.max(initial=-1)) + 1
        self._keys, self._place = np.unique(both[:, 0] * self._span + both[:, 1], return_inverse=True)
        self._vertices = np.unique(both)
        self._lengths_at, self._length = lengths, np.zeros(len(self._keys))

    def __bool__(self) -> bool:
        return len(self._keys) > 0

    def concern(self, vertices: Ints) -> Ints:
        """The rows of ``vertices`` (n, p) with any vertex that is held."""
        return np.flatnonzero(np.isin(vertices, self._vertices).any(axis=1))

    def expect(self, time: float, longest: float) -> bool:
        """Take the threads' lengths at a time [s], ``longest`` [m] where they are longer; returns whether any
        has changed.
        """
        if self._lengths_at is None or not self:
            return False
        lengths, before = np.minimum(self._lengths_at(time), longest), self._length
        self._length = np.zeros(len(self._keys))
        np.maximum.at(self._length, self._place, np.concatenate([lengths, lengths]))
        return not np.array_equal(self._length, before)

    def lengths(self, first: Ints, second: Ints) -> Array:
        """Lengths [m] of the threads between each vertex of rows ``first`` (n, p) and each of ``second``
        (n, q), (n, p, q); infinite where there is none.
        """
        one, other = np.broadcast_arrays(first[:, :, None], second[:, None, :])
        if not len(self._keys):
            return np.full(one.shape, np.inf)
        known = (one < self._span) & (other < self._span)
        key = np.where(known, one * self._span + other, -1)
        at = np.minimum(np.searchsorted(self._keys, key), len(self._keys) - 1)
        return np.where(known & (self._keys[at] == key), self._length[at], np.inf)

    def between(self, first: Ints, second: Ints) -> Mask:
        """Whether each vertex of rows ``first`` (n, p) is held together with each of ``second`` (n, q),
        (n, p, q).
        """
        return np.asarray(np.isfinite(self.lengths(first, second)))


def crossings_beside_seams(points: Array, triangles: Ints, tied: Ints) -> Ints:
    """The pairs (n, 2) of `self_crossings`, without those that only meet at a seam.

    ``tied`` (m, 2) are the vertices that seams hold together.
    """
    pairs, joined = self_crossings(points, triangles), JoinedVertices(tied)
    if not (joined and len(pairs)):
        return pairs
    corners = triangles[pairs]
    held = joined.between(corners[:, 0], corners[:, 1])
    at_seam = np.stack([held.any(axis=2), held.any(axis=1)], axis=1)
    judged = np.flatnonzero(at_seam.any(axis=(1, 2)))
    shapes = points[corners[judged]]
    middle = shapes.mean(axis=2, keepdims=True)
    shapes += SEAM_WIDTH * at_seam[judged][:, :, :, None] * (middle - shapes)
    return np.delete(pairs, judged[~still_cross(shapes)], axis=0)
