"""Crossing triangles, compared with rational arithmetic and with examples."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest

from lyra_petsc.contact.crossings import (
    UNDECIDED,
    have_common_vertex,
    mutual_crossings,
    rational_side,
    self_crossings,
    side,
)

TWO = np.array([[0, 1, 2], [3, 4, 5]])
FLOOR = [[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]


def minus(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
    return [x - y for x, y in zip(a, b, strict=True)]


def dot(a: list[Fraction], b: list[Fraction]) -> Fraction:
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def cross(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
    return [a[k - 2] * b[k - 1] - a[k - 1] * b[k - 2] for k in range(3)]


def span(
    corners: list[list[Fraction]], normal: list[Fraction], point: list[Fraction], line: list[Fraction]
) -> tuple[Fraction, Fraction] | None:
    """Where the interior of a triangle meets a plane: an open interval along their common line."""
    heights = [dot(normal, minus(corner, point)) for corner in corners]
    if not max(heights) > 0 > min(heights):
        return None
    ends = [dot(line, corner) for corner, height in zip(corners, heights, strict=True) if height == 0]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        if heights[i] * heights[j] < 0:
            share = heights[i] / (heights[i] - heights[j])
            ends.append(dot(line, corners[i]) + share * dot(line, minus(corners[j], corners[i])))
    return min(ends), max(ends)


def cross_in_numbers(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two triangles (3, 3) cross: the points of both in the other's plane, in rational numbers."""
    if (one.min(axis=0) > other.max(axis=0)).any() or (other.min(axis=0) > one.max(axis=0)).any():
        return False
    first, second = ([[Fraction(x) for x in corner] for corner in t.tolist()] for t in (one, other))
    n, m = (cross(minus(t[1], t[0]), minus(t[2], t[0])) for t in (first, second))
    line = cross(n, m)
    if not any(line):
        return False
    mine, theirs = span(first, m, second[0], line), span(second, n, first[0], line)
    return bool(mine and theirs and max(mine[0], theirs[0]) < min(mine[1], theirs[1]))


def brute(points: np.ndarray, triangles: np.ndarray) -> list[list[int]]:
    """All pairs that cross."""
    return [
        [i, j]
        for i, j in itertools.combinations(range(len(triangles)), 2)
        if cross_in_numbers(points[triangles[i]], points[triangles[j]])
    ]


