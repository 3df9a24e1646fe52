"""Small patches of a surface, and which of them are neighbours."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Ints

MAX_TRIANGLES = 24
"""Triangles in a patch, at most."""


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


def neighbouring_patches(triangles: Ints, uv: Array, patch: Ints) -> Ints:
    """Pairs of patches of triangles (F, 3) that have a common vertex, or a common neighbour less than an edge
    apart in the material plane, (k, 2), the lower number first, in ascending order; with pairs of each patch
    and itself.

    ``uv`` (F, 3, 2) [m] are the material coordinates of the triangles' corners.
    """
    n = int(patch.max(initial=-1)) + 1
    if n == 0:
        return np.empty((0, 2), dtype=np.int64)
    low, high = np.full((2, n, 2), np.inf)
    np.minimum.at(low, patch, uv.min(axis=1))
    np.minimum.at(high, patch, -uv.max(axis=1))
    edge = float(np.median(np.linalg.norm(uv - np.roll(uv, 1, axis=1), axis=2).max(axis=1)))
    corners = np.unique(np.column_stack([triangles.ravel(), np.repeat(patch, 3)]), axis=0)
    touching = _joined(corners, corners)
    beyond = _joined(touching, touching)
    one, other = beyond.T
    apart = np.maximum(low[other] + high[one], low[one] + high[other]).max(axis=1)
    pairs = np.concatenate([touching, beyond[apart <= edge]])
    return np.asarray(np.unique(pairs[pairs[:, 0] <= pairs[:, 1]], axis=0))


def _joined(first: Ints, second: Ints) -> Ints:
    """All (b, d) of rows (a, b) of the first and (a, d) of the second, whose columns a ascend, each once."""
    begin, end = (np.searchsorted(second[:, 0], first[:, 0], side=side) for side in ("left", "right"))
    sizes = end - begin
    rows = np.repeat(begin - np.cumsum(sizes) + sizes, sizes) + np.arange(int(sizes.sum()))
    return np.unique(np.column_stack([np.repeat(first[:, 1], sizes), second[rows, 1]]), axis=0)
