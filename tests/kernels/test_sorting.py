"""Sorting of rows, compared with numpy."""

from __future__ import annotations

import time

import numpy as np

from lyra_petsc.kernels.sorting import sort_rows


def test_rows_are_in_the_order_of_both_tables() -> None:
    rng = np.random.default_rng(0)
    first, then = rng.integers(0, 3, (400, 2)), rng.integers(-1, 3, (400, 5)).astype(np.float64)
    which = rng.permutation(400)[:300]
    found = sort_rows(which, first, then, 3)
    expected = which[np.lexsort((*then[which, :3].T[::-1], *first[which].T[::-1]))]
    rows = np.column_stack([first, then[:, :3]])
    np.testing.assert_array_equal(rows[found], rows[expected])
    assert set(found) == set(which)


def test_sorting_time_of_equal_first_numbers_grows_nearly_linearly() -> None:
    """As in searches of sheets that pass through each other completely."""
    rng, spent = np.random.default_rng(0), []
    for rows in (2_000, 2_000, 16_000):  # the first compiles
        first, then = rng.permutation(rows)[:, None] * np.array([0, 1]), np.zeros((rows, 1))
        begin = time.process_time()
        found = sort_rows(np.arange(rows), first, then, 1)
        spent.append(time.process_time() - begin)
        np.testing.assert_array_equal(first[found, 1], np.arange(rows))
    assert spent[2] < 32.0 * max(spent[1], 2e-4)  # by insertion 64 times
