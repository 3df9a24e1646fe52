"""Overlaps of sheets with obstacles, compared with points sampled in triangles and with handmade cases."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from lyra_petsc.contact.overlaps import Overlaps, behind_planes, inside_ball, inside_box, outside_ball
from lyra_petsc.mesh.topology import unique_edges

pytestmark = pytest.mark.quick

CUBE = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)], dtype=float)
ONE = np.array([[0, 1, 2]])


def counts(found: Overlaps) -> tuple[int, int, int]:
    return len(found.vertices), len(found.edges), len(found.triangles)


def rotation() -> np.ndarray:
    axes, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    return np.asarray(axes * np.linalg.det(axes))


def cloud(triangle: np.ndarray, n: int = 40) -> np.ndarray:
    """Lattice points of a triangle, including its edges and corners."""
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
    i, j = i[i + j <= n] / n, j[i + j <= n] / n
    return np.asarray(
        triangle[0] + np.outer(i, triangle[1] - triangle[0]) + np.outer(j, triangle[2] - triangle[0])
    )


def axis_distance(points: np.ndarray, axis: np.ndarray) -> np.ndarray:
    along = axis[-1] - axis[0]
    square = along @ along
    s = np.clip((points - axis[0]) @ along / square, 0, 1) if square else np.zeros(len(points))
    return np.asarray(np.linalg.norm(points - axis[0] - np.outer(s, along), axis=1))


def compare(
    found: Overlaps, points: np.ndarray, triangles: np.ndarray, depth: Callable, slack: float = 0.1
) -> np.ndarray:
    """Compare overlaps with the largest ``depth`` of points of each simplex; both are right from −slack to 0.

    Returns (3, 2), for vertices, edges and triangles, the number that overlap and the number that do not.
    """
    edges = unique_edges(triangles)
    in_edges = (edges[:, None] == found.edges[None]).all(axis=2).any(axis=1)
    numbers = []
    for corners, overlap in (
        (np.arange(len(points))[:, None].repeat(3, 1), np.isin(np.arange(len(points)), found.vertices)),
        (edges[:, [0, 1, 1]], in_edges),
        (triangles, np.isin(np.arange(len(triangles)), found.triangles)),
    ):
        deepest = np.array([depth(cloud(points[row])).max() for row in corners])
        assert overlap[deepest > 1e-9].all()
        assert not overlap[deepest < -slack].any()
        numbers.append([(deepest > 1e-9).sum(), (deepest < -slack).sum()])
    return np.array(numbers)


def scattered(seed: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    points = np.random.default_rng(seed).normal(size=(90, 3)) * spread
    return points, np.arange(90).reshape(30, 3)


@pytest.mark.parametrize("axis", [[[0.1, 0.2, 0.3]], [[-1.0, 0, 0], [1, 0.5, 0.2]]])
def test_balls_and_capsules_against_points_within_triangles(axis: list[list[float]]) -> None:
    ends = np.array(axis)
    numbers = np.zeros((2, 3, 2))
    for seed in range(2):
        points, triangles = scattered(seed, 1.0)
        found = inside_ball(points, triangles, ends, 0.4)
        numbers[0] += compare(found, points, triangles, lambda x: 0.4 - axis_distance(x, ends))
        found = outside_ball(points, triangles, ends, 1.8)
        numbers[1] += compare(found, points, triangles, lambda x: axis_distance(x, ends) - 1.8)
    assert (numbers > 1).all()


def test_boxes_against_points_within_triangles() -> None:
    size, shift, turn = np.array([1.5, 0.8, 1.0]), np.array([0.3, -0.2, 0.1]), rotation()
    corners = (CUBE - 0.5) * size @ turn.T + shift
    on_planes, normals = corners[[0, 0, 0, 7, 7, 7]], np.concatenate([turn.T, -turn.T])

    def depth(x: np.ndarray) -> np.ndarray:
        return np.asarray((size / 2 - np.abs((x - shift) @ turn)).min(axis=1))

    numbers = np.zeros((2, 3, 2))
    for seed in range(4):
        points, triangles = scattered(seed, 1.0)
        numbers[0] += compare(inside_box(points, triangles, corners), points, triangles, depth)
        points *= 0.25
        found = behind_planes(points, triangles, on_planes, normals)
        numbers[1] += compare(found, points, triangles, lambda x: -depth(x))
    assert (numbers > 1).all()


@pytest.mark.parametrize("shift", [0.0, 1e3])
@pytest.mark.parametrize("turn", [np.eye(3), rotation()])
def test_spheres_that_touch_and_that_do_not(turn: np.ndarray, shift: float) -> None:
    triangle = np.array([[-1.0, -1, 0], [2, -1, 0], [-1, 2, 0]]) @ turn.T + shift
    over = np.array([[0.0, 0, 1]]) @ turn.T + shift
    assert counts(inside_ball(triangle, ONE, over, 1.0)) == (0, 0, 0)
    assert counts(inside_ball(triangle, ONE, over, 1.0 + 1e-9)) == (0, 0, 1)
    assert counts(inside_ball(triangle, ONE, over, np.sqrt(1.5) - 1e-9)) == (0, 0, 1)
    assert counts(inside_ball(triangle, ONE, over, np.sqrt(1.5))) == (0, 0, 1)
    assert counts(inside_ball(triangle, ONE, over, np.sqrt(1.5) + 1e-9)) == (0, 1, 1)
    assert counts(inside_ball(triangle, ONE, over, np.sqrt(3.0) + 1e-9)) == (1, 3, 1)
    assert counts(outside_ball(triangle, ONE, over, np.sqrt(6.0))) == (0, 0, 0)
    assert counts(outside_ball(triangle, ONE, over, np.sqrt(6.0) - 1e-9)) == (2, 3, 1)


@pytest.mark.parametrize("turn", [np.eye(3), rotation()])
def test_sheets_on_and_in_a_box(turn: np.ndarray) -> None:
    box = CUBE @ turn.T + 3.0

    def of(*corners: list[float]) -> tuple[int, int, int]:
        return counts(inside_box(np.array(corners, dtype=float) @ turn.T + 3.0, ONE, box))

    assert of([0, 0, 1], [1, 0, 1], [0, 1, 1]) == (0, 0, 0)  # on a side
    assert of([-3, 0.5, 1], [3, 0.5, 1], [0, 9, 4]) == (0, 0, 0)  # an edge on a side
    assert of([0, 0, 0], [1, 1, 1], [1, 1, 0]) == (0, 1, 1)  # between corners
    assert of([0, 0, 0], [-1, 0, 0], [0, -1, 0]) == (0, 0, 0)
    assert of([-9, 0, -9], [9, 0.5, 9], [0, 0.5, -20]) == (0, 1, 1)
    # through the diagonals of two sides, and two edges of the box
    assert of([-9, -9, -9], [9, -9, 9], [0.5, 40, 0.5]) == (0, 0, 1)
    # past an edge of the box, and over it
    assert of([2.01, 0, -4.5], [0, 2.01, 5.5], [3, 3, 0]) == (0, 0, 0)
    assert of([1.99, 0, -4.5], [0, 1.99, 5.5], [3, 3, 0]) == (0, 1, 1)
    assert of([0.5, 0.5, 0.5], [9, 9, 9], [9, 0, 9]) == (1, 2, 1)
    assert of([0.5, 0.5, 1 - 1e-9], [9, 9, 9], [9, 0, 9]) == (1, 2, 1)
