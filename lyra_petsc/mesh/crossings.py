"""Pairs of triangles that cross: which do is decided exactly, independently of how contact is solved.

Two triangles cross where their relative interiors intersect and they are not in one plane. So what touches
does not cross: a vertex or an edge that lies on the other triangle, triangles that overlap in one plane (a
sheet that is folded flat onto itself), triangles without area, which have no interior. Triangles with a
common edge meet there alone, or lie in one plane; those with a common vertex may cross elsewhere.

Candidates are triangles whose boxes meet; the decision comes from signs of determinants alone (Guigue &
Devillers, Fast and Robust Triangle-Triangle Overlap Test Using Orientation Predicates, Journal of Graphics
Tools 8 (2003) 25-42, with open instead of closed triangles).
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.kernels.cache import cached
from lyra_petsc.mesh.near import near
from lyra_petsc.mesh.orient3d import UNDECIDED, rational_side, side

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

TINY = 2.0**-64
"""By which boxes are made smaller: extents of what is as large as numbers go would overflow."""


def self_crossings(points: Array, triangles: Ints) -> Ints:
    """The pairs of triangles of a surface that cross.

    Parameters
    ----------
    points : (V, 3) float64
        Finite [m].
    triangles : (F, 3) int64

    Returns
    -------
    (n, 2) int64
        Triangles, the smaller first, in lexicographic order. `have_common_vertex` tells those pairs apart.
    """
    return _crossing_of(points, triangles, triangles, near(_boxes(points, triangles)))


def mutual_crossings(points: Array, triangles: Ints, others: Array, other_triangles: Ints) -> Ints:
    """The pairs of triangles of two surfaces, as a sheet and an obstacle, that cross.

    Parameters
    ----------
    points, others : (V, 3) and (W, 3) float64
        Finite [m]. The surfaces have no vertex in common, also not where two lie at one place.
    triangles, other_triangles : (F, 3) and (G, 3) int64
        Rows of ``points`` and of ``others``.

    Returns
    -------
    (n, 2) int64
        Triangle of the first and of the second surface, in lexicographic order.
    """
    every = np.concatenate([points, others])
    theirs = other_triangles + len(points)
    pairs = near(_boxes(every, triangles), _boxes(every, theirs))
    return _crossing_of(every, triangles, theirs, pairs)


def have_common_vertex(triangles: Ints, pairs: Ints) -> NDArray[np.bool_]:
    """(n,) whether the triangles of each of the ``pairs`` (n, 2) have a vertex in common."""
    first, second = triangles[pairs[:, 0]], triangles[pairs[:, 1]]
    return np.asarray((first[:, :, None] == second[:, None, :]).any(axis=(1, 2)))


def _boxes(points: Array, triangles: Ints) -> tuple[Array, Array]:
    """Low and high corners (F, 3) of triangles."""
    corners = TINY * points[triangles]
    return corners.min(axis=1), corners.max(axis=1)


def _crossing_of(points: Array, triangles: Ints, others: Ints, pairs: Ints) -> Ints:
    """Those pairs (n, 2) of triangles and others that cross, in lexicographic order."""
    found = np.empty(len(pairs), dtype=np.int64)
    _decide(points, triangles, others, pairs, found)
    for n in np.flatnonzero(found == UNDECIDED):
        vertices = [*triangles[pairs[n, 0]].tolist(), *others[pairs[n, 1]].tolist()]
        exact = {vertex: tuple(map(Fraction, points[vertex].tolist())) for vertex in vertices}
        found[n] = _rational_crossing(exact, *vertices)
    pairs = pairs[found == 1]
    return np.asarray(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))])


def _decides_crossing(side: Any) -> Callable[..., int]:
    """The function that decides whether two triangles cross, by `orient3d.side` or its like."""

    def crossing(points: Any, a: int, b: int, c: int, d: int, e: int, f: int) -> int:
        """1 where the triangles a, b, c and d, e, f cross, 0 where not, or `UNDECIDED`."""
        first, second = (a, b, c), (d, e, f)
        # each must have corners on both sides of the other's plane: its interior meets the planes' common
        # line in an open interval then, and else does not meet the other's plane, or lies in it
        x, y, z = side(points, d, e, f, a), side(points, d, e, f, b), side(points, d, e, f, c)
        if max(x, y, z) == UNDECIDED:
            return UNDECIDED
        if max(x, y, z) < 1 or min(x, y, z) > -1:
            return 0
        u, v, w = side(points, a, b, c, d), side(points, a, b, c, e), side(points, a, b, c, f)
        if max(u, v, w) == UNDECIDED:
            return UNDECIDED
        if max(u, v, w) < 1 or min(u, v, w) > -1:
            return 0
        # turned so that p is alone on its side, where the normal of the other triangle points
        k = 0 if x not in (0, y, z) else 1 if y not in (0, x, z) else 2
        m = 0 if u not in (0, v, w) else 1 if v not in (0, u, w) else 2
        p, q, r = first[k], first[(k + 1) % 3], first[(k + 2) % 3]
        s, t, o = second[m], second[(m + 1) % 3], second[(m + 2) % 3]
        if (x, y, z)[k] < 0:
            t, o = o, t
        if (u, v, w)[m] < 0:
            q, r = r, q
        # the intervals overlap if each begins before the other one ends
        mine, others = side(points, p, q, s, t), side(points, p, r, o, s)
        if max(mine, others) == UNDECIDED:
            return UNDECIDED
        return int(mine < 0 and others < 0)

    return crossing


_crossing = cached()(_decides_crossing(side))
_rational_crossing = _decides_crossing(rational_side)


@cached()
def _decide(points, triangles, others, pairs, found):  # type: ignore[no-untyped-def]
    """1, 0 or `UNDECIDED` into found (n,) for each pair (n, 2) of a triangle and another one."""
    for n in range(len(pairs)):
        a, b, c = triangles[pairs[n, 0]]
        d, e, f = others[pairs[n, 1]]
        found[n] = _crossing(points, a, b, c, d, e, f)
