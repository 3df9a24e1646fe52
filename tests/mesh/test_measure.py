"""Areas, rest matrices and coordinates in the planes of triangles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mesh_sources import Transform, grid_mesh, obj_mesh, rest_areas, turn

from lyra_petsc.mesh.measures import (
    plane_coordinates,
    rest_matrices,
)


def test_rest_matrices_recover_the_deformation_gradient() -> None:
    mesh = grid_mesh(nx=3, ny=2, pattern="alternating")
    gradient = np.array([[1.2, 0.3], [-0.1, 0.9], [0.2, 0.4]])
    x = mesh.rest[:, :2] @ gradient.T
    corners = x[mesh.triangles]
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    inverse, area = rest_matrices(mesh)
    assert np.allclose(sides @ inverse, gradient)
    assert area == pytest.approx(rest_areas(mesh))


def test_warp_turns_anticlockwise() -> None:
    mesh = grid_mesh(nx=1, ny=1)
    # stretch by 2 along y: with the warp at 90° to x it is a stretch along the warp
    x = mesh.rest * [1, 2, 1]
    corners = x[mesh.triangles]
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    inverse, _ = rest_matrices(mesh, np.array([90.0, 0.0]))
    gradient = sides @ inverse
    assert np.allclose(gradient[0], [[0, -1], [2, 0], [0, 0]])
    assert np.allclose(gradient[1], [[1, 0], [0, 2], [0, 0]])


def test_clockwise_sheet_keeps_its_material_axes(tmp_path: Path) -> None:
    mesh = obj_mesh(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 3 2\n")
    assert mesh.triangle_uv[0].tolist() == [[0, 0], [0, 1], [1, 0]]
    inverse, area = rest_matrices(mesh, 30.0)
    assert area.tolist() == [0.5]
    assert np.linalg.det(inverse[0]) == pytest.approx(1.0)
    # Green strain of a stretch along the warp: in the first axis only, though the corners run clockwise
    warp = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    stretch = np.eye(2) + np.outer(warp, warp)
    x = mesh.rest[mesh.triangles[0]][:, :2] @ stretch
    gradient = np.stack([x[1] - x[0], x[2] - x[0]], axis=1) @ inverse[0]
    assert np.allclose(gradient.T @ gradient, np.diag([4.0, 1.0]))


@pytest.mark.parametrize("degrees", [0, 20, 45, 80, 90, 135, 180])
def test_plane_coordinates_of_a_rotated_sheet_keep_lengths(degrees: float) -> None:
    flat = grid_mesh(nx=3, ny=2)
    mesh = grid_mesh(Transform(rotate=turn((0.3, -1, 0.2), degrees)), nx=3, ny=2)
    uv = plane_coordinates(mesh.positions, mesh.triangles)
    lengths = [np.linalg.norm(c - np.roll(c, 1, axis=1), axis=2) for c in (uv, flat.triangle_uv)]
    assert np.allclose(*lengths)
    # continuous on a flat sheet: the corners at a vertex have the same coordinates
    of_vertex = np.empty((mesh.n_vertices, 2))
    of_vertex[mesh.triangles] = uv
    assert np.allclose(of_vertex[mesh.triangles], uv)


def test_axes_of_plane_coordinates() -> None:
    triangle = np.array([[0, 1, 2]])
    upright = plane_coordinates(np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]]), triangle)
    assert upright[0].tolist() == [[0, 0], [1, 0], [0, 1]]
    across = plane_coordinates(np.array([[5.0, 0, 0], [5, 2, 0], [5, 0, 3]]), triangle)
    assert across[0].tolist() == [[0, 0], [2, 0], [0, 3]]
    sloping = plane_coordinates(np.array([[0.0, 0, 0], [1, 0, 1], [0, 1, 0]]), triangle)
    assert np.allclose(sloping[0], [[0, 0], [np.sqrt(2), 0], [0, 1]])
