"""The ascending order of rows of numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Ints
from lyra_petsc.kernels.cache import cached

FEW = 16
"""Rows with the same number in the first column up to which they are sorted by insertion."""


def ascending(which: Ints, first: NDArray[np.int64], then: NDArray[np.generic], columns: int) -> Ints:
    """Numbers ``which`` (m,) of rows in the order of what stands in ``first`` (n, p), column by column, and
    in the first ``columns`` of ``then`` (n, q).
    """
    order: Ints = which[np.argsort(first[which, 0], kind="stable")]
    _sort_runs(order, np.empty_like(order), first, then, min(columns, then.shape[1]))
    return order


@cached()
def _is_before(a, b, first, then, columns):  # type: ignore[no-untyped-def]
    """Whether row a must stand before row b."""
    for k in range(1, first.shape[1]):
        if first[a, k] != first[b, k]:
            return first[a, k] < first[b, k]
    for k in range(columns):
        if then[a, k] != then[b, k]:
            return then[a, k] < then[b, k]
    return False


@cached()
def _sort_runs(order, spare, first, then, columns):  # type: ignore[no-untyped-def]
    """Sort those next to each other with the same number in the first column; ``spare`` is as long."""
    begin, n = 0, len(order)
    while begin < n:
        end = begin + 1
        while end < n and first[order[end], 0] == first[order[begin], 0]:
            end += 1
        for low in range(begin, end, FEW):
            _insert(order, low, min(low + FEW, end), first, then, columns)
        width = FEW
        while width < end - begin:
            for low in range(begin, end - width, 2 * width):
                high = min(low + 2 * width, end)
                _merge(order, spare, low, low + width, high, first, then, columns)
            width *= 2
        begin = end


@cached()
def _insert(order, begin, end, first, then, columns):  # type: ignore[no-untyped-def]
    """Sort few of them by insertion."""
    for m in range(begin + 1, end):
        row, place = order[m], m
        while place > begin and _is_before(row, order[place - 1], first, then, columns):
            order[place] = order[place - 1]
            place -= 1
        order[place] = row


@cached()
def _merge(order, spare, begin, middle, end, first, then, columns):  # type: ignore[no-untyped-def]
    """Let two parts that are in order be one."""
    a, b = begin, middle
    for place in range(begin, end):
        if b >= end or (a < middle and not _is_before(order[b], order[a], first, then, columns)):
            spare[place], a = order[a], a + 1
        else:
            spare[place], b = order[b], b + 1
    order[begin:end] = spare[begin:end]
