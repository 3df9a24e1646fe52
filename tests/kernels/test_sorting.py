"""The order of rows against numpy's."""

from __future__ import annotations

import numpy as np

from lyra_petsc.kernels.sorting import ascending


def test_rows_are_in_the_order_of_both_tables() -> None:
    rng = np.random.default_rng(0)
    first, then = rng.integers(0, 3, (400, 2)), rng.integers(-1, 3, (400, 5)).astype(np.float64)
    which = rng.permutation(400)[:300]
    found = ascending(which, first, then, 3)
    expected = which[np.lexsort((*then[which, :3].T[::-1], *first[which].T[::-1]))]
    rows = np.column_stack([first, then[:, :3]])
    np.testing.assert_array_equal(rows[found], rows[expected])
    assert set(found) == set(which)
