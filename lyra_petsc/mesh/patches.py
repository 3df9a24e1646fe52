"""Small patches of a surface, and a proof that those next to each other keep their distance.

A sheet that hardly bends meets itself nowhere, and neighbours in it need not be compared one by one. Let C
be a convex part of the material plane through which no boundary edge of the sheet runs, and let the
deformation gradients F on it differ from one matrix Q by at most s, in the norm of their largest singular
value. Then two of its points at a distance d in the plane are at least (σ(Q) − s) d apart, σ the smallest
singular value: the difference of their positions is the integral of F along the way between them. In the
plane, simplices without a common vertex are no nearer than the smallest altitude of the triangles. As F
changes linearly along straight ways of the vertices, it is enough to look at both ends.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.kernels.cache import cached
from lyra_petsc.mesh.near import near
from lyra_petsc.mesh.topology import edge_table

SIZE = 24
"""Most triangles of a patch."""

SAME = 1e-9
"""Part of a patch's size by which coordinates of one point may differ."""


def patches_of(centres: Array, piece: Ints | None = None) -> Ints:
    """Patches of triangles with these centres (n, d) [m], within pieces (n,): numbers (n,) from 0 on.

    Halves of halves of each piece, each as compact as can be.
    """
    n = len(centres)
    patch = np.zeros(n, dtype=np.int64) if piece is None else np.unique(piece, return_inverse=True)[1]
    while n:
        order = np.argsort(patch, kind="stable")
        first = np.flatnonzero(np.diff(patch[order], prepend=-1))
        sizes = np.diff(first, append=n)
        if sizes.max() <= SIZE:
            break
        each = centres[order]
        extent = np.maximum.reduceat(each, first) - np.minimum.reduceat(each, first)
        along = centres[np.arange(n), extent.argmax(axis=1)[patch]]
        order = np.lexsort((along, patch))
        upper = np.arange(n) - np.repeat(first, sizes) >= np.repeat((sizes + 1) // 2, sizes)
        patch[order] = 2 * patch[order] + (upper & np.repeat(sizes > SIZE, sizes))
        patch = np.unique(patch, return_inverse=True)[1]
    return patch.astype(np.int64)


def connected(triangles: Ints, patch: Ints | None = None) -> Ints:
    """The piece (F,) of each triangle (F, 3): those in a piece, and in a patch, hang together by vertices."""
    corner = np.zeros(len(triangles), dtype=np.int64) if patch is None else patch
    at = np.column_stack([np.repeat(corner, 3), triangles.ravel()])
    node = np.unique(at, axis=0, return_inverse=True)[1].reshape(-1, 3)
    links = np.concatenate([node[:, :2], node[:, 1:]])
    return _pieces(int(node.max(initial=-1)) + 1, links)[node[:, 0]]


class Flat(NamedTuple):
    """What the proof needs of a surface whose triangles are cut into patches.

    Attributes
    ----------
    order, first : (F,), (P + 1,)
        The triangles patch by patch, and where those of each patch begin.
    inverse : (F, 2, 2)
        Of each triangle the inverse of the sides that leave its first corner, in the material plane [1/m].
    beside : (k, 2)
        Patches next to each other, or the same: the smaller first, in ascending order.
    pairs : (m, 2)
        Those of them which a convex part holds.
    around, height : (m + 1,), (m,)
        Where the patches that this part reaches begin in ``reached``, and the smallest altitude [m] in them.
    reached : (k,)
    """

    order: Ints
    first: Ints
    inverse: Array
    beside: Ints
    pairs: Ints
    around: Ints
    height: Array
    reached: Ints


def flat(triangles: Ints, uv: Array, patch: Ints) -> Flat:
    """The proof's data of triangles (F, 3) with material coordinates uv (F, 3, 2) [m] of their corners.

    Where coordinates of a vertex differ among its triangles (seams, curved surfaces) no pair is found.
    """
    n, corners = int(patch.max(initial=-1)) + 1, triangles.ravel()
    order = np.argsort(patch, kind="stable")
    first = np.searchsorted(patch[order], np.arange(n + 1))
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    double = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    inverse = np.stack([np.stack([b[:, 1], -b[:, 0]], -1), np.stack([-a[:, 1], a[:, 0]], -1)], 1)
    inverse /= double[:, None, None]
    longest = np.linalg.norm(uv - np.roll(uv, 1, axis=1), axis=2).max(axis=1)
    low, high = np.full((2, int(corners.max(initial=-1)) + 1, 2), np.inf)
    np.minimum.at(low, corners, uv.reshape(-1, 2))
    np.minimum.at(high, corners, -uv.reshape(-1, 2))
    split = (-high - low).max(axis=1)[triangles].max(axis=1) > SAME * longest
    altitude = np.where(split, 0.0, double / longest)  # below 0 where the corners run clockwise

    # (vertex, patch), each once, and from these the patches that meet at a vertex
    at = np.unique(np.column_stack([corners, np.repeat(patch, 3)]), axis=0)
    begins = np.flatnonzero(np.diff(at[:, 0], prepend=-1))
    sizes = np.diff(begins, append=len(at))
    sharing = [np.repeat(np.arange(n)[:, None], 2, axis=1)]
    for apart in range(1, int(sizes.max(initial=1))):
        some = np.flatnonzero(np.arange(len(at)) + apart < np.repeat(begins + sizes, sizes))
        sharing.append(np.column_stack([at[some, 1], at[some + apart, 1]]))
    pairs: Ints = np.unique(np.sort(np.concatenate(sharing), axis=1), axis=0)

    # boxes in the plane, sheets at heights of their own
    sheet = _pieces(n, pairs)
    corner = np.minimum.reduceat(uv.min(axis=1)[order], first[:-1]) if n else np.empty((0, 2))
    other = np.maximum.reduceat(uv.max(axis=1)[order], first[:-1]) if n else np.empty((0, 2))
    boxes = np.column_stack([corner, sheet]), np.column_stack([other, sheet])
    pairs, between = _with_others_beside(pairs, boxes, float(np.median(longest)) if n else 0.0)
    three = np.column_stack([pairs, between]).T
    parts = np.minimum.reduce(boxes[0][three]), np.maximum.reduce(boxes[1][three])
    table = edge_table(triangles)
    sides = table.sides[table.first[table.sizes == 1]]
    ends = uv[sides // 3, sides % 3], uv[sides // 3, (sides + 1) % 3]
    level = sheet[patch[sides // 3]]
    over = [np.column_stack([end, level]) for end in (np.minimum(*ends), np.maximum(*ends))]
    crossed = near(parts, (over[0], over[1]))
    segments = ends[0][crossed[:, 1]], ends[1][crossed[:, 1]]
    inside = _runs_through(*segments, *(part[crossed[:, 0], :2] for part in parts))
    kept = np.ones(len(pairs), dtype=np.bool_)
    kept[crossed[inside, 0]] = False
    beside, parts, pairs = pairs, (parts[0][kept], parts[1][kept]), pairs[kept]
    met = near(parts, boxes)
    met = met[np.lexsort(met.T[::-1])]
    around = np.searchsorted(met[:, 0], np.arange(len(pairs) + 1))
    least, most = (of.reduceat(altitude[order], first[:-1]) for of in (np.minimum, np.maximum))
    least = np.minimum.reduceat(least[met[:, 1]], around[:-1])
    most = np.maximum.reduceat(most[met[:, 1]], around[:-1])
    height = np.maximum(least, -most)  # below 0 unless the corners of all run alike
    some, sizes = np.asarray(height > 0.0), np.diff(around)
    around = np.append(0, np.cumsum(sizes[some]))
    reached = met[np.repeat(some, sizes), 1]
    return Flat(order, first, inverse, beside, pairs[some], around, height[some], reached)


def _with_others_beside(pairs: Ints, boxes: tuple[Array, Array], reach: float) -> tuple[Ints, Ints]:
    """Pairs (m, 2) of patches that meet, and those within ``reach`` [m] that another patch meets both of; in
    ascending order. And a patch that meets both, of several one that leaves the box around all three small.

    What has no patch in between may be another turn of a spiral, over the first in the material plane.
    """
    n = len(boxes[0])
    beside = near(boxes, reach=reach)
    beside = beside[~np.isin(beside @ [n, 1], pairs @ [n, 1])]
    both = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
    begin = np.searchsorted(both[:, 0], np.arange(n + 1))
    sizes = np.diff(begin)[beside[:, 0]]
    which = np.repeat(np.arange(len(beside)), sizes)
    shift = np.repeat(begin[beside[:, 0]] - np.cumsum(sizes) + sizes, sizes)
    between = both[np.arange(len(which)) + shift, 1]
    meets = np.isin(beside[which, 1] * n + between, both @ [n, 1])
    which, between = which[meets], between[meets]
    three = np.column_stack([beside[which], between]).T
    extent = (np.maximum.reduce(boxes[1][three]) - np.minimum.reduce(boxes[0][three])).max(axis=1)
    order = np.lexsort((extent, which))
    first = order[np.diff(which[order], prepend=-1) > 0]
    every = np.concatenate([pairs, beside[which[first]]])
    others = np.concatenate([pairs[:, 0], between[first]])
    order = np.lexsort(every.T[::-1])
    return every[order], others[order]


def _pieces(n: int, pairs: Ints) -> Ints:
    """The least number (n,) among those that are connected by pairs (m, 2)."""
    piece: Ints = np.arange(n)
    while True:
        before = piece.copy()
        least = np.minimum(*piece[pairs.T])
        np.minimum.at(piece, pairs[:, 0], least)
        np.minimum.at(piece, pairs[:, 1], least)
        piece = piece[piece]
        if np.array_equal(before, piece):
            return piece


def _runs_through(a: Array, b: Array, low: Array, high: Array) -> Mask:
    """Whether segments a b (n, 2) run through the interior of boxes, not only along a side."""
    margin = SAME * (high - low).max(axis=1, initial=0.0, keepdims=True)
    low, high, way = low + margin, high - margin, b - a
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two = (low - a) / way, (high - a) / way
    still = way == 0.0
    enters = np.where(still, np.where((a > low) & (a < high), -np.inf, np.inf), np.minimum(one, two))
    leaves = np.where(still, np.inf, np.maximum(one, two))
    return np.maximum(enters.max(axis=1, initial=0.0), 0.0) < np.minimum(leaves.min(axis=1, initial=1.0), 1.0)


@cached(inline="always")
def _singular(m):  # type: ignore[no-untyped-def]
    """Largest and smallest singular value of a matrix (3, 2), given as its six entries row by row."""
    a, b = m[0] * m[0] + m[2] * m[2] + m[4] * m[4], m[0] * m[1] + m[2] * m[3] + m[4] * m[5]
    c = m[1] * m[1] + m[3] * m[3] + m[5] * m[5]
    middle, apart = 0.5 * (a + c), math.sqrt(0.25 * (a - c) ** 2 + b * b)
    return math.sqrt(middle + apart), math.sqrt(max(middle - apart, 0.0))


@cached()
def place(pairs, i, j):  # type: ignore[no-untyped-def]
    """Where a pair stands among pairs (m, 2) in ascending order; −1 if it does not."""
    lo, hi = 0, len(pairs)
    while lo < hi:
        at = (lo + hi) // 2
        if pairs[at, 0] < i or (pairs[at, 0] == i and pairs[at, 1] < j):
            lo = at + 1
        else:
            hi = at
    return lo if lo < len(pairs) and pairs[lo, 0] == i and pairs[lo, 1] == j else -1


@cached()
def needed(met, pairs, around, reached, places, needs):  # type: ignore[no-untyped-def]
    """Where pairs of patches met (n, 2) stand among ``pairs``, and which patches' gradients tell of them."""
    for n in range(len(met)):
        places[n] = place(pairs, met[n, 0], met[n, 1])
        if places[n] >= 0:
            for at in range(around[places[n]], around[places[n] + 1]):
                needs[reached[at]] = True


@cached()
def gradients(x, way, triangles, order, first, inverse, needs, mean, spread, least):  # type: ignore[no-untyped-def]
    """Q of each patch (P, 6), the mean deformation gradient, how far others are from it (P,), and σ(Q) (P,).

    Of points x (N, 3) [m] before and after their ways (N, 3) [m], and of patches that are needed (P,).
    """
    each = np.empty((2, SIZE, 6))
    for p in range(len(spread)):
        if not needs[p]:
            continue
        size = first[p + 1] - first[p]
        for at in range(size):
            number = order[first[p] + at]
            a, b, c = triangles[number]
            inv = inverse[number]
            for end in range(2):
                for k in range(3):
                    start = x[a, k] + end * way[a, k]
                    u, v = x[b, k] + end * way[b, k] - start, x[c, k] + end * way[c, k] - start
                    each[end, at, 2 * k] = u * inv[0, 0] + v * inv[1, 0]
                    each[end, at, 2 * k + 1] = u * inv[0, 1] + v * inv[1, 1]
        for k in range(6):
            total = 0.0
            for at in range(size):
                total += each[0, at, k] + each[1, at, k]
            mean[p, k] = 0.5 / size * total
        q = mean[p, 0], mean[p, 1], mean[p, 2], mean[p, 3], mean[p, 4], mean[p, 5]
        least[p] = _singular(q)[1]
        most = 0.0
        for end in range(2):
            for at in range(size):
                f = each[end, at]
                off = f[0] - q[0], f[1] - q[1], f[2] - q[2], f[3] - q[3], f[4] - q[4], f[5] - q[5]
                square = 0.0  # of the Frobenius norm, which is no less than the other
                for k in range(6):
                    square += off[k] * off[k]
                if square <= most * most:
                    continue
                apart = _singular(off)[0]
                if not apart <= most:  # or no number
                    most = apart
        spread[p] = most


@cached()
def distances_kept(place, least_reach, around, height, reached, i, mean, spread, least, out):  # type: ignore[no-untyped-def]
    """Distances (n,) [m] that simplices of pairs of patches, of which i (n,) are the first, surely keep.

    Of simplices without a common vertex. Where it may be less than ``least_reach`` [m] it is 0. ``place`` as
    of `needed`; ``mean``, ``spread`` and ``least`` as `gradients` gives them.
    """
    for n in range(len(place)):
        out[n] = 0.0
        lo = place[n]
        if lo < 0:
            continue
        q, enough = mean[i[n]], least[i[n]] - least_reach / height[lo]
        worst = 0.0
        for at in range(around[lo], around[lo + 1]):
            f, near = mean[reached[at]], spread[reached[at]]
            off = f[0] - q[0], f[1] - q[1], f[2] - q[2], f[3] - q[3], f[4] - q[4], f[5] - q[5]
            square = 0.0  # of the Frobenius norm, which is no less than the other
            for k in range(6):
                square += off[k] * off[k]
            if near <= worst and square <= (worst - near) ** 2:
                continue
            apart = near + _singular(off)[0]
            if not apart <= worst:  # or no number
                worst = apart
            if not worst <= enough:
                break
        if worst <= enough:
            out[n] = height[lo] * (least[i[n]] - worst)
