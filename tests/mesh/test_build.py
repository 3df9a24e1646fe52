"""Joining of sources, transforms, orientation, and refused meshes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mesh_sources import MeshSource, Transform, grid, grid_mesh, obj_mesh, rest_areas, turn

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.build import build_mesh
from lyra_petsc.mesh.topology import hinges


def obj(points: list[tuple[float, float, float]], faces: list[tuple[int, ...]]) -> str:
    """Text of an .obj with faces numbered from 0."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points]
    return "\n".join(lines + ["f " + " ".join(str(v + 1) for v in face) for face in faces])


def consistent(triangles: np.ndarray) -> bool:
    vertices, pairs = hinges(triangles)
    return all(
        (b, a) in {tuple(np.roll(triangles[second], -k)[:2]) for k in range(3)}
        for (a, b, _, _), (_, second) in zip(vertices, pairs, strict=True)
    )


def test_several_sheets_are_numbered_consecutively() -> None:
    up = Transform(translate=(0, 0, 1))
    mesh = build_mesh(
        [
            MeshSource(grid=grid(nx=1, ny=1), name="lower"),
            MeshSource(grid=grid(nx=2, ny=1), transform=up, name="upper"),
        ]
    )
    assert mesh.n_vertices == 4 + 6
    assert mesh.triangles.tolist()[2:] == [[4, 5, 8], [4, 8, 7], [5, 6, 9], [5, 9, 8]]
    assert mesh.groups["upper"].triangles.tolist() == [2, 3, 4, 5]
    assert mesh.groups["lower"].vertices.tolist() == [0, 1, 2, 3]
    assert mesh.groups["left"].vertices.tolist() == [0, 2, 4, 7]
    assert mesh.groups["upper/left"].vertices.tolist() == [4, 7]
    assert mesh.groups["upper/left"].edges.tolist() == [[4, 7]]
    assert (mesh.positions[4:, 2] == 1).all()
    assert (mesh.rest[4:, 2] == 0).all()


def test_transform_order_and_exact_right_angles() -> None:
    mesh = grid_mesh(Transform(scale=(2, 3, 1), rotate=turn((1, 0, 0), 90), translate=(0, 1, 0)), nx=1, ny=1)
    assert mesh.positions.tolist() == [[0, 1, 0], [2, 1, 0], [0, 1, 3], [2, 1, 3]]
    assert mesh.rest.tolist() == [[0, 0, 0], [2, 0, 0], [0, 3, 0], [2, 3, 0]]
    assert rest_areas(mesh).tolist() == [3, 3]


def test_inconsistently_oriented_triangles_are_reversed(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt 2 0\n"
    mesh = obj_mesh(tmp_path, text + "f 1/1 2/2 3/3\nf 1/1 4/4 3/3\nf 2/2 5/5 3/3\n")
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3], [1, 4, 2]]
    assert mesh.triangle_uv[1].tolist() == [[0, 0], [1, 1], [0, 1]]
    assert mesh.notes == ["mesh.obj: 1 of 3 triangles reversed for a consistent orientation"]


def test_random_orientations_are_repaired_for_each_part(tmp_path: Path) -> None:
    random = np.random.default_rng(7)
    grid = grid_mesh(nx=6, ny=5, pattern="criss-cross")
    faces = np.concatenate([grid.triangles, grid.triangles + grid.n_vertices])
    wrong = random.random(len(faces)) < 0.3
    faces[wrong] = faces[wrong][:, ::-1]
    points = np.concatenate([grid.positions, grid.positions + [0, 0, 1]])
    mesh = obj_mesh(tmp_path, obj([tuple(p) for p in points.tolist()], [tuple(f) for f in faces.tolist()]))
    assert consistent(mesh.triangles)
    x = mesh.positions[mesh.triangles]
    assert (np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])[:, 2] > 0).all()
    assert str(int(wrong.sum())) in mesh.notes[0]


def strip(n: int, twist: float) -> str:
    """A closed band of n quadrangles, twisted by ``twist`` times 180°."""
    points = []
    for i in range(n):
        around, tilt = 2 * np.pi * i / n, np.pi * twist * i / n
        for side in (-0.2, 0.2):
            radius = 1 + side * np.cos(tilt)
            points.append((radius * np.cos(around), radius * np.sin(around), side * np.sin(tilt)))
    points = [tuple(float(c) for c in p) for p in points]
    faces: list[tuple[int, ...]] = [(2 * i, 2 * i + 1, 2 * i + 3, 2 * i + 2) for i in range(n - 1)]
    last = 2 * n - 2
    faces.append((last, last + 1, 0, 1) if twist % 2 else (last, last + 1, 1, 0))
    return obj(points, faces)


def test_moebius_strip_is_refused_and_a_plain_band_is_not(tmp_path: Path) -> None:
    assert consistent(obj_mesh(tmp_path, strip(16, 0)).triangles)
    assert consistent(obj_mesh(tmp_path, strip(16, 2)).triangles)
    with pytest.raises(InputError, match=r"one side only .*triangles \d+-\d+"):
        obj_mesh(tmp_path, strip(16, 1))


CORNERS: list[tuple[float, float, float]] = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 0.5, 1)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (obj(CORNERS[:4], [(0, 1, 2), (0, 2, 3), (0, 1, 1)]), r"a vertex used twice\): 2 "),
        (obj(CORNERS[:4], [(0, 1, 2), (0, 2, 3), (2, 0, 1)]), "repeat another one: 2 "),
        (
            obj([(0.1, 0.2, 0.3), (0.2, 0.4, 0.6), (0.3, 0.6, 0.9)], [(0, 1, 2)]),
            "no area in the rest shape.: 0 ",
        ),
        (
            obj([(x + 1e4, 0.3 * x + 1e3, 0.7 * x) for x in (0.1, 0.23, 0.37)], [(0, 1, 2)]),
            "no area in the rest shape",
        ),
        (
            "v 0 0 0\nv 1 0 0\nv 2 0 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n",
            "no area in the start shape.: 0 ",
        ),
        (
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 1\nvt 2 2\nf 1/1 2/2 3/3\n",
            "no area in the rest shape.: 0 ",
        ),
        (obj([(0, 0, 0), (1e200, 0, 0), (0, 1e200, 0)], [(0, 1, 2)]), "too large"),
        (
            obj([(i, 0, 0) for i in range(24)], [(3 * i, 3 * i + 1, 3 * i + 2) for i in range(8)]),
            "0, 1, 2, 3, 4 and 3 more",
        ),
    ],
)
def test_degenerate_meshes_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        obj_mesh(tmp_path, text)
    assert caught.value.file == str(tmp_path / "mesh.obj")


@pytest.mark.parametrize("aspect", [1e3, 1e6])
@pytest.mark.parametrize("offset", [0.0, 10.0])
def test_slivers_and_small_triangles_are_accepted(tmp_path: Path, aspect: float, offset: float) -> None:
    text = obj([(offset, 0, 0), (offset + 1, 0, 0), (offset + 0.5, 1 / aspect, 0)], [(0, 1, 2)])
    assert rest_areas(obj_mesh(tmp_path, text))[0] == pytest.approx(0.5 / aspect)
    assert rest_areas(obj_mesh(tmp_path, text, Transform(scale=1e-6)))[0] == pytest.approx(0.5e-12 / aspect)
