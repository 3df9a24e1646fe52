"""Which boxes overlap: the broad phase of searches for contacts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.kernels.cache import cached

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_CELLS = 1 << 22


@cached()
def _cell(place, origin, size, n):  # type: ignore[no-untyped-def]
    """Which of n cells a coordinate is in, or nearest to."""
    # of a plane that is one but for rounding, farther cells than whole numbers can count
    return int(min(max((place - origin) / size, 0.0), n - 1.0))


@cached()
def _pairs(low, high, other_low, other_high, origin, size, n, same, first, items, out):  # type: ignore[no-untyped-def]
    """Overlapping pairs into out (m, 2), of which only as many are written as fit; how many there are.

    The others stand in the cells of a grid: ``first`` (cells + 1,) and ``items``. A pair is found in the
    first cell that both have.
    """
    found = 0
    lo, hi, other = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    for a in range(len(low)):
        for k in range(3):
            lo[k] = _cell(low[a, k], origin[k], size[k], n[k])
            hi[k] = _cell(high[a, k], origin[k], size[k], n[k])
        for i in range(lo[0], hi[0] + 1):
            for j in range(lo[1], hi[1] + 1):
                for k in range(lo[2], hi[2] + 1):
                    cell = (i * n[1] + j) * n[2] + k
                    for at in range(first[cell], first[cell + 1]):
                        b = items[at]
                        if same and b <= a:
                            continue
                        apart = False
                        for m in range(3):
                            if other_low[b, m] > high[a, m] or other_high[b, m] < low[a, m]:
                                apart = True
                        if apart:
                            continue
                        for m in range(3):
                            other[m] = _cell(other_low[b, m], origin[m], size[m], n[m])
                        if (
                            i == max(lo[0], other[0])
                            and j == max(lo[1], other[1])
                            and k == max(lo[2], other[2])
                        ):
                            if found < len(out):
                                out[found, 0], out[found, 1] = a, b
                            found += 1
    return found


@cached()
def _cells(low, high, origin, size, n, first, items, fill):  # type: ignore[no-untyped-def]
    """Count the boxes of each cell into first (cells + 1,), or put them into ``items`` from there on."""
    for b in range(len(low)):
        lo0 = _cell(low[b, 0], origin[0], size[0], n[0])
        lo1 = _cell(low[b, 1], origin[1], size[1], n[1])
        lo2 = _cell(low[b, 2], origin[2], size[2], n[2])
        hi0 = _cell(high[b, 0], origin[0], size[0], n[0])
        hi1 = _cell(high[b, 1], origin[1], size[1], n[1])
        hi2 = _cell(high[b, 2], origin[2], size[2], n[2])
        for i in range(lo0, hi0 + 1):
            for j in range(lo1, hi1 + 1):
                for k in range(lo2, hi2 + 1):
                    cell = (i * n[1] + j) * n[2] + k
                    if fill:
                        items[first[cell]] = b
                        first[cell] += 1
                    else:
                        first[cell + 1] += 1


def overlapping(low: Array, high: Array, other: tuple[Array, Array] | None = None) -> Ints:
    """Pairs (m, 2) of boxes ``low``, ``high`` (n, 3) and ``other`` ones, (k, 3) each, that overlap or touch.

    Without ``other`` among themselves, the lesser number first.
    """
    same = other is None
    other_low, other_high = (low, high) if other is None else other
    if not len(low) or not len(other_low):
        return np.empty((0, 2), dtype=np.int64)
    origin, end = other_low.min(axis=0), other_high.max(axis=0)
    extent = np.maximum(end - origin, 1e-300)
    size = np.maximum((other_high - other_low).mean(axis=0), extent * 1e-6)
    n = np.maximum(extent / size, 1.0)
    while np.prod(np.floor(n)) > min(MOST_CELLS, 8 * len(other_low) + 64):
        n[np.argmax(n)] *= 0.5
    n = np.floor(n).astype(np.int64)
    size = extent / n
    first = np.zeros(int(np.prod(n)) + 1, dtype=np.int64)
    _cells(other_low, other_high, origin, size, n, first, np.empty(0, dtype=np.int64), False)
    np.cumsum(first, out=first)
    items = np.empty(first[-1], dtype=np.int64)
    at = first[:-1].copy()
    _cells(other_low, other_high, origin, size, n, at, items, True)
    out = np.empty((8 * len(low) + 64, 2), dtype=np.int64)
    rest = low, high, other_low, other_high, origin, size, n, same, first, items
    found = _pairs(*rest, out)
    if found > len(out):
        out = np.empty((found, 2), dtype=np.int64)
        _pairs(*rest, out)
    return out[:found]
