"""Sorting of rows, compared with numpy."""

from __future__ import annotations

import time

import numpy as np

from lyra_petsc.kernels.sorting import sort_rows


def test_rows_are_in_lexicographic_order() -> None:
    rng = np.random.default_rng(0)
    rows = rng.integers(-1, 3, (400, 5))
    which = rng.permutation(400)[:300]
    found = sort_rows(which, rows)
    expected = which[np.lexsort(rows[which].T[::-1])]
    np.testing.assert_array_equal(rows[found], rows[expected])
    assert set(found) == set(which)


def test_sorting_time_of_equal_first_numbers_grows_nearly_linearly() -> None:
    """As in searches of sheets that pass through each other completely."""
    rng, spent = np.random.default_rng(0), []
    for rows in (2_000, 2_000, 16_000):  # the first compiles
        keys = rng.permutation(rows)[:, None] * np.array([0, 1])
        begin = time.process_time()
        found = sort_rows(np.arange(rows), keys)
        spent.append(time.process_time() - begin)
        np.testing.assert_array_equal(keys[found, 1], np.arange(rows))
    assert spent[2] < 32.0 * max(spent[1], 2e-4)  # by insertion 64 times
