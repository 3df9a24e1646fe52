"""Lexicographic order of rows of numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import cached

FEW = 16
"""Number of rows up to which rows with the same number in the first column are sorted by insertion."""


def sort_rows(rows: Ints, first: NDArray[np.int64], second: Array, n_columns: int) -> Ints:
    """The numbers ``rows`` (m,) in lexicographic order of these rows of ``first`` (n, p), and then of the
    first ``n_columns`` of ``second`` (n, q).
    """
    order: Ints = rows[np.argsort(first[rows, 0], kind="stable")]
    _sort_runs(order, np.empty_like(order), first, second, min(n_columns, second.shape[1]))
    return order


@cached()
def _is_before(a, b, first, second, n_columns):  # type: ignore[no-untyped-def]
    """Whether row a precedes row b, without the first column."""
    for k in range(1, first.shape[1]):
        if first[a, k] != first[b, k]:
            return first[a, k] < first[b, k]
    for k in range(n_columns):
        if second[a, k] != second[b, k]:
            return second[a, k] < second[b, k]
    return False


@cached()
def _sort_runs(order, spare, first, second, n_columns):  # type: ignore[no-untyped-def]
    """Sort runs of rows with the same number in the first column; ``spare`` is as long as ``order``."""
    begin, n = 0, len(order)
    while begin < n:
        end = begin + 1
        while end < n and first[order[end], 0] == first[order[begin], 0]:
            end += 1
        for low in range(begin, end, FEW):
            _insert(order, low, min(low + FEW, end), first, second, n_columns)
        width = FEW
        while width < end - begin:
            for low in range(begin, end - width, 2 * width):
                high = min(low + 2 * width, end)
                _merge(order, spare, low, low + width, high, first, second, n_columns)
            width *= 2
        begin = end


@cached()
def _insert(order, begin, end, first, second, n_columns):  # type: ignore[no-untyped-def]
    """Sort the rows from begin to end by insertion."""
    for m in range(begin + 1, end):
        row, i = order[m], m
        while i > begin and _is_before(row, order[i - 1], first, second, n_columns):
            order[i] = order[i - 1]
            i -= 1
        order[i] = row


@cached()
def _merge(order, spare, begin, middle, end, first, second, n_columns):  # type: ignore[no-untyped-def]
    """Merge two sorted parts."""
    a, b = begin, middle
    for place in range(begin, end):
        if b >= end or (a < middle and not _is_before(order[b], order[a], first, second, n_columns)):
            spare[place], a = order[a], a + 1
        else:
            spare[place], b = order[b], b + 1
    # not a slice: numba would compile its error message, too, which takes longer than all else here
    for place in range(begin, end):
        order[place] = spare[place]
