"""Hinges and boundary edges."""

from __future__ import annotations

import numpy as np
from mesh_sources import grid_mesh

from lyra_petsc.mesh.topology import boundary_edges, enclosed_volumes, hinges, junctions


def test_hinges_agree_with_their_triangles() -> None:
    triangles = grid_mesh(nx=7, ny=5, pattern="alternating").triangles
    vertices, pairs = hinges(triangles)
    turns = {(t, *np.roll(triangle, -k)) for t, triangle in enumerate(triangles) for k in range(3)}
    for (a, b, c, d), (first, second) in zip(vertices, pairs, strict=True):
        assert (first, a, b, c) in turns
        assert (second, b, a, d) in turns
        assert first < second


def test_boundary_edges_have_the_direction_of_their_triangle_and_close() -> None:
    mesh = grid_mesh(nx=3, ny=2)
    edges, triangle, opposite = boundary_edges(mesh.triangles)
    assert sorted(edges[:, 0]) == sorted(edges[:, 1])
    for (a, b), t, c in zip(edges, triangle, opposite, strict=True):
        corners = mesh.triangles[t].tolist()
        assert (corners.index(a) + 1) % 3 == corners.index(b)
        assert {a, b, c} == set(corners)


def test_three_triangles_on_an_edge_are_a_junction_and_no_hinge() -> None:
    triangles = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [3, 0, 5]])
    assert hinges(triangles).triangles.tolist() == [[1, 3]]
    assert [found.tolist() for found in junctions(triangles)] == [[0, 1, 2]]
    assert junctions(triangles[1:]) == []


def test_volumes_of_a_tetrahedron_one_turned_inside_out_an_open_and_a_flat_one() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) + 5.0
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    flat = corners * [1.0, 1.0, 0.0]
    points = np.concatenate([corners, corners, corners, flat])
    triangles = np.concatenate([faces, faces[:, ::-1] + 4, faces[:3] + 8, faces + 12])
    piece = np.repeat([0, 1, 2, 3], [4, 4, 3, 4])
    np.testing.assert_allclose(enclosed_volumes(points, triangles, piece), [1 / 6, -1 / 6, 0, 0], atol=1e-15)
