"""Selection of vertices and triangles by group, number and box."""

from __future__ import annotations

import pytest
from mesh_sources import Transform, grid_mesh, turn

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.select import select_triangles, select_vertices
from lyra_petsc.scene.schema import Selector


def test_group_nodes_and_box() -> None:
    mesh = grid_mesh(nx=2, ny=2)
    assert select_vertices(mesh, Selector(group="left"), key="h").tolist() == [0, 3, 6]
    assert select_vertices(mesh, Selector(nodes=[8, 2]), key="h").tolist() == [2, 8]
    box = [[0.4, -1, -1], [2, 0.6, 1]]
    assert select_vertices(mesh, Selector(box=box), key="h").tolist() == [1, 2, 4, 5]


def test_box_selects_by_transformed_positions_and_includes_its_faces() -> None:
    turned = Transform(rotate=turn((0, 0, 1), 30.0), translate=(0.1, 0.2, 0.3))
    mesh = grid_mesh(transform=turned, nx=3, ny=3)
    x, y, z = mesh.positions[0]
    assert select_vertices(mesh, Selector(box=[[x, y, z], [x, y, z]]), key="h").tolist() == [0]


def test_triangles_of_surface_groups() -> None:
    mesh = grid_mesh(nx=2, ny=1)
    assert select_triangles(mesh, None, key="material").tolist() == [0, 1, 2, 3]
    assert select_triangles(mesh, "sheet", key="material").tolist() == [0, 1, 2, 3]
    with pytest.raises(InputError, match=r"curve group and has no triangles; surface groups: sheet"):
        select_triangles(mesh, "left", key="material[0].group")


@pytest.mark.parametrize(
    ("selector", "key", "message"),
    [
        (Selector(group="lefft"), "handles[0].group", "did you mean 'left'"),
        (Selector(nodes=[0, 9, 11]), "handles[0].nodes", r"no vertex 9, 11; the mesh has vertices 0 to 8"),
        (Selector(nodes=[2**31 - 2]), "handles[0].nodes", "vertices 0 to 8"),
        (Selector(box=[[2, 2, 2], [3, 3, 3]]), "handles[0].box", r"spans \[0, 0, 0\] to \[1, 1, 0\]"),
    ],
)
def test_invalid_selections_are_refused(selector: Selector, key: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        select_vertices(grid_mesh(), selector, key="handles[0]", file="scene.yaml")
    assert (caught.value.key, caught.value.file) == (key, "scene.yaml")
