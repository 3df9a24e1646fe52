"""Pairs of near boxes, compared with a search over all pairs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.contact.near import near_pairs_by_tree, overlapping_pairs

SIZES: dict[str, float | list[float]] = {
    "small": 0.05,
    "large": 0.5,
    "long and thin": [3.0, 0.01, 0.1],
    "points": 0.0,
    "of very different size": [0.0, 1e-3, 30.0],
}


def boxes(rng: np.random.Generator, n: int, size: float | list[float]) -> tuple[Array, Array]:
    low = rng.normal(size=(n, 3))
    return low, low + rng.random((n, 3)) * size


def brute(low: Array, high: Array, other_low: Array, other_high: Array) -> NDArray[np.bool_]:
    apart = (low[:, None] > other_high) | (high[:, None] < other_low)
    return np.asarray(~apart.any(axis=2))


def as_set(pairs: NDArray[np.int64]) -> set[tuple[int, int]]:
    found = [(int(a), int(b)) for a, b in pairs]
    assert len(found) == len(set(found)), "pairs are named once"
    return set(found)


@pytest.mark.parametrize("n", [1, 50, 300])
@pytest.mark.parametrize("size", SIZES)
def test_pairs_agree_with_brute_force(n: int, size: str) -> None:
    rng = np.random.default_rng(n)
    low, high = boxes(rng, n, SIZES[size])
    others = boxes(rng, n + 7, SIZES[size])
    assert as_set(overlapping_pairs((low, high), others)) == as_set(np.argwhere(brute(low, high, *others)))
    mutual = np.argwhere(np.triu(brute(low, high, low, high), 1))
    assert as_set(near_pairs_by_tree(low, high, 0.0)) == as_set(mutual)


@pytest.mark.parametrize("thickness", [0.0, 1e-17, 1e-21, 1e-30, 1e-300])
def test_boxes_in_one_plane_up_to_rounding(thickness: float) -> None:
    """Cells are then so thin that their numbers exceed the range of integers."""
    rng = np.random.default_rng(5)
    low = rng.random((400, 3)) * [1.0, 1.0, thickness]
    high = low + rng.random((400, 3)) * [0.05, 0.05, 0.0]
    mine = rng.random((60, 3)) * [1.0, 1.0, 0.2]
    found = overlapping_pairs((mine - 0.1, mine + 0.1), (low, high))
    assert as_set(found) == as_set(np.argwhere(brute(mine - 0.1, mine + 0.1, low, high)))
    assert len(found) > 60


@pytest.mark.parametrize("radius", [0.0, 0.05, 0.4])
def test_boxes_within_a_radius(radius: float) -> None:
    rng = np.random.default_rng(3)
    low, high = boxes(rng, 80, 1.0)
    dx = np.maximum(low[:, None] - high, 0.0)
    close = np.linalg.norm(np.maximum(dx, dx.transpose(1, 0, 2)), axis=2) <= radius
    assert as_set(near_pairs_by_tree(low, high, radius)) == as_set(np.argwhere(np.triu(close, 1)))
