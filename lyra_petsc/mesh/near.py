"""Which boxes are near each other: the broad phase of searches for contacts."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import cached

MOST_CELLS = 1 << 22


@cached()
def _cell(place, origin, size, n):  # type: ignore[no-untyped-def]
    """The number of the cell that holds a coordinate, or of the nearest one of n."""
    # of a plane that is one but for rounding, farther cells than whole numbers can count
    return int(min(max((place - origin) / size, 0.0), n - 1.0))


@cached()
def _swept(x, way, simplices, low, high):  # type: ignore[no-untyped-def]
    for s in range(len(simplices)):
        for k in range(3):
            least = most = x[simplices[s, 0], k]
            for i in range(simplices.shape[1]):
                at = x[simplices[s, i], k]
                to = at + way[simplices[s, i], k]
                least, most = min(least, at, to), max(most, at, to)
            low[s, k], high[s, k] = least, most


def swept_boxes(x: Array, way: Array, simplices: Ints) -> tuple[Array, Array]:
    """Low and high corners (n, 3) [m] of what simplices (n, m) of points x pass on their ways (N, 3) [m]."""
    low, high = np.empty((len(simplices), 3)), np.empty((len(simplices), 3))
    _swept(x, way, simplices, low, high)
    return low, high


@cached()
def _of_boxes(low, high, origin, size, n):  # type: ignore[no-untyped-def]
    """The first and the last cell (k, 2, 3) that boxes reach into."""
    out = np.empty((len(low), 2, 3), np.int32)
    for b in range(len(low)):
        for k in range(3):
            out[b, 0, k] = _cell(low[b, k], origin[k], size[k], n[k])
            out[b, 1, k] = _cell(high[b, k], origin[k], size[k], n[k])
    return out


@cached()
def _sort(cells, n, first, items, fill):  # type: ignore[no-untyped-def]
    """Count the boxes of each cell into first (cells + 1,), or put them into ``items`` from there on."""
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
def _pairs(low, high, others, reach, cells, other_cells, n, same, first, items, out):  # type: ignore[no-untyped-def]
    """Write near pairs into out (m, 2) as far as there is room; returns how many there are.

    The others, low and high corners (2, k, 3), stand in cells of a grid: ``first`` (cells + 1,) and
    ``items``. A pair is found in the first cell that both have.
    """
    found, square = 0, reach * reach
    for a in range(len(low)):
        for i in range(cells[a, 0, 0], cells[a, 1, 0] + 1):
            for j in range(cells[a, 0, 1], cells[a, 1, 1] + 1):
                for k in range(cells[a, 0, 2], cells[a, 1, 2] + 1):
                    cell = (i * n[1] + j) * n[2] + k
                    for at in range(first[cell], first[cell + 1]):
                        b = items[at]
                        if (
                            (same and b <= a)
                            or i != max(cells[a, 0, 0], other_cells[b, 0, 0])
                            or j != max(cells[a, 0, 1], other_cells[b, 0, 1])
                            or k != max(cells[a, 0, 2], other_cells[b, 0, 2])
                        ):
                            continue
                        left = square
                        for m in range(3):
                            apart = max(others[0, b, m] - high[a, m], low[a, m] - others[1, b, m], 0.0)
                            left -= apart * apart
                        if left < 0.0:
                            continue
                        if found < len(out):
                            out[found, 0], out[found, 1] = a, b
                        found += 1
    return found


def near(
    boxes: tuple[Array, Array], others: tuple[Array, Array] | None = None, *, reach: float = 0.0
) -> Ints:
    """Pairs (m, 2) of boxes and other boxes at most ``reach`` [m] apart.

    Parameters
    ----------
    boxes, others : pairs of (n, 3), (k, 3)
        Their low and high corners [m]. Without others the boxes themselves; the lesser number is first.
    """
    same = others is None
    low, high = boxes
    other_low, other_high = boxes if others is None else others
    if not len(low) or not len(other_low):
        return np.empty((0, 2), dtype=np.int64)
    origin, end = other_low.min(axis=0), other_high.max(axis=0)
    extent = np.maximum(end - origin, 1e-300)
    size = np.maximum((other_high - other_low).mean(axis=0) + reach, extent * 1e-6)
    n = np.maximum(extent / size, 1.0)
    while np.prod(np.floor(n)) > min(MOST_CELLS, 8 * len(other_low) + 64):
        n[np.argmax(n)] *= 0.5
    n = np.floor(n).astype(np.int64)
    size = extent / n
    other_cells = _of_boxes(other_low, other_high, origin, size, n)
    cells = _of_boxes(low - reach, high + reach, origin, size, n)
    first = np.zeros(int(np.prod(n)) + 1, dtype=np.int64)
    _sort(other_cells, n, first, np.empty(0, dtype=np.int64), False)
    np.cumsum(first, out=first)
    items = np.empty(first[-1], dtype=np.int64)
    at = first[:-1].copy()
    _sort(other_cells, n, at, items, True)
    out = np.empty((4 * len(low) + 64, 2), dtype=np.int64)
    stacked = np.stack([other_low, other_high])
    given = low, high, stacked, reach, cells, other_cells, n, same, first, items
    found = _pairs(*given, out)
    if found > len(out):
        out = np.empty((found, 2), dtype=np.int64)
        _pairs(*given, out)
    return out[:found]


@cached()
def _of_tree(low, high, reach, tree, out):  # type: ignore[no-untyped-def]
    """Write near pairs into out (m, 2) as far as there is room; returns how many there are.

    ``tree`` (2 k, 2, 3), k a power of 2 from len(low) on, takes boxes around pairs of boxes, pairs of these …
    """
    leaves, found, square = len(tree) // 2, 0, reach * reach
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
            left = square
            for k in range(3):
                apart = max(tree[i, 0, k] - tree[j, 1, k], tree[j, 0, k] - tree[i, 1, k], 0.0)
                left -= apart * apart
            if not left >= 0.0:
                continue
        if i >= leaves:
            if i != j:
                if found < len(out):
                    out[found, 0], out[found, 1] = i - leaves, j - leaves
                found += 1
            continue
        for one in range(2):
            for other in range(one if i == j else 0, 2):
                stack[open_pairs, 0], stack[open_pairs, 1] = 2 * i + one, 2 * j + other
                open_pairs += 1
    return found


def near_in_order(low: Array, high: Array, reach: float) -> Ints:
    """Pairs (m, 2) of boxes with corners (n, 3) [m] at most ``reach`` [m] apart, the lesser number first.

    Fast where boxes with neighbouring numbers are neighbours in space.
    """
    tree = np.empty((2 << max(len(low) - 1, 0).bit_length(), 2, 3))
    out = np.empty((8 * len(low), 2), dtype=np.int64)
    while True:
        found = _of_tree(low, high, reach, tree, out)
        if found <= len(out):
            return out[:found]
        out = np.empty((found, 2), dtype=np.int64)
