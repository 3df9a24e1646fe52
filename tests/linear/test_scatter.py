"""Element blocks, full or as sums of outer products, are added at the given offsets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit

from lyra_petsc.kernels.scatter import AHEAD, add_elements, fetch_ahead
from lyra_petsc.kernels.vectors import add_corners, add_outers, add_six, add_triangle

RNG = np.random.default_rng(7)


@njit
def add_one(values: Any, at: Any, diagonal: Any, pairs: Any) -> None:
    add_outers(values, at, diagonal, pairs)


@njit
def add_all(values: Any, offsets: Any, e: Any, n: Any, six: Any) -> None:
    add_six(values, offsets, e, n, six)


@njit
def add_balanced(values: Any, offsets: Any, e: Any, f: Any, three: Any) -> None:
    add_triangle(values, offsets, e, f, three)


@njit
def add_given(values: Any, offsets: Any, e: Any, three: Any) -> None:
    add_corners(values, offsets, e, three)


def vectors(count: int) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(a), float(b), float(c)) for a, b, c in RNG.normal(size=(count, 3)))


@pytest.mark.parametrize("kind", [np.int32, np.int64])
@pytest.mark.parametrize("odd", [0, 1])
@pytest.mark.parametrize("count", [1, 2])
def test_outer_products_are_added_to_one_block(kind: type, odd: int, count: int) -> None:
    before = RNG.normal(size=(3, 3, 3))
    pairs = tuple(vectors(2) for _ in range(count))
    block = 0.7 * np.eye(3) + sum(np.outer(left, right) for left, right in pairs)
    values = before.copy()
    add_one(values, kind(2 * 1 + odd), 0.7, pairs)
    expected = before.copy()
    expected[1] += block.T if odd else block
    np.testing.assert_allclose(values, expected, atol=1e-14)
    # neighbours are not even rewritten
    np.testing.assert_array_equal(values[[0, 2]], before[[0, 2]])


def test_blocks_of_other_ranks_are_not_added() -> None:
    values = np.ones((2, 3, 3))
    add_one(values, np.int32(-1), 5.0, (vectors(2),))
    np.testing.assert_array_equal(values, 1.0)


PLACES = [[0, 3, 4, 6, 9, 10], [2, 5, -1, -1, -1, -1], [-1, 4, 7, 0, -1, 2], [-1] * 6]
"""Offsets of couplings (0, 0), (0, 1), …, (2, 2): all on this rank, those of one or two points, none."""


def sums_at(places: list[int], blocks: np.ndarray) -> np.ndarray:
    """Zeros (6, 3, 3) to which the blocks are added, transposed at odd offsets."""
    out = np.zeros((6, 3, 3))
    for place, block in zip(places, blocks, strict=True):
        if place >= 0:
            out[place // 2] += block.T if place % 2 else block
    return out


@pytest.mark.parametrize("places", PLACES)
@pytest.mark.parametrize("kind", [np.int32, np.int64])
def test_six_blocks_of_a_triangle(places: list[int], kind: type) -> None:
    (n,), six = vectors(1), tuple(vectors(2) for _ in range(6))
    blocks = np.array([np.outer(n, right) + np.outer(left, n) for right, left in six])
    values = np.zeros((6, 3, 3))
    add_all(values, np.array([PLACES[0], places], dtype=kind), 1, n, six)
    np.testing.assert_allclose(values, sums_at(places, blocks), atol=1e-14)


@pytest.mark.parametrize("places", PLACES)
def test_outer_products_of_sums_of_vectors(places: list[int]) -> None:
    n, a, b, c = vectors(4)
    right, left = ((2.0, a), (-0.5, b)), ((3.0, c),)
    block = np.outer(n, 2.0 * np.array(a) - 0.5 * np.array(b)) + np.outer(3.0 * np.array(c), n)
    values = np.zeros((6, 3, 3))
    add_all(values, np.array([places], dtype=np.int32), 0, n, ((right, left),) * 6)
    np.testing.assert_allclose(values, sums_at(places, np.array([block] * 6)), atol=1e-14)


@pytest.mark.parametrize("places", PLACES)
@pytest.mark.parametrize("kind", [np.int32, np.int64])
def test_three_blocks_of_a_triangle_determine_the_others(places: list[int], kind: type) -> None:
    f, rows = vectors(2), RNG.normal(size=(3, 5))
    rows[::2, 2] = rows[::2, 1]  # (1, 1) and (2, 2) are symmetric
    factors = tuple(tuple(float(number) for number in row) for row in rows)
    u, v = np.array(f)
    parts = np.array([np.outer(u, u), np.outer(u, v), np.outer(v, u), np.outer(v, v), np.eye(3)])
    b11, b12, b22 = (np.tensordot(row, parts, 1) for row in factors)
    b01, b02 = -(b11 + b12.T), -(b12 + b22)
    values = np.zeros((6, 3, 3))
    add_balanced(values, np.array([places], dtype=kind), 0, f, factors)
    expected = sums_at(places, np.array([-(b01 + b02), b01, b02, b11, b12, b22]))
    np.testing.assert_allclose(values, expected, atol=1e-13)


@pytest.mark.parametrize("places", PLACES)
@pytest.mark.parametrize("kind", [np.int32, np.int64])
def test_three_blocks_of_corners_determine_the_others(places: list[int], kind: type) -> None:
    b11, b12, b22 = blocks = RNG.normal(size=(3, 3, 3))
    b11 += b11.T.copy()
    b22 += b22.T.copy()
    b01, b02 = -(b11 + b12.T), -(b12 + b22)
    offsets = np.array([PLACES[0], places], dtype=kind)
    values = np.zeros((6, 3, 3))
    add_given(values, offsets, 1, tuple(tuple(map(float, block.ravel())) for block in blocks))
    expected = sums_at(places, np.array([-(b01 + b02), b01, b02, b11, b12, b22]))
    np.testing.assert_allclose(values, expected, atol=1e-13)


def test_full_element_matrices_are_added() -> None:
    blocks = RNG.normal(size=(AHEAD + 3, 2, 2, 3, 3))
    offsets = np.array([[0, 3, 4]] * (AHEAD + 2) + [[0, 2, -1]], dtype=np.int32)
    values = np.zeros((3, 3, 3))
    weight = RNG.normal(size=len(blocks))
    add_elements(weight, blocks, offsets, values)
    weighted = weight[:, None, None, None, None] * blocks
    np.testing.assert_allclose(values[0], weighted[:, 0, 0].sum(axis=0), atol=1e-13)
    np.testing.assert_allclose(values[1], weighted[:-1, 1, 0].sum(axis=0) + weighted[-1, 0, 1], atol=1e-13)
    np.testing.assert_allclose(values[2], weighted[:-1, 1, 1].sum(axis=0), atol=1e-13)


def test_prefetching_changes_nothing() -> None:
    values = np.arange(18.0).reshape(2, 3, 3)
    before = values.copy()
    offsets = np.array([[-1, 2, 10**6]], dtype=np.int32)  # of another rank, of this one, and out of range
    fetch_ahead(0, offsets, values, 3)
    np.testing.assert_array_equal(values, before)
