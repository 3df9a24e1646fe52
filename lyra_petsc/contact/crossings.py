"""Pairs of triangles that cross, decided exactly and independently of the contact solver.

Two triangles cross if their relative interiors intersect and they are not coplanar. So triangles that touch
do not cross: if a vertex or an edge lies on the other triangle, if they overlap in one plane (a sheet folded
flat onto itself), or if one has no area and hence no interior. Triangles with a common edge intersect only
there or are coplanar; those with a common vertex may cross elsewhere.

Candidates come from a tree of boxes of its own, so that an error in the solver's search is found. The
decision uses only signs of determinants (Guigue & Devillers, Fast and Robust Triangle-Triangle Overlap Test
Using Orientation Predicates, Journal of Graphics Tools 8 (2003) 25-42, with open instead of closed
triangles). These are exact for floating-point coordinates: a determinant is computed in floating point with
an error bound, and if that does not decide, as an expansion, an unevaluated sum of non-overlapping numbers
(Shewchuk, Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates, Discrete &
Computational Geometry 18 (1997) 305-363).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.kernels.cache import cached, inner

UNDECIDED = 2
"""Result where products of coordinates overflow or underflow, so that expansions are not exact."""

_HALF_ULP = 2.0**-53
_RELATIVE = (7.0 + 56.0 * _HALF_ULP) * _HALF_ULP
"""Bound of the determinant's error over the sum of the magnitudes of its terms (Shewchuk 1997, figure 21)."""

_UNDERFLOW = 1e-290
"""Far above the error by underflow of a term whose other factor is at most 1."""

_SMALLEST, _LARGEST = 2.0**-300, 2.0**300
"""Between these bounds products of three numbers and their rounding errors are exact."""

_SPLITTER = 2.0**27 + 1.0
_PARTS = 6 * 2**3 * 4
"""Largest number of terms of the expansion: six products of three differences of two parts, each of four
numbers."""


@cached()
def side(points: Any, a: int, b: int, c: int, d: int) -> int:
    """Sign of (b − a) × (c − a) · (d − a): 1 if d is on the side to which the normal of the triangle a, b, c
    points.

    Parameters
    ----------
    points : (V, 3) float64
        Finite [m].
    a, b, c, d : int
        Rows of ``points``.

    Returns
    -------
    int
        1, −1, 0 for coplanar points, or `UNDECIDED`, where `rational_side` must be used.
    """
    if a in (b, c, d) or b in (c, d) or c == d:
        return 0
    bx, by, bz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    cx, cy, cz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    dx, dy, dz = points[d, 0] - points[a, 0], points[d, 1] - points[a, 1], points[d, 2] - points[a, 2]
    # points in a plane of constant x, y or z, frequent in flat sheets
    if bx == cx == dx == 0.0 or by == cy == dy == 0.0 or bz == cz == dz == 0.0:
        return 0
    determinant = dx * (by * cz - bz * cy) + dy * (bz * cx - bx * cz) + dz * (bx * cy - by * cx)
    size = (
        abs(dx) * (abs(by * cz) + abs(bz * cy))
        + abs(dy) * (abs(bz * cx) + abs(bx * cz))
        + abs(dz) * (abs(bx * cy) + abs(by * cx))
    )
    error = _RELATIVE * size + _UNDERFLOW * (1.0 + abs(dx) + abs(dy) + abs(dz))
    if determinant > error:
        return 1
    if determinant < -error:
        return -1
    return int(_exact_side(points, a, b, c, d))


@inner()
def _exact_side(points: Any, a: int, b: int, c: int, d: int) -> int:
    """`side` by expansions."""
    parts = np.empty((3, 3, 2))
    for row, vertex in enumerate((b, c, d)):
        for axis in range(3):
            high, low = _two_sum(points[vertex, axis], -points[a, axis])
            parts[row, axis, 0], parts[row, axis, 1] = high, low
            for part in (abs(high), abs(low)):
                if part != 0.0 and not _SMALLEST < part < _LARGEST:
                    return UNDECIDED
    expansion, size = np.empty(_PARTS), 0
    for x in range(3):
        for turn in (1, 2):
            y, z = (x + turn) % 3, (x + 2 * turn) % 3
            for choice in range(8):
                first = parts[0, x, choice & 1]
                second = parts[1, y, choice >> 1 & 1]
                third = parts[2, z, choice >> 2]
                if first == 0.0 or second == 0.0 or third == 0.0:
                    continue
                for half in _two_product(first, second):
                    for part in _two_product(half, third):
                        size = _grow_expansion(expansion, size, part if turn == 1 else -part)
    # the parts ascend, and none overlaps the next: the last one is larger than the sum of the others
    return int(np.sign(expansion[size - 1])) if size else 0


@inner()
def _two_sum(a: float, b: float) -> tuple[float, float]:
    """a + b rounded, and the rounding error (Knuth's two-sum)."""
    total = a + b
    virtual = total - a
    return total, (a - (total - virtual)) + (b - virtual)


