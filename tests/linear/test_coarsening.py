"""Coarse meshes: the vertices that are kept, and the interpolation of the others."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from lyra_petsc.linear.coarsening import CoarseMesh, coarsen
from lyra_petsc.mesh.build import grid_sheet
from lyra_petsc.mesh.partitioner import locality_order, vertex_graph
from lyra_petsc.scene.schema import Grid


def grid(n: int, jitter: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n², 3) and triangles (2 (n − 1)², 3) of a square, inner vertices moved at random."""
    at = np.arange(n * n)
    x = np.column_stack([at % n, at // n, np.zeros(n * n)]).astype(float)
    inner = (x[:, :2] > 0).all(axis=1) & (x[:, :2] < n - 1).all(axis=1)
    x[inner, :2] += jitter * np.random.default_rng(1).uniform(-1, 1, (int(inner.sum()), 2))
    a = at.reshape(n, n)[:-1, :-1].ravel()
    return x, np.vstack([np.column_stack([a, a + 1, a + n + 1]), np.column_stack([a, a + n + 1, a + n])])


def interpolation(coarse: CoarseMesh) -> np.ndarray:
    """The dense matrix (N, C)."""
    n = len(coarse.start) - 1
    matrix = np.zeros((n, len(coarse.vertices)))
    np.add.at(matrix, (np.repeat(np.arange(n), np.diff(coarse.start)), coarse.parents), coarse.weights)
    return matrix


def levels(x: np.ndarray, triangles: np.ndarray, number: int) -> Iterator[tuple[float, float]]:
    """Fraction of vertices kept, and coarse vertices per fine vertex, for each level from the finest on."""
    for _ in range(number):
        coarse = coarsen(x, triangles)
        yield len(coarse.vertices) / len(x), len(coarse.parents) / len(x)
        x, triangles = x[coarse.vertices], coarse.triangles


@pytest.mark.parametrize("pattern", ["diagonal", "alternating", "criss-cross"])
def test_coarse_meshes_of_all_patterns_are_equally_small(pattern: Any) -> None:
    sheet = grid_sheet(Grid(width=1, height=1, nx=61, ny=61, pattern=pattern))
    position = locality_order(vertex_graph([sheet.triangles], len(sheet.points)))
    x, triangles = sheet.points[np.argsort(position)], position[sheet.triangles]
    for stay, parents in levels(x, triangles, 3):
        assert stay < 0.29
        assert parents < 4.9


def test_vertices_of_irregular_meshes_are_interpolated_from_few_others() -> None:
    for stay, parents in levels(*grid(61, 0.3), 3):
        assert stay < 0.32
        assert parents < 4.3


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_kept_vertices_are_a_maximal_independent_set(jitter: float) -> None:
    x, triangles = grid(17, jitter)
    stays = np.zeros(len(x), dtype=bool)
    stays[coarsen(x, triangles).vertices] = True
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert not stays[edges].all(axis=1).any()
    beside = np.zeros(len(x), dtype=bool)
    beside[edges[stays[edges[:, 0]], 1]] = beside[edges[stays[edges[:, 1]], 0]] = True
    assert (stays | beside).all()
    assert 2.5 < len(x) / stays.sum() < 5.0


@pytest.mark.parametrize(("jitter", "most"), [(0.0, 1e-9), (0.3, 0.45)])
def test_linear_functions_on_a_flat_sheet_are_interpolated_exactly(jitter: float, most: float) -> None:
    x, triangles = grid(17, jitter)
    turned = x @ np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
    coarse = coarsen(turned, triangles)
    matrix = interpolation(coarse)
    error = np.linalg.norm(matrix @ turned[coarse.vertices] - turned, axis=1)
    corner = ((x[:, :2] == 0) | (x[:, :2] == 16)).all(axis=1)  # smoothing cuts them off
    assert error[~corner].max() < most
    assert error.max() <= 0.5
    assert np.abs(matrix.sum(axis=1) - 1.0).max() < 1e-12


@pytest.mark.parametrize(
    ("x", "triangles"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)),
        (np.eye(3), np.zeros((0, 3), dtype=np.int64)),
        (np.eye(3), np.array([[0, 1, 2]])),
        (np.zeros((4, 3)), np.array([[0, 1, 2], [1, 3, 2]])),
        (np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]), np.array([[0, 1, 2], [1, 3, 2]])),
    ],
    ids=["empty", "no triangle", "one triangle", "all in one place", "all on a line"],
)
def test_every_vertex_of_any_mesh_has_interpolation_weights(x: np.ndarray, triangles: np.ndarray) -> None:
    coarse = coarsen(x, triangles)
    assert np.isfinite(coarse.weights).all()
    assert np.allclose(interpolation(coarse).sum(axis=1), 1.0)


def test_separate_sheets_are_interpolated_separately() -> None:
    x, triangles = grid(9)
    both = np.vstack([x, x + [0, 0, 1e-3]])
    coarse = coarsen(both, np.vstack([triangles, triangles + len(x)]))
    upper = coarse.vertices >= len(x)
    matrix = interpolation(coarse)
    assert not matrix[: len(x), upper].any()
    assert not matrix[len(x) :, ~upper].any()
