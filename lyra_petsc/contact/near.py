"""Pairs of axis-parallel boxes near each other: the broad phase of searches for contacts."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import cached, inner

MAX_CELLS = 1 << 22
"""Cells of the grid, at most."""


@inner()
def _cell(coordinate, origin, size, n):  # type: ignore[no-untyped-def]
    """Number of the cell that contains a coordinate, or of the nearest one of n."""
    # in a box that is flat except for rounding, cell numbers may exceed the range of integers
    return int(min(max((coordinate - origin) / size, 0.0), n - 1.0))


@cached()
def _swept(x, dx, simplices, low, high):  # type: ignore[no-untyped-def]
    for s in range(len(simplices)):
        for k in range(3):
            smallest = largest = x[simplices[s, 0], k]
            for i in range(simplices.shape[1]):
                start = x[simplices[s, i], k]
                end = start + dx[simplices[s, i], k]
                smallest, largest = min(smallest, start, end), max(largest, start, end)
            low[s, k], high[s, k] = smallest, largest


def swept_boxes(x: Array, dx: Array, simplices: Ints) -> tuple[Array, Array]:
    """Low and high corners (n, 3) [m] of the boxes around simplices (n, m) on displacements dx (N, 3) [m] of
    points x.
    """
    low, high = np.empty((len(simplices), 3)), np.empty((len(simplices), 3))
    _swept(x, dx, simplices, low, high)
    return low, high


@cached()
def _cell_ranges(low, high, origin, size, n):  # type: ignore[no-untyped-def]
    """First and last cell (k, 2, 3) that each box overlaps."""
    out = np.empty((len(low), 2, 3), np.int32)
    for b in range(len(low)):
        for k in range(3):
            out[b, 0, k] = _cell(low[b, k], origin[k], size[k], n[k])
            out[b, 1, k] = _cell(high[b, k], origin[k], size[k], n[k])
    return out


@cached()
def _fill_cells(cells, n, first, items, fill):  # type: ignore[no-untyped-def]
    """Count the boxes of each cell in first (cells + 1,); with ``fill`` write their numbers to ``items``,
    from first on.
    """
    for b in range(len(cells)):
        for i in range(cells[b, 0, 0], cells[b, 1, 0] + 1):
            for j in range(cells[b, 0, 1], cells[b, 1, 1] + 1):
                for k in range(cells[b, 0, 2], cells[b, 1, 2] + 1):
                    cell = (i * n[1] + j) * n[2] + k
                    if fill:
                        items[first[cell]] = b
                        first[cell] += 1
                    else:
                        first[cell + 1] += 1


@cached()
def _find_pairs(low, high, others, cells, other_cells, n, first, items, out):  # type: ignore[no-untyped-def]
    """Write near pairs to out (m, 2), as many as fit; returns their number.

    The others, low and high corners (2, k, 3), are in cells of a grid: ``first`` (cells + 1,) and ``items``.
    A pair is found in the first cell that both overlap.
    """
    n_found = 0
    for a in range(len(low)):
        for i in range(cells[a, 0, 0], cells[a, 1, 0] + 1):
            for j in range(cells[a, 0, 1], cells[a, 1, 1] + 1):
                for k in range(cells[a, 0, 2], cells[a, 1, 2] + 1):
                    cell = (i * n[1] + j) * n[2] + k
                    for at in range(first[cell], first[cell + 1]):
                        b = items[at]
                        if (
                            i != max(cells[a, 0, 0], other_cells[b, 0, 0])
                            or j != max(cells[a, 0, 1], other_cells[b, 0, 1])
                            or k != max(cells[a, 0, 2], other_cells[b, 0, 2])
                        ):
                            continue
                        apart = False
                        for m in range(3):
                            apart |= others[0, b, m] > high[a, m] or low[a, m] > others[1, b, m]
                        if apart:
                            continue
                        if n_found < len(out):
                            out[n_found, 0], out[n_found, 1] = a, b
                        n_found += 1
    return n_found


def overlapping_pairs(boxes: tuple[Array, Array], others: tuple[Array, Array]) -> Ints:
    """Pairs (m, 2) of boxes and others that overlap, by a grid.

    Each are low and high corners [m], (n, 3) and (k, 3).
    """
    low, high = boxes
    other_low, other_high = others
    if not len(low) or not len(other_low):
        return np.empty((0, 2), dtype=np.int64)
    origin, end = other_low.min(axis=0), other_high.max(axis=0)
    extent = np.maximum(end - origin, 1e-300)
    size = np.maximum((other_high - other_low).mean(axis=0), extent * 1e-6)
    n = np.maximum(extent / size, 1.0)
    while np.prod(np.floor(n)) > min(MAX_CELLS, 8 * len(other_low) + 64):
        n[np.argmax(n)] *= 0.5
    n = np.floor(n).astype(np.int64)
    size = extent / n
    other_cells = _cell_ranges(other_low, other_high, origin, size, n)
    cells = _cell_ranges(low, high, origin, size, n)
    first = np.zeros(int(np.prod(n)) + 1, dtype=np.int64)
    _fill_cells(other_cells, n, first, np.empty(0, dtype=np.int64), False)
    np.cumsum(first, out=first)
    items = np.empty(first[-1], dtype=np.int64)
    next_item = first[:-1].copy()
    _fill_cells(other_cells, n, next_item, items, True)
    out = np.empty((4 * len(low) + 64, 2), dtype=np.int64)
    stacked = np.stack([other_low, other_high])
    arguments = low, high, stacked, cells, other_cells, n, first, items
    n_found = _find_pairs(*arguments, out)
    if n_found > len(out):
        out = np.empty((n_found, 2), dtype=np.int64)
        _find_pairs(*arguments, out)
    return out[:n_found]


@cached()
def _find_pairs_by_tree(low, high, radius, tree, out):  # type: ignore[no-untyped-def]
    """Write near pairs to out (m, 2), as many as fit; returns their number.

    ``tree`` (2 k, 2, 3), with k a power of 2 not below len(low), is overwritten by the boxes around pairs of
    boxes, around pairs of these, and so on.
    """
    leaves, n_found, square = len(tree) // 2, 0, radius * radius
    for b in range(leaves):
        for k in range(3):
            tree[leaves + b, 0, k] = low[b, k] if b < len(low) else np.inf
            tree[leaves + b, 1, k] = high[b, k] if b < len(low) else -np.inf
    for b in range(leaves - 1, 0, -1):
        for k in range(3):
            tree[b, 0, k] = min(tree[2 * b, 0, k], tree[2 * b + 1, 0, k])
            tree[b, 1, k] = max(tree[2 * b, 1, k], tree[2 * b + 1, 1, k])
    stack = np.empty((256, 2), np.int64)  # four for each of at most 64 levels
    stack[0], open_pairs = 1, 1
    while open_pairs:
        open_pairs -= 1
        i, j = stack[open_pairs]
        if i != j:
            margin = square
            for k in range(3):
                distance = max(tree[i, 0, k] - tree[j, 1, k], tree[j, 0, k] - tree[i, 1, k], 0.0)
                margin -= distance * distance
            if not margin >= 0.0:
                continue
        if i >= leaves:
            if i != j:
                if n_found < len(out):
                    out[n_found, 0], out[n_found, 1] = i - leaves, j - leaves
                n_found += 1
            continue
        for one in range(2):
            for other in range(one if i == j else 0, 2):
                stack[open_pairs, 0], stack[open_pairs, 1] = 2 * i + one, 2 * j + other
                open_pairs += 1
    return n_found


def near_pairs_by_tree(low: Array, high: Array, radius: float) -> Ints:
    """Pairs (m, 2) of boxes with corners (n, 3) [m] at most ``radius`` [m] apart, the lower number first.

    Fast if boxes with neighbouring numbers are neighbours in space.
    """
    tree = np.empty((2 << max(len(low) - 1, 0).bit_length(), 2, 3))
    out = np.empty((8 * len(low), 2), dtype=np.int64)
    while True:
        n_found = _find_pairs_by_tree(low, high, radius, tree, out)
        if n_found <= len(out):
            return out[:n_found]
        out = np.empty((n_found, 2), dtype=np.int64)