@inner()
def _two_product(a: float, b: float) -> tuple[float, float]:
    """a b rounded, and the rounding error (Dekker's product with Veltkamp's splitting)."""
    total = a * b
    scaled = _SPLITTER * a
    a_high = scaled - (scaled - a)
    scaled = _SPLITTER * b
    b_high = scaled - (scaled - b)
    a_low, b_low = a - a_high, b - b_high
    return total, a_low * b_low - (((total - a_high * b_high) - a_low * b_high) - a_high * b_low)


@inner()
def _grow_expansion(expansion: Any, size: int, number: float) -> int:
    """Add a number to the expansion in the first ``size`` entries, in place; returns its new size without
    zeros.
    """
    kept = 0
    for i in range(size):
        number, error = _two_sum(number, expansion[i])
        if error != 0.0:
            expansion[kept] = error
            kept += 1
    if number != 0.0:
        expansion[kept] = number
        kept += 1
    return kept


def rational_side(points: Mapping[int, tuple[Fraction, ...]], a: int, b: int, c: int, d: int) -> int:
    """`side` in rational numbers: slow, and exact for any coordinates."""
    (bx, by, bz), (cx, cy, cz), (dx, dy, dz) = (
        [one - other for one, other in zip(points[vertex], points[a], strict=True)] for vertex in (b, c, d)
    )
    determinant = dx * (by * cz - bz * cy) + dy * (bz * cx - bx * cz) + dz * (bx * cy - by * cx)
    return (determinant > 0) - (determinant < 0)


