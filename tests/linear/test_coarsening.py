"""Coarse meshes: the vertices that are kept, and the interpolation of the others."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lyra_petsc.linear.coarsening import CoarseMesh, coarsen
from lyra_petsc.mesh.build import build_mesh, grid_sheet
from lyra_petsc.mesh.partitioner import locality_order, vertex_graph
from lyra_petsc.scene.schema import Grid, MeshSource


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
@pytest.mark.parametrize("cells", [60, 61])
@pytest.mark.parametrize("numbering", ["along rows", "as distributed"])
def test_coarse_meshes_of_all_patterns_are_equally_small(pattern: Any, cells: int, numbering: str) -> None:
    sheet = grid_sheet(Grid(width=1, height=1, nx=cells, ny=cells, pattern=pattern))
    x, triangles = sheet.points, sheet.triangles
    if numbering == "as distributed":
        position = locality_order(vertex_graph([triangles], len(x)))
        x, triangles = x[np.argsort(position)], position[triangles]
    for stay, parents in levels(x, triangles, 3):
        assert stay < 0.29
        assert parents < 4.9


def test_vertices_of_irregular_meshes_are_interpolated_from_few_others() -> None:
    for stay, parents in levels(*grid(61, 0.3), 3):
        assert stay < 0.32
        assert parents < 4.3


SQUARE = """
Point(1) = {0, 0, 0, h}; Point(2) = {1, 0, 0, h}; Point(3) = {1, 1, 0, h}; Point(4) = {0, 1, 0, h};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
"""


def test_coarse_meshes_of_gmsh_meshes_are_equally_small(tmp_path: Path) -> None:
    """Meshes of regular patches that do not match at their borders."""
    script = tmp_path / "square.geo"
    script.write_text(f"h = {math.sqrt(2 / math.sqrt(3) / 6000)};{SQUARE}", encoding="ascii")
    mesh = build_mesh([MeshSource(file=script)])
    position = locality_order(vertex_graph([mesh.triangles], mesh.n_vertices))
    x, triangles = mesh.positions[np.argsort(position)], position[mesh.triangles]
    for stay, parents in levels(x, triangles, 3):
        assert stay < 0.27
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


def test_a_grid_is_coarsened_to_one_of_twice_the_spacing() -> None:
    x, triangles = grid(17)
    coarse = coarsen(x, triangles)
    expected = x[(x[:, 0] % 2 == 0) & (x[:, 1] % 2 == 0)]
    assert np.array_equal(x[coarse.vertices], expected)
    assert len(coarse.triangles) == 2 * 8 * 8


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


def folds(n: int, values: np.ndarray) -> float:
    """Sum of squared second differences of values (n²,) along both axes of a grid."""
    z = values.reshape(n, n)
    return float((np.diff(z, 2, axis=0) ** 2).sum() + (np.diff(z, 2, axis=1) ** 2).sum())


def test_interpolated_functions_bend_like_smooth_ones() -> None:
    x, triangles = grid(33)
    wave = np.sin(2 * np.pi * x[:, 0] / 32) * np.sin(2 * np.pi * x[:, 1] / 32)
    coarse = coarsen(x, triangles)
    bent = interpolation(coarse) @ wave[coarse.vertices]
    # linear interpolation would fold at every second line: twice the squares
    assert folds(33, bent) < 1.4 * folds(33, wave)


def test_a_curved_sheet_is_interpolated() -> None:
    x, triangles = grid(33)
    x[:, 2] = 4.0 * np.sin(x[:, 0] / 8.0)
    coarse = coarsen(x, triangles)
    # corners that two triangles meet in are rounded off by a quarter of the spacing
    assert np.abs(interpolation(coarse) @ x[coarse.vertices] - x).max() < 0.26


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
