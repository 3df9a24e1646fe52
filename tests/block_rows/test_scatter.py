"""Element blocks, whole or as sums of outer products, land where the offsets say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit

from lyra_petsc.block_rows.scatter import AHEAD, add_elements, fetch_ahead
from lyra_petsc.block_rows.vectors import add_outer

RNG = np.random.default_rng(7)


@njit
def add_one(values: Any, at: Any, diagonal: Any, left: Any, right: Any) -> None:
    add_outer(values, at, diagonal, left, right)


def vectors(count: int) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(a), float(b), float(c)) for a, b, c in RNG.normal(size=(count, 3)))


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("kind", [np.int32, np.int64])
@pytest.mark.parametrize("odd", [0, 1])
def test_outer_products_are_added_to_one_block(count: int, kind: type, odd: int) -> None:
    before = RNG.normal(size=(3, 3, 3))
    left, right = vectors(count), vectors(count)
    block = 0.7 * np.eye(3) + np.array(left).T @ np.array(right)
    values = before.copy()
    add_one(values, kind(2 * 1 + odd), 0.7, left, right)
    expected = before.copy()
    expected[1] += block.T if odd else block
    np.testing.assert_allclose(values, expected, atol=1e-14)
    # neighbours are not even rewritten
    np.testing.assert_array_equal(values[[0, 2]], before[[0, 2]])


def test_what_others_have_is_left_to_them() -> None:
    values = np.ones((2, 3, 3))
    add_one(values, np.int32(-1), 5.0, vectors(1), vectors(1))
    np.testing.assert_array_equal(values, 1.0)


def test_whole_elements_go_the_same_way() -> None:
    blocks = RNG.normal(size=(AHEAD + 3, 2, 2, 3, 3))
    offsets = np.array([[0, 3, 4]] * (AHEAD + 2) + [[0, 2, -1]], dtype=np.int32)
    values = np.zeros((3, 3, 3))
    weight = RNG.normal(size=len(blocks))
    add_elements(weight, blocks, offsets, values)
    weighted = weight[:, None, None, None, None] * blocks
    np.testing.assert_allclose(values[0], weighted[:, 0, 0].sum(axis=0), atol=1e-13)
    np.testing.assert_allclose(values[1], weighted[:-1, 1, 0].sum(axis=0) + weighted[-1, 0, 1], atol=1e-13)
    np.testing.assert_allclose(values[2], weighted[:-1, 1, 1].sum(axis=0), atol=1e-13)


def test_fetching_changes_nothing() -> None:
    values = np.arange(18.0).reshape(2, 3, 3)
    before = values.copy()
    offsets = np.array([[-1, 2, 10**6]], dtype=np.int32)  # another rank's, ours, and nobody's
    fetch_ahead(0, offsets, values, 3)
    np.testing.assert_array_equal(values, before)
