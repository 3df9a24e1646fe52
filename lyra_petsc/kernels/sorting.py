"""Lexicographic order of rows of numbers."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Ints
from lyra_petsc.kernels.cache import cached, inner

INSERTED = 16
"""Number of rows up to which rows with the same number in the first column are sorted by insertion."""


def sort_rows(rows: Ints, keys: Ints) -> Ints:
    """The numbers ``rows`` (m,) in lexicographic order of these rows of ``keys`` (n, p)."""
    order: Ints = rows[np.argsort(keys[rows, 0], kind="stable")]
    _sort_runs(order, np.empty_like(order), keys)
    return order


@inner()
def _is_before(a, b, keys):  # type: ignore[no-untyped-def]
    """Whether row a precedes row b, without the first column."""
    for k in range(1, keys.shape[1]):
        if keys[a, k] != keys[b, k]:
            return keys[a, k] < keys[b, k]
    return False


@cached()
def _sort_runs(order, spare, keys):  # type: ignore[no-untyped-def]
    """Sort runs of rows with the same number in the first column; ``spare`` is as long as ``order``."""
    begin, n = 0, len(order)
    while begin < n:
        end = begin + 1
        while end < n and keys[order[end], 0] == keys[order[begin], 0]:
            end += 1
        for low in range(begin, end, INSERTED):
            _insert(order, low, min(low + INSERTED, end), keys)
        width = INSERTED
        while width < end - begin:
            for low in range(begin, end - width, 2 * width):
                high = min(low + 2 * width, end)
                _merge(order, spare, low, low + width, high, keys)
            width *= 2
        begin = end


@inner()
def _insert(order, begin, end, keys):  # type: ignore[no-untyped-def]
    """Sort the rows from begin to end by insertion."""
    for m in range(begin + 1, end):
        row, i = order[m], m
        while i > begin and _is_before(row, order[i - 1], keys):
            order[i] = order[i - 1]
            i -= 1
        order[i] = row


@inner()
def _merge(order, spare, begin, middle, end, keys):  # type: ignore[no-untyped-def]
    """Merge two sorted parts."""
    a, b = begin, middle
    for place in range(begin, end):
        if b >= end or (a < middle and not _is_before(order[b], order[a], keys)):
            spare[place], a = order[a], a + 1
        else:
            spare[place], b = order[b], b + 1
    # not a slice: numba would compile its error message, too, which takes longer than all else here
    for place in range(begin, end):
        order[place] = spare[place]