LEAF = 4
"""Triangles in a leaf of the tree."""


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
        Triangles, the lower number first, in lexicographic order; also pairs for which `have_common_vertex`.
    """
    candidates = _search(points, triangles, triangles, *_tree(points, triangles), True)
    return _decide_exactly(points, triangles, triangles, *candidates)


def mutual_crossings(points: Array, triangles: Ints, others: Array, other_triangles: Ints) -> Ints:
    """The pairs of triangles of two surfaces that cross, such as a sheet and an obstacle.

    Parameters
    ----------
    points, others : (V, 3) and (W, 3) float64
        Finite [m]. Vertices of the two surfaces at the same position still count as different.
    triangles, other_triangles : (F, 3) and (G, 3) int64
        Rows of ``points`` and of ``others``.

    Returns
    -------
    (n, 2) int64
        Triangle of the first and of the second surface, in lexicographic order.
    """
    every = np.concatenate([points, others])
    theirs = other_triangles + len(points)
    candidates = _search(every, triangles, theirs, *_tree(every, theirs), False)
    return _decide_exactly(every, triangles, theirs, *candidates)


def have_common_vertex(triangles: Ints, pairs: Ints) -> Mask:
    """Whether the triangles of each of the ``pairs`` (n, 2) have a vertex in common, (n,)."""
    first, second = triangles[pairs[:, 0]], triangles[pairs[:, 1]]
    return np.asarray((first[:, :, None] == second[:, None, :]).any(axis=(1, 2)))


def still_cross(shapes: Array) -> Mask:
    """Whether the two triangles of each of ``shapes`` (n, 2, 3, 3) [m] cross, (n,): exact and slow."""
    points, n = shapes.reshape(-1, 3), len(shapes)
    triangles = np.arange(6 * n).reshape(n, 2, 3)
    pairs = np.repeat(np.arange(n)[:, None], 2, axis=1)
    kept = _decide_exactly(points, triangles[:, 0], triangles[:, 1], pairs, np.zeros(n, dtype=bool))
    return np.isin(pairs[:, 0], kept[:, 0])


def _decide_exactly(points: Array, triangles: Ints, others: Ints, pairs: Ints, decided: Mask) -> Ints:
    """The pairs that cross, in lexicographic order: those decided, and others by rational numbers."""
    kept = decided.copy()
    for n in np.flatnonzero(~decided):
        vertices = [*triangles[pairs[n, 0]].tolist(), *others[pairs[n, 1]].tolist()]
        exact = {vertex: tuple(map(Fraction, points[vertex].tolist())) for vertex in vertices}
        kept[n] = _rational_crossing(exact, *vertices)
    pairs = pairs[kept]
    return np.asarray(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))])


def _tree(points: Array, triangles: Ints) -> tuple[Ints, Array, Array, Array, Array]:
    """A complete binary tree of boxes: node k has the children 2 k and 2 k + 1, node 1 contains all.

    Returns
    -------
    order : (F,) int64
        Triangles in the order of the leaves, `LEAF` each, along a space-filling curve.
    low, high : (F, 3) float64
        Boxes of the triangles, in this order [m].
    node_low, node_high : (2 n, 3) float64
        Boxes of the nodes, of which the last n are the leaves; low > high for empty ones [m].
    """
    corners = points[triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    order = np.argsort(_morton_codes(low, high), kind="stable")
    low, high = low[order], high[order]
    leaves = 1 << max(0, -(-len(triangles) // LEAF) - 1).bit_length()
    node_low, node_high = np.full((2 * leaves, 3), np.inf), np.full((2 * leaves, 3), -np.inf)
    begins = np.arange(0, len(triangles), LEAF)
    if len(begins):
        node_low[leaves:][: len(begins)] = np.minimum.reduceat(low, begins)
        node_high[leaves:][: len(begins)] = np.maximum.reduceat(high, begins)
    level = leaves
    while level > 1:
        below, level = slice(level, 2 * level), level // 2
        node_low[level : 2 * level] = node_low[below].reshape(level, 2, 3).min(axis=1)
        node_high[level : 2 * level] = node_high[below].reshape(level, 2, 3).max(axis=1)
    return order, low, high, node_low, node_high


def _morton_codes(low: Array, high: Array) -> NDArray[np.uint64]:
    """Morton codes (F,) of the centres of boxes, with 21 bits per axis."""
    # a quarter each: sums of very large coordinates would overflow
    centres = 0.25 * low + 0.25 * high
    if not len(centres):
        return np.empty(0, np.uint64)
    lowest = centres.min(axis=0)
    extent = (centres.max(axis=0) - lowest).max()
    bits = ((centres - lowest) * (1.0 / extent if extent > 1e-300 else 0.0) * (2**21 - 1)).astype(np.uint64)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    return np.asarray(bits[:, 0] | bits[:, 1] << np.uint64(1) | bits[:, 2] << np.uint64(2))


def _crossing_predicate(side: Any) -> Callable[..., int]:
    """A function that decides whether two triangles cross, by an orientation predicate such as `side`."""

    def crossing(points: Any, a: int, b: int, c: int, d: int, e: int, f: int) -> int:
        """1 where the triangles a, b, c and d, e, f cross, 0 where not, or `UNDECIDED`."""
        first, second = (a, b, c), (d, e, f)
        # each must have corners on both sides of the other's plane: then its interior intersects the planes'
        # common line in an open interval; otherwise it does not intersect the other's plane, or lies in it
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
        # rotated so that p is alone on its side of the other triangle, to which the other's normal points
        k = 0 if x not in (0, y, z) else 1 if y not in (0, x, z) else 2
        m = 0 if u not in (0, v, w) else 1 if v not in (0, u, w) else 2
        p, q, r = first[k], first[(k + 1) % 3], first[(k + 2) % 3]
        s, t, o = second[m], second[(m + 1) % 3], second[(m + 2) % 3]
        if (x, y, z)[k] < 0:
            t, o = o, t
        if (u, v, w)[m] < 0:
            q, r = r, q
        # the intervals overlap if each begins before the other one ends
        first_begins, second_begins = side(points, p, q, s, t), side(points, p, r, o, s)
        if max(first_begins, second_begins) == UNDECIDED:
            return UNDECIDED
        return int(first_begins < 0 and second_begins < 0)

    return crossing


_crossing = cached()(_crossing_predicate(side))
_rational_crossing = _crossing_predicate(rational_side)


@cached()
def _search(
    points: Any,
    queries: Any,
    triangles: Any,
    order: Any,
    low: Any,
    high: Any,
    node_low: Any,
    node_high: Any,
    within: bool,
) -> tuple[Any, Any]:
    """The pairs of a query and a triangle of the tree that cross or are undecided, and whether they are
    decided.

    With ``within``, queries and triangles are the same, and each pair is examined once.
    """
    pairs, decided, count = np.empty((64, 2), np.int64), np.empty(64, np.bool_), 0
    leaves, stack = len(node_low) // 2, np.empty(64, np.int64)
    for i in range(len(queries)):
        a, b, c = queries[i, 0], queries[i, 1], queries[i, 2]
        lowest, highest = np.minimum(points[a], points[b]), np.maximum(points[a], points[b])
        lowest, highest = np.minimum(lowest, points[c]), np.maximum(highest, points[c])
        stack[0], top = 1, 1
        while top > 0:
            top -= 1
            node = stack[top]
            if _are_disjoint(lowest, highest, node_low[node], node_high[node]):
                continue
            if node < leaves:
                stack[top], stack[top + 1] = 2 * node, 2 * node + 1
                top += 2
                continue
            first = (node - leaves) * LEAF
            for k in range(first, min(first + LEAF, len(order))):
                j = order[k]
                if (within and j <= i) or _are_disjoint(lowest, highest, low[k], high[k]):
                    continue
                d, e, f = triangles[j, 0], triangles[j, 1], triangles[j, 2]
                crosses = _crossing(points, a, b, c, d, e, f)
                if crosses == 0:
                    continue
                if count == len(pairs):
                    pairs, decided = np.concatenate((pairs, pairs)), np.concatenate((decided, decided))
                pairs[count, 0], pairs[count, 1], decided[count] = i, j, crosses != UNDECIDED
                count += 1
    return pairs[:count], decided[:count]


@inner()
def _are_disjoint(low: Any, high: Any, other_low: Any, other_high: Any) -> bool:
    """Whether two boxes have no point in common."""
    return bool(
        (low[0] > other_high[0] or high[0] < other_low[0])
        or (low[1] > other_high[1] or high[1] < other_low[1])
        or (low[2] > other_high[2] or high[2] < other_low[2])
    )
