"""The ascending order of rows of numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Ints
from lyra_petsc.kernels.cache import cached


def ascending(which: Ints, first: NDArray[np.int64], then: NDArray[np.generic], columns: int) -> Ints:
    """Numbers ``which`` (m,) of rows in the order of what stands in ``first`` (n, p), column by column, and
    in the first ``columns`` of ``then`` (n, q).

    Meant for few rows with the same number in the first column: it takes those one by one.
    """
    order: Ints = which[np.argsort(first[which, 0], kind="stable")]
    _sort_runs(order, first, then, min(columns, then.shape[1]))
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
def _sort_runs(order, first, then, columns):  # type: ignore[no-untyped-def]
    """Sort those next to each other with the same number in the first column, by insertion."""
    begin = 0
    for m in range(1, len(order)):
        row = order[m]
        if first[row, 0] != first[order[begin], 0]:
            begin = m
            continue
        place = m
        while place > begin and _is_before(row, order[place - 1], first, then, columns):
            order[place] = order[place - 1]
            place -= 1
        order[place] = row