def soup(seed: int, size: int, vertices: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random triangles between vertices on integers, many of them coplanar, collinear or coincident."""
    rng = np.random.default_rng(seed)
    points = rng.integers(-size, size + 1, (vertices, 3)).astype(float)
    return points, np.array([rng.choice(vertices, 3, replace=False) for _ in range(count)])


def crosses(*corners: list[float]) -> bool:
    """Whether two triangles of six corners cross, in all orders of the corners and of the triangles."""
    points = np.array(corners, dtype=float)
    answers = set()
    for first in itertools.permutations(range(3)):
        for second in itertools.permutations(range(3, 6)):
            for triangles in (np.array([first, second]), np.array([second, first])):
                answers.add(len(self_crossings(points, triangles)))
                answers.add(len(mutual_crossings(points, triangles[:1], points, triangles[1:])))
    assert len(answers) == 1
    return answers == {1}


# -- against rational numbers ------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 4])
def test_random_triangles_with_integer_coordinates(size: int) -> None:
    found = 0
    for seed in range(8):
        points, triangles = soup(seed, size, 10, 25)
        expected = brute(points, triangles)
        found += len(expected)
        assert self_crossings(points, triangles).tolist() == expected
    assert found > 20


@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_random_triangles_within_rounding_of_touching(offset: float) -> None:
    found = 0
    for seed in range(10):
        points, triangles = soup(seed, 2, 12, 25)
        points = 0.1 * points + offset
        points += np.spacing(points) * np.random.default_rng(seed).integers(-1, 2, points.shape)
        expected = brute(points, triangles)
        found += len(expected)
        assert self_crossings(points, triangles).tolist() == expected
    assert found > 200


def test_more_triangles_than_a_leaf_and_more_pairs_than_the_first_capacity() -> None:
    points, triangles = soup(1, 12, 300, 110)
    expected = brute(points, triangles)
    assert len(expected) > 64
    assert self_crossings(points, triangles).tolist() == expected


@pytest.mark.parametrize("scale", [2.0**-330, 2.0**-120, 2.0**330])
def test_coordinates_whose_products_overflow_or_underflow(scale: float) -> None:
    points, triangles = soup(3, 2, 10, 25)
    assert self_crossings(scale * points, triangles).tolist() == brute(points, triangles) != []
    sheared = points * [1.0, scale, 1.0]
    assert self_crossings(sheared, triangles).tolist() == brute(points, triangles)


@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_sides_of_points_within_rounding_of_a_plane(offset: float) -> None:
    rng = np.random.default_rng(7)
    signs = []
    for _ in range(300):
        points = rng.random((4, 3)) + offset
        weights = rng.random(3)
        points[3] = weights / weights.sum() @ points[:3]
        points[3] += np.spacing(points[3]) * rng.integers(-2, 3, 3)
        exact = dict(enumerate(tuple(map(Fraction, point)) for point in points.tolist()))
        a, b, c, d = (list(exact[k]) for k in range(4))
        height = dot(minus(d, a), cross(minus(b, a), minus(c, a)))
        sign = (height > 0) - (height < 0)
        assert side(points, 0, 1, 2, 3) == rational_side(exact, 0, 1, 2, 3) == sign
        for p in itertools.permutations(range(4)):
            odd = sum(x > y for x, y in itertools.combinations(p, 2)) % 2
            assert side(points, *p) == (-sign if odd else sign)
        signs.append(sign)
    assert {-1, 1} <= set(signs)


def test_sides_that_need_expansions_or_rational_numbers() -> None:
    # (x + ε) (x − ε) − x²: the last bit of products of 53 bits
    x, e = 1.0, 2.0**-52
    points = np.array([[0, 0, 0], [x + e, x, 0], [x, x - e, 0], [0.1, 0.3, 1.0]])
    assert side(points, 0, 1, 2, 3) == -1
    points[2, 1] = x
    assert side(points, 0, 1, 2, 3) == 1
    tiny = points * [1e-200, 1e-200, 1.0]
    assert side(tiny, 0, 1, 2, 3) == UNDECIDED
    assert rational_side({k: tuple(map(Fraction, tiny[k].tolist())) for k in range(4)}, 0, 1, 2, 3) == 1


# -- by hand -----------------------------------------------------------------------------------------------


@pytest.mark.quick
def test_a_triangle_through_another_crosses() -> None:
    assert crosses(*FLOOR, [1, 1, -1], [1, 1, 1], [9, 9, 1])
    # edges through the floor's edge only, and corners of both within the other
    assert crosses(*FLOOR, [1, -1, -1], [1, -1, 1], [1, 1, 0.5])
    assert not crosses(*FLOOR, [3, 3, -1], [3, 3, 1], [9, 9, 0])


@pytest.mark.parametrize(
    "other",
    [
        [[0, 0, 0], [-1, 0, -1], [-1, 0, 1]],  # a corner on a corner
        [[2, 0, 0], [2, -1, -1], [2, -1, 1]],  # a corner on an edge
        [[1, 1, 0], [1, 1, 1], [2, 1, 1]],  # a corner within
        [[1, 1, 0], [2, 1, 0], [2, 1, 1]],  # an edge within
        [[-9, 1, 0], [9, 1, 0], [2, 1, 1]],  # an edge across
        [[2, -1, -1], [2, -1, 1], [2, 0.0, 9]],  # a corner beside
        [[1, 0, -1], [1, 0, 1], [2, -1, 0]],  # an edge through an edge, from outside
        [[0, 0, 0], [4, 0, 0], [0, 4, 0]],  # the same place
        [[1, 1, 0], [5, 1, 0], [1, 5, 0]],  # overlapping in one plane
        [[1, 1, 0], [1.5, 1, 0], [1, 1.5, 0]],  # one within the other
        [[1, 1, -1], [1, 1, 1], [1, 1, 3]],  # without area
        [[1, 1, 1], [1, 1, 1], [1, 1, 1]],
    ],
)
def test_touching_triangles_do_not_cross(other: list[list[float]]) -> None:
    assert not crosses(*FLOOR, *other)
    assert not crosses(*(np.array([*FLOOR, *other]) @ [[0, 2, 0], [0, 0, 2], [2, 0, 0]]).tolist())


# -- surfaces ----------------------------------------------------------------------------------------------


def grid(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit square of n × n cells."""
    i, j = (one.ravel() for one in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    a = i * (n + 1) + j
    triangles = np.concatenate([np.stack([a, a + n + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + 1], 1)])
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), triangles


def turned(points: np.ndarray, seed: int) -> np.ndarray:
    axes, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return np.asarray(points @ axes.T)


@pytest.mark.quick
def test_sheets_that_are_flat_curved_folded_or_stacked_do_not_cross() -> None:
    flat, triangles = grid(12)
    x, y, z = flat.T
    roll = np.stack([(2 + x) * np.sin(9 * x), y, (2 + x) * np.cos(9 * x)], 1)
    for sheet in (flat, turned(flat, 1), turned(flat, 2) + 1e3, roll, roll + 1e3, turned(roll, 3)):
        assert len(self_crossings(sheet, triangles)) == 0
    folded = np.stack([np.abs(x - 0.5), y, z], 1)  # onto itself, along a line of the grid
    assert len(self_crossings(folded, triangles)) == 0
    upon = np.concatenate([flat, flat + [0.01, 0.02, 0.0], flat + [0, 0, 5e-324]])
    stacked = np.concatenate([triangles, triangles + len(flat), triangles + 2 * len(flat)])
    assert len(self_crossings(upon, stacked)) == 0


def test_self_crossings_do_not_depend_on_order_and_place() -> None:
    flat, triangles = grid(10)
    x, y, _ = flat.T
    s = 8.0 * (x - 0.47)
    loop = np.stack([s * s * s / 9 - s, y + 0.01 * s, s * s], 1)  # x(s) = x(−s) at s = 3
    pairs = self_crossings(loop, triangles)
    assert pairs.tolist() == brute(loop, triangles) != []
    assert self_crossings(loop[:, [2, 0, 1]] * [-1.0, 4.0, 0.5], triangles).tolist() == pairs.tolist()
    rng = np.random.default_rng(4)
    order, names = rng.permutation(len(triangles)), rng.permutation(len(loop))
    renamed = np.argsort(names)[triangles[order]]
    renamed = np.stack([np.roll(one, turn) for one, turn in zip(renamed, order % 3, strict=True)])
    found = np.sort(order[self_crossings(loop[names], renamed)], axis=1)
    assert sorted(found.tolist()) == pairs.tolist()


@pytest.mark.quick
def test_pairs_with_a_common_vertex_are_counted_separately() -> None:
    points = np.array(
        [[0, 0, 0], [2, 1, 0], [2, -1, 0], [2, 0, 1], [2, 0, -1], [1, 0, 5], [1, 0.1, -5], [1, -0.1, -5.0]]
    )
    triangles = np.array([[0, 1, 2], [3, 0, 4], [5, 6, 7], [1, 2, 3]])
    pairs = self_crossings(points, triangles)
    assert pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert have_common_vertex(triangles, pairs).tolist() == [True, False, False]


@pytest.mark.quick
def test_two_surfaces() -> None:
    flat, triangles = grid(6)
    wall = np.array([[0.31, -1, -1], [0.31, 3, -1], [0.31, 1, 2.0]])
    pairs = mutual_crossings(flat, triangles, wall, TWO[:1])
    columns = flat[triangles][..., 0]
    across = (columns.min(axis=1) < 0.31) & (columns.max(axis=1) > 0.31)
    assert pairs.tolist() == [[t, 0] for t in np.flatnonzero(across)]
    other_way = mutual_crossings(wall, TWO[:1], flat, triangles)
    assert sorted(other_way[:, ::-1].tolist()) == pairs.tolist()
    # a surface upon itself touches
    assert len(mutual_crossings(flat, triangles, flat, triangles)) == 0
    assert mutual_crossings(flat, triangles, wall, TWO[:0]).shape == (0, 2)
    assert mutual_crossings(flat, triangles[:0], wall, TWO[:1]).shape == (0, 2)
