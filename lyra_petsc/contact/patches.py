"""Small patches of a surface, and a proof that neighbouring patches keep a distance.

A sheet that hardly bends cannot touch itself, and then its simplices need not be compared one by one. Let C
be a convex part of the material plane that no boundary edge of the sheet crosses, and let the deformation
gradients F on C differ from one matrix Q by at most s in the spectral norm. Then two points of C at a
distance d in the plane are at least (σ(Q) − s) d apart, where σ is the smallest singular value, because the
difference of their positions is the integral of F along the straight line between them. Simplices without a
common vertex are in the plane at least the smallest altitude of the triangles apart. As F changes linearly on
straight displacements of the vertices, it is sufficient to examine their start and end.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.contact.near import near_pairs
from lyra_petsc.kernels.cache import cached
from lyra_petsc.mesh.topology import connected_components, edge_table

MAX_TRIANGLES = 24
"""Triangles in a patch, at most."""

COORDINATE_TOLERANCE = 1e-9
"""Difference over the size of a patch up to which two coordinates are those of the same point."""


def split_into_patches(centres: Array, piece: Ints | None = None) -> Ints:
    """Numbers of patches (n,), from 0 on, of triangles with centres (n, d) [m], within pieces (n,).

    Each piece is halved repeatedly across its longest extent.
    """
    n = len(centres)
    patch = np.zeros(n, dtype=np.int64) if piece is None else np.unique(piece, return_inverse=True)[1]
    while n:
        order = np.argsort(patch, kind="stable")
        first = np.flatnonzero(np.diff(patch[order], prepend=-1))
        sizes = np.diff(first, append=n)
        if sizes.max() <= MAX_TRIANGLES:
            break
        sorted_centres = centres[order]
        extent = np.maximum.reduceat(sorted_centres, first) - np.minimum.reduceat(sorted_centres, first)
        coordinate = centres[np.arange(n), extent.argmax(axis=1)[patch]]
        order = np.lexsort((coordinate, patch))
        upper = np.arange(n) - np.repeat(first, sizes) >= np.repeat((sizes + 1) // 2, sizes)
        patch[order] = 2 * patch[order] + (upper & np.repeat(sizes > MAX_TRIANGLES, sizes))
        patch = np.unique(patch, return_inverse=True)[1]
    return patch.astype(np.int64)


class FlatPatches(NamedTuple):
    """Data for the proof, of a surface that is split into patches.

    Attributes
    ----------
    order, first : (F,), (P + 1,)
        Triangles patch by patch, and where those of each patch begin.
    inverse : (F, 2, 2)
        Inverse of the matrix of the two sides at the first corner of each triangle, in the material plane
        [1/m].
    neighbours : (k, 2)
        Pairs of neighbouring patches, or of a patch with itself: the lower number first, in ascending order.
    pairs : (m, 2)
        The neighbours with a region C: a box around both patches without boundary edges.
    around, height : (m + 1,), (m,)
        Where the patches that this region overlaps begin in ``reached``, and their smallest altitude [m].
    reached : (k,)
    """

    order: Ints
    first: Ints
    inverse: Array
    neighbours: Ints
    pairs: Ints
    around: Ints
    height: Array
    reached: Ints


def flat_patches(triangles: Ints, uv: Array, patch: Ints) -> FlatPatches:
    """Data for the proof, of triangles (F, 3) with material coordinates uv (F, 3, 2) [m] of their corners.

    No pairs are found where the coordinates of a vertex differ between its triangles (seams, curved
    surfaces).
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
    split = (-high - low).max(axis=1)[triangles].max(axis=1) > COORDINATE_TOLERANCE * longest
    altitude = np.where(split, 0.0, double / longest)  # negative if the corners are in clockwise order

    # (vertex, patch), each once, and from these the pairs of patches with a common vertex
    vertex_patches = np.unique(np.column_stack([corners, np.repeat(patch, 3)]), axis=0)
    begins = np.flatnonzero(np.diff(vertex_patches[:, 0], prepend=-1))
    sizes = np.diff(begins, append=len(vertex_patches))
    candidates = [np.repeat(np.arange(n)[:, None], 2, axis=1)]
    for step in range(1, int(sizes.max(initial=1))):
        rows = np.flatnonzero(np.arange(len(vertex_patches)) + step < np.repeat(begins + sizes, sizes))
        candidates.append(np.column_stack([vertex_patches[rows, 1], vertex_patches[rows + step, 1]]))
    pairs: Ints = np.unique(np.sort(np.concatenate(candidates), axis=1), axis=0)

    # boxes in the material plane, each sheet at a height of its own
    sheet = connected_components(n, pairs)
    lower = np.minimum.reduceat(uv.min(axis=1)[order], first[:-1]) if n else np.empty((0, 2))
    upper = np.maximum.reduceat(uv.max(axis=1)[order], first[:-1]) if n else np.empty((0, 2))
    boxes = np.column_stack([lower, sheet]), np.column_stack([upper, sheet])
    pairs, between = _add_second_neighbours(pairs, boxes, float(np.median(longest)) if n else 0.0)
    three = np.column_stack([pairs, between]).T
    regions = np.minimum.reduce(boxes[0][three]), np.maximum.reduce(boxes[1][three])
    table = edge_table(triangles)
    sides = table.sides[table.first[table.sizes == 1]]
    ends = uv[sides // 3, sides % 3], uv[sides // 3, (sides + 1) % 3]
    sheet_of = sheet[patch[sides // 3]]
    boundary_boxes = [np.column_stack([end, sheet_of]) for end in (np.minimum(*ends), np.maximum(*ends))]
    near_boundary = near_pairs(regions, (boundary_boxes[0], boundary_boxes[1]))
    segments = ends[0][near_boundary[:, 1]], ends[1][near_boundary[:, 1]]
    crosses = _cross_interior(*segments, *(part[near_boundary[:, 0], :2] for part in regions))
    kept = np.ones(len(pairs), dtype=np.bool_)
    kept[near_boundary[crosses, 0]] = False
    neighbours, regions, pairs = pairs, (regions[0][kept], regions[1][kept]), pairs[kept]
    reached_pairs = near_pairs(regions, boxes)
    reached_pairs = reached_pairs[np.lexsort(reached_pairs.T[::-1])]
    around = np.searchsorted(reached_pairs[:, 0], np.arange(len(pairs) + 1))
    lowest, highest = (of.reduceat(altitude[order], first[:-1]) for of in (np.minimum, np.maximum))
    lowest = np.minimum.reduceat(lowest[reached_pairs[:, 1]], around[:-1])
    highest = np.maximum.reduceat(highest[reached_pairs[:, 1]], around[:-1])
    height = np.maximum(lowest, -highest)  # negative unless all triangles have the same orientation
    usable, sizes = np.asarray(height > 0.0), np.diff(around)
    around = np.append(0, np.cumsum(sizes[usable]))
    reached = reached_pairs[np.repeat(usable, sizes), 1]
    return FlatPatches(order, first, inverse, neighbours, pairs[usable], around, height[usable], reached)


def _add_second_neighbours(pairs: Ints, boxes: tuple[Array, Array], radius: float) -> tuple[Ints, Ints]:
    """Pairs (m, 2) of patches with a common vertex, and pairs within ``radius`` [m] that have a common
    neighbour, in ascending order; and for each pair that neighbour, with the smallest box around all three.

    Patches without a common neighbour may be different turns of a spiral that overlap in the material plane.
    """
    n = len(boxes[0])
    close = near_pairs(boxes, radius=radius)
    close = close[~np.isin(close @ [n, 1], pairs @ [n, 1])]
    both = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
    begin = np.searchsorted(both[:, 0], np.arange(n + 1))
    sizes = np.diff(begin)[close[:, 0]]
    close_row = np.repeat(np.arange(len(close)), sizes)
    shift = np.repeat(begin[close[:, 0]] - np.cumsum(sizes) + sizes, sizes)
    between = both[np.arange(len(close_row)) + shift, 1]
    touches = np.isin(close[close_row, 1] * n + between, both @ [n, 1])
    close_row, between = close_row[touches], between[touches]
    three = np.column_stack([close[close_row], between]).T
    extent = (np.maximum.reduce(boxes[1][three]) - np.minimum.reduce(boxes[0][three])).max(axis=1)
    order = np.lexsort((extent, close_row))
    first = order[np.diff(close_row[order], prepend=-1) > 0]
    every = np.concatenate([pairs, close[close_row[first]]])
    others = np.concatenate([pairs[:, 0], between[first]])
    order = np.lexsort(every.T[::-1])
    return every[order], others[order]


def _cross_interior(a: Array, b: Array, low: Array, high: Array) -> Mask:
    """Whether segments a b (n, 2) cross the interior of boxes; running along a side does not count."""
    margin = COORDINATE_TOLERANCE * (high - low).max(axis=1, initial=0.0, keepdims=True)
    low, high, direction = low + margin, high - margin, b - a
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (low - a) / direction, (high - a) / direction
    parallel = direction == 0.0
    enters = np.where(parallel, np.where((a > low) & (a < high), -np.inf, np.inf), np.minimum(first, second))
    leaves = np.where(parallel, np.inf, np.maximum(first, second))
    return np.maximum(enters.max(axis=1, initial=0.0), 0.0) < np.minimum(leaves.min(axis=1, initial=1.0), 1.0)


@cached(inline="always")
def _singular_values(m):  # type: ignore[no-untyped-def]
    """Largest and smallest singular value of a matrix (3, 2), given as its six entries row by row."""
    a, b = m[0] * m[0] + m[2] * m[2] + m[4] * m[4], m[0] * m[1] + m[2] * m[3] + m[4] * m[5]
    c = m[1] * m[1] + m[3] * m[3] + m[5] * m[5]
    middle, radius = 0.5 * (a + c), math.sqrt(0.25 * (a - c) ** 2 + b * b)
    return math.sqrt(middle + radius), math.sqrt(max(middle - radius, 0.0))


@cached()
def find_pair(pairs, i, j):  # type: ignore[no-untyped-def]
    """Row of a pair in pairs (m, 2), which are in ascending order; −1 if it is not among them."""
    lo, hi = 0, len(pairs)
    while lo < hi:
        middle = (lo + hi) // 2
        if pairs[middle, 0] < i or (pairs[middle, 0] == i and pairs[middle, 1] < j):
            lo = middle + 1
        else:
            hi = middle
    return lo if lo < len(pairs) and pairs[lo, 0] == i and pairs[lo, 1] == j else -1


@cached()
def mark_needed(patch_pairs, pairs, first, reached, rows, needed):  # type: ignore[no-untyped-def]
    """Find the rows of patch_pairs (n, 2) among ``pairs``, and mark the patches whose gradients they need."""
    for n in range(len(patch_pairs)):
        rows[n] = find_pair(pairs, patch_pairs[n, 0], patch_pairs[n, 1])
        if rows[n] >= 0:
            for at in range(first[rows[n]], first[rows[n] + 1]):
                needed[reached[at]] = True


@cached()
def deformation_gradients(x, dx, triangles, order, first, inverse, needed, mean, spread, smallest):  # type: ignore[no-untyped-def]
    """Mean deformation gradient Q (P, 6) of each patch, the largest deviation from it (P,), and σ(Q) (P,).

    Over points x (N, 3) [m] before and after displacements dx (N, 3) [m], for the patches that are needed
    (P,).
    """
    f = np.empty((2, MAX_TRIANGLES, 6))
    for p in range(len(spread)):
        if not needed[p]:
            continue
        size = first[p + 1] - first[p]
        for at in range(size):
            number = order[first[p] + at]
            a, b, c = triangles[number]
            inv = inverse[number]
            for end in range(2):
                for k in range(3):
                    start = x[a, k] + end * dx[a, k]
                    u, v = x[b, k] + end * dx[b, k] - start, x[c, k] + end * dx[c, k] - start
                    f[end, at, 2 * k] = u * inv[0, 0] + v * inv[1, 0]
                    f[end, at, 2 * k + 1] = u * inv[0, 1] + v * inv[1, 1]
        for k in range(6):
            total = 0.0
            for at in range(size):
                total += f[0, at, k] + f[1, at, k]
            mean[p, k] = 0.5 / size * total
        q = mean[p, 0], mean[p, 1], mean[p, 2], mean[p, 3], mean[p, 4], mean[p, 5]
        smallest[p] = _singular_values(q)[1]
        largest = 0.0
        for end in range(2):
            for at in range(size):
                fe = f[end, at]
                difference = (
                    fe[0] - q[0],
                    fe[1] - q[1],
                    fe[2] - q[2],
                    fe[3] - q[3],
                    fe[4] - q[4],
                    fe[5] - q[5],
                )
                square = 0.0  # of the Frobenius norm, an upper bound of the spectral norm
                for k in range(6):
                    square += difference[k] * difference[k]
                if square <= largest * largest:
                    continue
                norm = _singular_values(difference)[0]
                if not norm <= largest:  # also if NaN
                    largest = norm
        spread[p] = largest


@cached()
def distance_bounds(rows, radius, first, height, reached, i, mean, spread, smallest, out):  # type: ignore[no-untyped-def]
    """Lower bounds (n,) [m] of the distances of simplices without a common vertex, for pairs of patches in
    ``rows`` (n,), of which i (n,) are the first patches; 0 if the bound is below ``radius`` [m].

    ``rows`` as from `mark_needed`; ``mean``, ``spread`` and ``smallest`` as from `deformation_gradients`.
    """
    for n in range(len(rows)):
        out[n] = 0.0
        row = rows[n]
        if row < 0:
            continue
        q, enough = mean[i[n]], smallest[i[n]] - radius / height[row]
        largest = 0.0
        for at in range(first[row], first[row + 1]):
            f, spread_j = mean[reached[at]], spread[reached[at]]
            difference = f[0] - q[0], f[1] - q[1], f[2] - q[2], f[3] - q[3], f[4] - q[4], f[5] - q[5]
            square = 0.0  # of the Frobenius norm, an upper bound of the spectral norm
            for k in range(6):
                square += difference[k] * difference[k]
            if spread_j <= largest and square <= (largest - spread_j) ** 2:
                continue
            norm = spread_j + _singular_values(difference)[0]
            if not norm <= largest:  # also if NaN
                largest = norm
            if not largest <= enough:
                break
        if largest <= enough:
            out[n] = height[row] * (smallest[i[n]] - largest)
