"""The .obj reader."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mesh_sources import Transform, mesh_of, obj_mesh, rest_areas, turn

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.measures import rest_matrices
from lyra_petsc.output.mesh_file import vertex_uv

pytestmark = pytest.mark.quick

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
VT = "vt 0 0\nvt 2 0\nvt 2 2\nvt 0 2\n"


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 2 3\nf 1 3 4\n",
        "f 1//1 2//1 3//1\nf 1//1 3//1 4//1\n",
        "f -4 -3 -2\nf -4 -2 -1\n",
        "f 1 2 3 4\n",
        "f 1 2 \\\n 3\nf 1 3 4 # a comment\nl 1 2\nvn 0 0 1\ns off\nusemtl red\n",
    ],
)
def test_without_vt_the_scaled_mesh_is_the_rest_shape(tmp_path: Path, faces: str) -> None:
    mesh = obj_mesh(
        tmp_path, SQUARE + faces, Transform(scale=2.0, rotate=turn((1, 0, 0), 90), translate=(5, 0, 0))
    )
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.rest.tolist() == [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]
    assert mesh.positions.tolist() == [[5, 0, 0], [7, 0, 0], [7, 0, 2], [5, 0, 2]]
    assert mesh.triangle_uv.tolist() == mesh.rest[mesh.triangles][:, :, :2].tolist()
    assert not mesh.has_uv
    assert not mesh.flat_rest.any()


@pytest.mark.parametrize(
    "faces", ["f 1/1 2/2 3/3 4/4\n", "f 1/1/1 2/2/1 3/3/1 4/4/1\n", "f -4/-4 -3/-3 -2/-2 -1/-1\n"]
)
def test_vt_are_the_rest_shape_whatever_the_transform(tmp_path: Path, faces: str) -> None:
    mesh = obj_mesh(tmp_path, SQUARE + VT + faces, Transform(scale=3.0, translate=(0, 0, 1)))
    assert mesh.rest.tolist() == [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]
    assert mesh.positions[2].tolist() == [3, 3, 1]
    assert rest_areas(mesh).tolist() == [2, 2]
    assert mesh.has_uv
    assert mesh.flat_rest.all()
    assert vertex_uv(mesh) is not None


def test_seam_gives_corners_their_own_material_coordinates(tmp_path: Path) -> None:
    text = SQUARE + "vt 0 0\nvt 1 0\nvt 1 1\nvt 5 0\nvt 6 1\nvt 5 1\n" + "f 1/1 2/2 3/3\nf 1/4 3/5 4/6\n"
    mesh = obj_mesh(tmp_path, text, Transform(scale=2.0))
    assert vertex_uv(mesh) is None
    assert mesh.triangle_uv.tolist() == [[[0, 0], [1, 0], [1, 1]], [[5, 0], [6, 1], [5, 1]]]
    assert mesh.rest.tolist() == mesh.positions.tolist()
    assert mesh.flat_rest.all()


def test_mirrored_vt_keep_areas_and_give_positive_matrices(tmp_path: Path) -> None:
    mesh = obj_mesh(tmp_path, SQUARE + "vt 0 0\nvt -2 0\nvt -2 2\nvt 0 2\nf 1/1 2/2 3/3 4/4\n")
    inverse, area = rest_matrices(mesh)
    assert area.tolist() == [2, 2]
    assert (np.linalg.det(inverse) > 0).all()
    assert mesh.triangle_uv[0].tolist() == [[0, 0], [-2, 0], [-2, 2]]


def test_groups_and_objects_name_surfaces(tmp_path: Path) -> None:
    text = SQUARE + "o sail cloth\ng low both\nf 1 2 3\ng high both\nf 1 3 4\n"
    groups = obj_mesh(tmp_path, text).groups
    assert groups["low"].triangles.tolist() == [0]
    assert groups["high"].vertices.tolist() == [0, 2, 3]
    assert groups["both"].triangles.tolist() == [0, 1]
    assert groups["sail cloth"].triangles.tolist() == [0, 1]


def test_lines_in_a_group_name_curves(tmp_path: Path) -> None:
    curves = "g hem low\nl 2/1 3/1 -2\ng hem\nl 5 4\nl 1 2\ng\nl 5 2\n"
    text = "o sail\nv 9 9 9\n" + SQUARE + "f 2 3 4 5\n" + curves
    groups = obj_mesh(tmp_path, text).groups
    assert groups["hem"].dimension == 1
    assert groups["hem"].edges.tolist() == [[0, 1], [1, 2], [2, 3]]  # that of the dropped vertex is left out
    assert groups["low"].edges.tolist() == [[0, 1], [1, 2]]
    assert groups["sail"].dimension == 2
    assert set(groups) == {"hem", "low", "sail"}


@pytest.mark.parametrize(
    ("line", "words"),
    [("l 1", "at least two"), ("l 1 0", "no vertex 0"), ("l 1 9", "no vertex 9 for the edges")],
)
def test_lines_that_are_no_edges_are_refused(tmp_path: Path, line: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        obj_mesh(tmp_path, SQUARE + f"f 1 2 3 4\ng hem\n{line}\n")


def test_materials_name_surfaces_beside_objects(tmp_path: Path) -> None:
    text = "o Shirt\n" + SQUARE + "usemtl heavy denim\nf 1 2 3\ng collar\nusemtl cotton\nf 1 3 4\n"
    groups = obj_mesh(tmp_path, text).groups
    assert {name: group.triangles.tolist() for name, group in groups.items()} == {
        "heavy denim": [0],
        "cotton": [1],
        "collar": [1],
        "Shirt": [0, 1],
    }


def test_unused_vertices_are_dropped_with_a_note(tmp_path: Path) -> None:
    mesh = obj_mesh(tmp_path, "v 9 9 9\n" + SQUARE + "v 8 8 8\ng low\nf 2 3 4\ng high\nf 2 4 5\n")
    assert mesh.positions.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.groups["high"].vertices.tolist() == [0, 2, 3]
    note = "2 vertices that are in no triangle dropped (0, 5, counted from 0; later ones are numbered anew)"
    assert mesh.notes == [f"mesh.obj: {note}"]


def test_quads_split_on_the_shorter_diagonal_inside(tmp_path: Path) -> None:
    kite = "v 0 0 0\nv 1 -0.2 0\nv 2 0 0\nv 1 0.2 0\nf 1 2 3 4\n"
    assert obj_mesh(tmp_path, kite).triangles.tolist() == [[0, 1, 3], [1, 2, 3]]
    # arrow head: the shorter diagonal lies outside
    arrow = "v 0 0 0\nv 4 2 0\nv 0 4 0\nv 3 2 0\nf 1 2 3 4\n"
    assert rest_areas(obj_mesh(tmp_path, arrow)).sum() == pytest.approx(2.0)


def test_polygon_with_points_on_a_line(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\nf 1 2 3 4 5\n"
    mesh = obj_mesh(tmp_path, text)
    assert rest_areas(mesh).sum() == pytest.approx(2.0)
    assert mesh.notes == ["mesh.obj: 1 faces with more than three corners split into triangles"]


def test_windows_line_ends_byte_order_mark_and_latin_comments(tmp_path: Path) -> None:
    file = tmp_path / "a.OBJ"
    file.write_bytes(
        b"\xef\xbb\xbf# na\xefve\r\n" + (SQUARE + "f 1 2 3\nf 1 3 4\n").replace("\n", "\r\n").encode()
    )
    assert mesh_of(file).n_triangles == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SQUARE + "f 1 2 5\n", "line 5: no vertex 5; the file has 4"),
        (SQUARE + "f 1 2 0\n", r"line 5: .*no vertex 0"),
        (SQUARE + "f 1 2 -9\n", r"line 5: .*no vertex -9"),
        (SQUARE + "f 1 2\n", "line 5: .*at least three corners"),
        (SQUARE + "f 1 2 x\n", "line 5: 'f 1 2 x' cannot be read"),
        (SQUARE + f"f 1 2 {10**30}\n", "line 5"),
        (SQUARE + VT + "f 1/1 2/2 3/9\n", "line 9: no vt 9; the file has 4"),
        (SQUARE + VT + "f 1/1 2/2 3/3\nf 1 3 4\n", "with and without vt .*lines 10"),
        ("v 0 0\n", "line 1"),
        ("v 0 0 zero\n", "line 1"),
        (SQUARE, "no triangles"),
        (SQUARE + "v nan 0 0\nf 1 2 3\nf 1 3 4 5\n", "not finite: vertices 4"),
        (SQUARE + "vt 0 0\nvt inf 0\nvt 1 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/1\n", "vt that are not finite"),
        ("\0\1\2", "no text file"),
        ("  \n", "empty"),
    ],
)
def test_invalid_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        obj_mesh(tmp_path, text)
    assert caught.value.file == str(tmp_path / "mesh.obj")
