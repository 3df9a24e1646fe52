"""Grids: order of vertices, patterns, groups."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_sources import grid_mesh, rest_areas

from lyra_petsc.errors import InputError


def test_vertices_row_by_row() -> None:
    mesh = grid_mesh(width=3.0, height=1.0, nx=3, ny=2)
    assert mesh.positions[1 * 4 + 2].tolist() == [2.0, 0.5, 0.0]
    assert mesh.positions[-1].tolist() == [3.0, 1.0, 0.0]
    assert mesh.n_vertices == 12


def edges_of(pattern: str) -> set[tuple[int, int]]:
    triangles = grid_mesh(nx=2, ny=2, pattern=pattern).triangles.tolist()
    return {tuple(sorted((t[k], t[k - 1]))) for t in triangles for k in range(3)}


def test_diagonal_joins_low_left_to_high_right() -> None:
    assert {(0, 4), (1, 5), (3, 7), (4, 8)} <= edges_of("diagonal")


def test_alternating_flips_odd_cells() -> None:
    assert {(0, 4), (2, 4), (4, 6), (4, 8)} <= edges_of("alternating")


def test_criss_cross_centres_follow_the_lattice() -> None:
    mesh = grid_mesh(nx=2, ny=3, pattern="criss-cross")
    assert mesh.n_vertices == 12 + 6
    assert np.allclose(mesh.positions[12 + 2 * 2 + 1], [0.75, 2.5 / 3, 0])
    assert mesh.n_triangles == 24


@pytest.mark.parametrize("pattern", ["diagonal", "alternating", "criss-cross"])
def test_area_and_anticlockwise_orientation(pattern: str) -> None:
    mesh = grid_mesh(width=2.0, height=0.5, nx=5, ny=3, pattern=pattern)
    x = mesh.positions[mesh.triangles]
    normal = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    assert (normal[:, 2] > 0).all()
    assert rest_areas(mesh).sum() == pytest.approx(1.0)
    assert mesh.notes == []


def test_groups() -> None:
    groups = grid_mesh(nx=2, ny=2, pattern="criss-cross").groups
    assert groups["left"].vertices.tolist() == [0, 3, 6]
    assert groups["right"].vertices.tolist() == [2, 5, 8]
    assert groups["bottom"].edges.tolist() == [[0, 1], [1, 2]]
    assert groups["top"].vertices.tolist() == [6, 7, 8]
    assert groups["corners"].vertices.tolist() == [0, 2, 6, 8]
    assert len(groups["sheet"].triangles) == 16


@pytest.mark.parametrize(
    ("options", "key", "message"),
    [
        ({"nx": 10**9, "ny": 10**9}, "mesh.grid", r"1000000002000000001 vertices take about 1.86e\+12 GiB"),
        ({"nx": 30000, "ny": 30000, "pattern": "criss-cross"}, "mesh.grid", "1800060001 vertices take"),
    ],
)
def test_invalid_grids_are_refused(options: dict[str, object], key: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        grid_mesh(**options)
    assert caught.value.key == key
