"""Vertices that coincide without being connected, and vt in another unit: notes and remedies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mesh_sources import MeshSource, Transform, grid, mesh_of, rest_areas
from mpi4py import MPI
from physics import scene_of

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.build import build_mesh
from lyra_petsc.mesh.topology import connected_pieces
from lyra_petsc.mesh.weld import coincident_with
from lyra_petsc.phases import Phases
from lyra_petsc.stepping.problem import build_problem

SOUP = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 0 0\nv 1 1 0\nv 0 1 0\ng a\nf 1 2 3\ng b\nf 4 5 6\n"
UV = "v 0 0 0\nv 0.3 0 0\nv 0.3 1.2 0\nv 0 1.2 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n"


def write(folder: Path, text: str) -> Path:
    file = folder / "mesh.obj"
    file.write_text(text)
    return file


def test_points_that_coincide_are_those_of_a_comparison_of_all_pairs() -> None:
    random = np.random.default_rng(1)
    points = random.random((300, 3)) * [1.0, 2.0, 0.1] + [1e3, 0.0, 0.0]
    points = np.concatenate(
        [points, points[random.integers(0, 300, 80)] + random.uniform(-1e-7, 1e-7, (80, 3))]
    )
    points = points[random.permutation(len(points))]
    near = np.abs(points[:, None] - points[None]).max(axis=2) <= 1e-6
    assert coincident_with(points, 1e-6).tolist() == near.argmax(axis=1).tolist()
    assert coincident_with(points, 1e-12).tolist() == list(range(len(points)))


def test_a_soup_is_noted_and_welded(tmp_path: Path) -> None:
    file = write(tmp_path, SOUP)
    mesh = mesh_of(file)
    assert mesh.notes == [
        "the mesh is in 2 pieces; 2 vertices coincide with others without being connected (first: 3 and 0): "
        "mesh: {weld: 2e-06} joins them"
    ]
    welded = mesh_of(file, weld=1e-9)
    assert welded.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert welded.groups["b"].vertices.tolist() == [0, 2, 3]
    assert connected_pieces(welded.triangles).tolist() == [0, 0]
    assert connected_pieces(mesh.triangles).tolist() == [0, 1]
    assert welded.notes == ["mesh.obj: 2 vertices welded to others; vertices are numbered anew"]


def test_weld_is_a_length_after_the_scale_and_keeps_seams(tmp_path: Path) -> None:
    text = SOUP.replace("v 0 0 0\nv 1 1 0\nv 0 1", "v 0 0 0.01\nv 1 1 0\nv 0 1").replace(
        "g a\nf 1 2 3\ng b\nf 4 5 6",
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 7 0\nvt 8 1\nvt 7 1\nf 1/1 2/2 3/3\nf 4/4 5/5 6/6",
    )
    file, small = write(tmp_path, text), Transform(scale=0.1)
    welded = mesh_of(file, weld=2e-3, transform=small)
    assert welded.n_vertices == 4
    assert welded.triangle_uv[1].tolist() == [[7, 0], [8, 1], [7, 1]]
    assert mesh_of(file, weld=0.5e-3, transform=small).n_vertices == 5
    with pytest.raises(InputError, match=r"weld = 0\.2 m joins vertices of one triangle: 0, 1 .*give less"):
        mesh_of(file, weld=0.2, transform=small)


def test_sheets_side_by_side_are_not_connected() -> None:
    aside = Transform(translate=(1, 0, 0))
    mesh = build_mesh([MeshSource(grid=grid(ny=4)), MeshSource(grid=grid(ny=4), transform=aside)])
    assert len(mesh.coincident) == 0
    assert "in 2 pieces; 5 vertices coincide" in mesh.unconnected
    assert "put sheets that belong together into one" in mesh.unconnected
    assert mesh.notes == [mesh.unconnected]


def test_contact_names_the_same_remedy(tmp_path: Path) -> None:
    file = str(write(tmp_path, SOUP))

    def built(**more: object) -> None:
        build_problem(MPI.COMM_SELF, scene_of({"mesh": {"file": file} | more, "contact": {}}), Phases())

    with pytest.raises(InputError, match=r"2 vertices coincide .* mesh: \{weld: 2e-06\} joins") as caught:
        built()
    assert caught.value.key == "mesh"
    built(weld=1e-9)


def test_vt_of_another_unit_are_noted_ignored_or_scaled(tmp_path: Path) -> None:
    file = write(tmp_path, UV)
    note = mesh_of(file).notes[1]
    assert (
        "edges are 1.14 m long by vt and 0.912 m in space, and differ by a factor of 1.7 in the mean" in note
    )
    assert "mesh: {uv: ignore}" in note
    ignored = mesh_of(file, uv="ignore")
    assert not ignored.has_uv
    scaled = mesh_of(file, uv=[0.3, 1.2])
    for mesh in (ignored, scaled):
        assert rest_areas(mesh).sum() == pytest.approx(0.36)
        assert not any("by vt" in each for each in mesh.notes)
    assert rest_areas(mesh_of(file, uv=2)).sum() == pytest.approx(4.0)


def test_degenerate_vt_are_named(tmp_path: Path) -> None:
    file = write(tmp_path, "v 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")
    with pytest.raises(
        InputError, match=r"no area in the rest shape\): 0 .*which the vt give: mesh: \{uv: ignore\}"
    ):
        mesh_of(file)
    assert mesh_of(file, uv="ignore", weld=1e-9).notes == [
        "mesh.obj: no vertices coincide within weld = 1e-09 m"
    ]
