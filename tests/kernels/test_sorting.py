"""Sorting of rows, compared with numpy."""

from __future__ import annotations

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
