"""Obstacles: shapes and motions, and agreement of all ranks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.mesh.obstacles import Container, Solid, build_scene_obstacles
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.load import scene_of
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.handles.motion import Motion

pytestmark = [pytest.mark.parallel(2), pytest.mark.quick]

ROLL = [
    {"time": 0.5, "translate": [1, 0, 0], "rotate": {"axis": [0, 0, 1], "degrees": 30}},
    {"time": 1.5, "translate": [1, 2, 0], "rotate": {"axis": [0, 0, 1], "degrees": 750}},
    {"time": 2.0, "translate": [1, 2, 3], "rotate": {"axis": [0, 0, 1], "degrees": 750}},
]
BOX = {"box": {"min": [0, -1, 2], "max": [1, 3, 4]}}
CAPSULE = {"capsule": {"from": [0, 0, 1], "to": [0, 2, 1], "radius": 0.25}}
SPHERE = {"sphere": {"center": [3, 2, 1], "radius": 0.5}}
PLANE = {"plane": {"point": [0, 0, 1], "normal": [0, 3e200, 4e200]}}

# a tetrahedron with a point that no face has, and a face that is listed as a polygon of three
OBJ = "v 9 9 9\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 2 4 3\nf 2 3 5\nf 3 4 5\nf 4 2 5\n"
GEO = """Point(1) = {0, 0, 0}; Point(2) = {1, 0, 0}; Point(3) = {1, 1, 0}; Point(4) = {0, 1, 0};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1}; Mesh.MeshSizeMax = 0.3;
"""
MSH = """$MeshFormat
2.2 0 8
$EndMeshFormat
$Nodes
4
1 0 0 0
2 1 0 0
3 0 1 0
4 0 0 1
$EndNodes
$Elements
2
1 2 2 0 1 1 2 3
2 2 2 0 1 1 2 4
$EndElements
"""
FILES = {"body.obj": OBJ, "body.msh": MSH, "body.geo": GEO}


def scene(obstacle: dict[str, Any], **more: Any) -> Scene:
    blocks = {
        "mesh": {"grid": {"width": 1, "height": 1, "nx": 1, "ny": 1}},
        "material": {"cloth": "paper"},
        "time": {"end": 1, "step": 0.1},
        "contact": {"friction": {"static": 0.4, "kinetic": 0.3}},
        "obstacles": {"one": obstacle},
    }
    return scene_of(blocks | more)


def built(comm: MPI.Comm, obstacle: dict[str, Any], **more: Any) -> Solid | Container:
    whole = scene(obstacle, **more)
    mesh = on_root(comm, lambda: build_scene_mesh(whole), share=False)
    (one,) = build_scene_obstacles(comm, whole, mesh, Motion)
    return one


def signed_volume(x: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = np.moveaxis(x[triangles], 1, 0)
    return float((np.cross(a, b) * c).sum() / 6.0)


def test_a_box_is_a_closed_body(comm: MPI.Comm) -> None:
    box = built(comm, BOX)
    assert isinstance(box, Solid)
    assert box.radius == 0.0
    assert (len(box.points), len(box.edges), len(box.triangles)) == (8, 12, 12)
    assert signed_volume(box.points, box.triangles) == pytest.approx(1 * 4 * 2)
    along = np.abs(box.points[box.edges[:, 0]] - box.points[box.edges[:, 1]])
    assert ((along > 0).sum(axis=1) == 1).all()  # no diagonals
    assert sorted(along.max(axis=1).tolist()) == [1] * 4 + [2] * 4 + [4] * 4
    sides = np.concatenate([box.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    assert len(np.unique(sides, axis=0)) == 36  # each side is run along once in each direction
    assert {tuple(side) for side in sides.tolist()} == {tuple(side) for side in sides[:, ::-1].tolist()}


def test_a_box_is_a_container_of_six_planes(comm: MPI.Comm) -> None:
    box = built(comm, {**BOX, "inside": True})
    assert isinstance(box, Container)
    assert (box.kind, box.radius) == ("planes", 0.0)
    inner = np.array([0.1, -0.9, 2.1]), np.array([0.9, 2.9, 3.9])
    for place in inner:
        assert sorted(((place - box.points) * box.normals).sum(axis=1).round(12).tolist())[:3] == [0.1] * 3
    for outside in np.concatenate([np.eye(3) * 9, np.eye(3) * -9]):
        assert (((outside - box.points) * box.normals).sum(axis=1) < 0).any()


def test_sphere_and_capsule_keep_a_distance_from_point_and_edge(comm: MPI.Comm) -> None:
    ball, rod = built(comm, SPHERE), built(comm, CAPSULE)
    assert isinstance(ball, Solid)
    assert isinstance(rod, Solid)
    assert (ball.points.tolist(), ball.edges.shape, ball.triangles.shape) == ([[3, 2, 1]], (0, 2), (0, 3))
    assert (rod.points.tolist(), rod.edges.tolist()) == ([[0, 0, 1], [0, 2, 1]], [[0, 1]])
    assert rod.triangles.shape == (0, 3)
    assert (ball.radius, rod.radius) == (0.5, 0.25)
    for kind, points in ((SPHERE, ball.points), (CAPSULE, rod.points)):
        inside = built(comm, {**kind, "inside": True})
        assert isinstance(inside, Container)
        assert inside.kind == "ball"
        assert inside.points.tolist() == points.tolist()
        assert inside.normals_at(0.3).shape == (0, 3)
    assert all(each.points.dtype == np.float64 for each in (ball, rod))
    assert all(each.edges.dtype == each.triangles.dtype == np.int64 for each in (ball, rod))


def test_friction_of_an_obstacle_overrides_that_of_contact(comm: MPI.Comm) -> None:
    assert built(comm, BOX).friction == (0.4, 0.3)
    assert built(comm, {**BOX, "friction": 0.7}).friction == (0.7, 0.7)
    assert built(comm, {**BOX, "friction": {"static": 0.2, "kinetic": 0.1}}).friction == (0.2, 0.1)
    assert built(comm, BOX, contact={"gap": 1}).friction == (0.0, 0.0)


@pytest.mark.parametrize("named", [True, False])
def test_a_motion_is_relative_to_the_placement_in_the_scene(comm: MPI.Comm, named: bool) -> None:
    """T(t) T(0)⁻¹, as for handles, compared with explicit rotations and translations."""
    moves = {"motion": "roll" if named else ROLL, "interpolation": "linear"}
    rod, plane = (
        built(comm, {**shape, **moves}, motions={"roll": ROLL} if named else {}) for shape in (CAPSULE, PLANE)
    )
    assert isinstance(plane, Container)
    np.testing.assert_allclose(rod.positions(0.0), rod.points, rtol=0, atol=1e-15)
    for time, turned, shift in (
        (0.3, 0.0, [0, 0, 0]),
        (1.0, 360.0, [0, 1, 0]),
        (1.25, 540.0, [0, 1.5, 0]),
        (1.625, 720.0, [0, 2, 0.75]),
        (9.0, 720.0, [0, 2, 3]),
    ):
        c, s = np.cos(np.radians(turned)), np.sin(np.radians(turned))
        rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        # the translation follows the rotation about the origin
        expected = (rod.points - [1, 0, 0]) @ rotation.T + [1, 0, 0] + shift
        np.testing.assert_allclose(rod.positions(time), expected, rtol=0, atol=1e-13)
        np.testing.assert_allclose(plane.normals_at(time), [rotation @ plane.normals[0]], rtol=0, atol=1e-13)
    moved = rod.positions(0.9)
    assert np.linalg.norm(moved[1] - moved[0]) == pytest.approx(2.0, abs=1e-13)  # rigid


@pytest.mark.parametrize("name", FILES)
def test_every_kind_of_mesh_file(comm: MPI.Comm, shared_tmp: Path, name: str) -> None:
    if name.endswith("geo"):
        pytest.importorskip("gmsh")
    if comm.rank == 0:
        (shared_tmp / name).write_text(FILES[name])
    comm.barrier()
    transform = {"scale": [2, 2, 1], "rotate": {"axis": [0, 0, 1], "degrees": 90}, "translate": [0, 0, 5]}
    plain, placed = (
        built(comm, {"mesh": {"file": str(shared_tmp / name), "transform": each}}) for each in ({}, transform)
    )
    assert isinstance(plain, Solid)
    assert isinstance(placed, Solid)
    assert plain.radius == 0.0
    x, y, z = plain.points.T
    np.testing.assert_allclose(placed.points, np.stack([-2 * y, 2 * x, z + 5], axis=1), atol=1e-14)
    np.testing.assert_array_equal(placed.triangles, plain.triangles)
    sides = np.sort(np.concatenate([plain.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1)
    assert {tuple(edge) for edge in plain.edges.tolist()} == {tuple(side) for side in sides.tolist()}
    assert len(plain.edges) == len(np.unique(plain.edges, axis=0))
    assert set(plain.triangles.ravel()) == set(range(len(plain.points)))
    if name == "body.obj":
        assert (len(plain.points), len(plain.edges), len(plain.triangles)) == (4, 6, 4)
        assert signed_volume(plain.points, plain.triangles) == pytest.approx(1 / 6)
    elif name == "body.msh":
        assert (len(plain.points), len(plain.edges)) == (4, 5)
    else:
        area = np.cross(*np.moveaxis(np.diff(plain.points[plain.triangles], axis=1), 1, 0))[:, 2].sum() / 2
        assert abs(area) == pytest.approx(1.0)
    for array in (placed.points, placed.edges, placed.triangles):
        assert len({each.tobytes() for each in comm.allgather(array)}) == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no area in the start shape"),
        ("v 0 0 0\nv 1 0 nan\nv 2 0 0\nf 1 2 3\n", "not finite"),
        ("v 0 0 0\n", "no faces"),
    ],
)
def test_a_bad_mesh_is_refused_on_all_ranks(comm: MPI.Comm, shared_tmp: Path, text: str, words: str) -> None:
    file = shared_tmp / "body.obj"
    if comm.rank == 0:
        file.write_text(text)
    comm.barrier()
    with pytest.raises(InputError, match=words) as caught:
        built(comm, {"mesh": {"file": str(file)}})
    assert "body.obj" in str(caught.value)


def test_invalid_motions_are_refused(comm: MPI.Comm) -> None:
    frames = [{"time": 0}, {"time": 1e-9, "translate": [1, 0, 0]}]
    with pytest.raises(InputError, match=r"obstacles\.one\.motion: goes at 1e\+09 m/s"):
        built(comm, {**BOX, "motion": frames})
