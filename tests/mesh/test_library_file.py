"""Mesh formats of other programs: what is read, and that nothing is lost without a word."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from mesh_sources import mesh_of, rest_areas

from lyra_petsc.errors import InputError
from lyra_petsc.mesh import library_file
from lyra_petsc.mesh.library_formats import LIBRARIES
from lyra_petsc.scene.schema import MESH_SUFFIXES

pytest.importorskip("meshio")
pytest.importorskip("vtkmodules.vtkIOLegacy")

POINTS = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (1, 1, 0), (2, 1, 0)]
ROWS = "\n".join(f"{x} {y} {z}" for x, y, z in POINTS)
TRIANGLES = [(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4)]


def facet(corners: tuple[int, ...]) -> str:
    vertices = "\n".join("vertex {} {} {}".format(*POINTS[corner]) for corner in corners)
    return f"facet normal 0 0 1\nouter loop\n{vertices}\nendloop\nendfacet\n"


def binary_stl() -> bytes:
    facets = (np.array([[0, 0, 1], *(POINTS[c] for c in corners)], "<f4").tobytes() for corners in TRIANGLES)
    return b"solid".ljust(80) + struct.pack("<I", 4) + b"".join(one + b"\0\0" for one in facets)


STL = "solid a\n" + "".join(map(facet, TRIANGLES)) + "endsolid a\n"
PLY = f"""ply
format ascii 1.0
element vertex 6
property double x
property double y
property double z
element face 3
property list uchar int vertex_indices
end_header
{ROWS}
3 0 1 4
3 0 4 3
4 1 2 5 4
"""
OFF = f"OFF\n# two squares\n6 4 0\n{ROWS}\n3 0 1 4\n3 0 4 3\n3 1 2 5\n3 1 5 4\n"
POLYDATA = f"""# vtk DataFile Version 4.2
two squares
ASCII
DATASET POLYDATA
POINTS 6 double
{ROWS}
POLYGONS 2 10
4 0 1 4 3
4 1 2 5 4
"""
GRID = f"""# vtk DataFile Version 5.1
two squares
ASCII
DATASET UNSTRUCTURED_GRID
POINTS 6 double
{ROWS}
CELLS 5 12
OFFSETS vtktypeint64
0 2 5 8 12
CONNECTIVITY vtktypeint64
0 3 0 1 4 0 4 3 1 2 5 4
CELL_TYPES 4
3
5
5
9
"""
NODES = "\n".join(f"{10 * n + 10}, {x}., {y}., {z}." for n, (x, y, z) in enumerate(POINTS))
INP = f"""*HEADING
*NODE, NSET=all
{NODES}
*ELEMENT, TYPE=S3
1, 10, 20, 50
2, 10, 50, 40
*ELEMENT, TYPE=S4R, ELSET=east
7, 20, 30, 60, 50
*ELSET, ELSET=low
1, 7
*NSET, NSET=far
30, 60
"""
BDF = "\n".join(
    [
        *(f"GRID,{n + 10},,{x}.,{y}.,{z}." for n, (x, y, z) in enumerate(POINTS)),
        "CTRIA3,1,5,10,11,14",
        "CTRIA3,2,5,10,14,13",
        "CQUAD4,3,6,11,12,15,14",
        "ENDDATA\n",
    ]
)
UNV = """    -1
  2411
{nodes}
    -1
    -1
  2412
         1        21         2         1         7         2
         0         1         1
         1         4
         2        91         2         1         7         3
         1         2         5
         3        91         2         1         7         3
         1         5         4
         4        94         2         1         7         4
         2         3         6         5
    -1
""".format(
    nodes="\n".join(
        f"{n + 1:10d}         1         1        11\n" + "".join(f"{value:25.16E}" for value in point)
        for n, point in enumerate(POINTS)
    )
)
FILES: dict[str, bytes] = {
    "text.stl": STL.encode(),
    "binary.stl": binary_stl(),
    "quad.ply": PLY.encode(),
    "two.off": OFF.encode(),
    "polygons.vtk": POLYDATA.encode(),
    "grid.VTK": GRID.encode(),
    "sets.inp": INP.encode(),
    "free.bdf": BDF.encode(),
    "two.unv": UNV.encode(),
}


def test_each_format_of_the_schema_has_a_library() -> None:
    assert set(MESH_SUFFIXES) == {".msh", ".obj", *LIBRARIES}


@pytest.mark.parametrize("name", FILES)
def test_two_squares(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.write_bytes(FILES[name])
    mesh = mesh_of(file)
    assert mesh.n_triangles == 4
    assert rest_areas(mesh).sum() == pytest.approx(2.0)
    if not name.endswith("stl"):
        assert mesh.positions.tolist() == [list(map(float, point)) for point in POINTS]
    assert len(mesh.positions) == 6
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("other.ply", PLY.replace("vertex_indices", "vertex_index")),
        ("upper.stl", STL.upper()),
        ("line.off", OFF.replace("OFF\n# two squares\n6 4 0", "OFF  6 4  0 # two squares")),
        ("lower.bdf", BDF.lower()),
        ("membrane.inp", INP.replace("TYPE=S3", "type=m3d3").replace("S4R", "CPE4")),
        ("comment.inp", INP.replace("30, 2., 0., 0.", "** a comment\n30, 2., 0., 0.")),
    ],
)
def test_other_spellings(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    assert text not in [content.decode("latin-1") for content in FILES.values()]
    assert rest_areas(mesh_of(tmp_path / name)).sum() == pytest.approx(2.0)


def test_sets_of_abaqus_and_properties_of_nastran_are_groups(tmp_path: Path) -> None:
    for name in ("sets.inp", "free.bdf"):
        (tmp_path / name).write_bytes(FILES[name])
    groups = mesh_of(tmp_path / "sets.inp").groups
    assert groups["east"].triangles.tolist() == [2, 3]
    assert groups["low"].triangles.tolist() == [0, 2, 3]
    assert groups["far"].vertices.tolist() == [2, 5]
    groups = mesh_of(tmp_path / "free.bdf").groups
    assert groups["5"].triangles.tolist() == [0, 1]
    assert groups["6"].triangles.tolist() == [2, 3]


def test_a_polygon_of_five_corners_and_an_unused_point(tmp_path: Path) -> None:
    file = tmp_path / "five.ply"
    file.write_text(PLY.replace("face 3", "face 1").replace("3 0 1 4\n3 0 4 3\n4 1 2 5 4\n", "5 0 1 2 4 3\n"))
    mesh = mesh_of(file)
    assert rest_areas(mesh).sum() == pytest.approx(1.5)
    assert mesh.notes == [
        "five.ply: 1 polygons split into triangles",
        "five.ply: 1 vertex that is in no triangle dropped (5, counted from 0)",
    ]


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("text.stl", "endsolid a", "", "is cut short: 'endsolid' is missing"),
        ("text.stl", "vertex 1 0 0", "vertex one 0 0", "meshio cannot read it"),
        ("binary.stl", b"solid", b"", "is no STL"),
        ("quad.ply", "end_header", "end", "header has no number of vertices and faces, or does not end"),
        ("quad.ply", "vertex_indices", "corners", "meshio cannot read it"),
        ("quad.ply", "3 0 4 3\n4 1 2 5 4\n", "3 0 4 3\n", "meshio cannot read it"),
        ("quad.ply", "3 0 4 3", "3 0 4 6", "points that it does not have: 6"),
        ("two.off", "6 4 0", "6 4", "points that it does not have|meshio cannot read it"),
        ("two.off", "3 1 5 4", "4 1 5 4 2", "meshio cannot read it"),
        ("polygons.vtk", "4 1 2 5 4", "4 1 2 5 9", "points that it does not have: 9"),
        ("polygons.vtk", "4 1 2 5 4", "", "vtk reads 0 of the 2 elements|cannot read"),
        ("grid.VTK", "3\n5\n5\n9", "3\n5\n5\n42", "elements of the type 42 of VTK are not read"),
        ("sets.inp", "S4R", "S7", "Element type not available: S7"),
        ("sets.inp", "20, 30, 60, 50", "20, 30, 99, 50", "99 is used and not defined"),
        ("sets.inp", "60, 2., 1., 0.", "50, 2., 1., 0.", "several nodes of one number"),
        (
            "sets.inp",
            "*ELEMENT, TYPE=S4R",
            "*NODE\n90, 0., 0., 0.\n*ELEMENT, TYPE=S4R",
            "is used|of the 7 points",
        ),
        ("sets.inp", "*ELSET", "*INSTANCE, NAME=a, PART=p\n1., 0., 0.\n*ELSET", "moves its part"),
        ("free.bdf", "ENDDATA", "", "ENDDATA is missing"),
        ("free.bdf", "CTRIA3,2", "CTRIA3*,2", "meshio reads 2 of the 3 elements"),
        ("free.bdf", "GRID,15,,", "GRID,15,8,", "coordinate systems of their own"),
        ("free.bdf", "GRID,15,,", "GRID,14,,", "several points of one number|15 is used"),
        ("two.unv", "    -1\n    -1", "", "gmsh"),
        ("two.unv", "        94 ", "       999 ", "gmsh"),
    ],
)
def test_damaged_and_lossy_files_are_refused_in_one_line(
    tmp_path: Path, name: str, old: str | bytes, new: str | bytes, message: str
) -> None:
    file = tmp_path / name
    old, new = (text if isinstance(text, bytes) else text.encode() for text in (old, new))
    assert old in FILES[name]
    file.write_bytes(FILES[name].replace(old, new))
    with pytest.raises(InputError, match=message) as caught:
        mesh_of(file)
    assert caught.value.file == str(file)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", FILES)
def test_truncated_files_are_refused(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library_file, "READ_SECONDS", 5)
    # an Abaqus file has no end, and may be cut between two sets
    file, whole = tmp_path / name, FILES[name].split(b"*ELSET")[0].rstrip()
    for length in (len(whole) // 2, len(whole) * 5 // 6, len(whole) - 3):
        file.write_bytes(whole[:length])
        with pytest.raises(InputError) as caught:
            mesh_of(file)
        assert "\n" not in str(caught.value)
        assert not {"ended early", "did not finish"} & set(str(caught.value).split(": "))


def test_solid_elements_are_named(tmp_path: Path) -> None:
    file = tmp_path / "solid.inp"
    file.write_text(INP[: INP.index("*ELEMENT")] + "*ELEMENT, TYPE=C3D4\n1, 10, 20, 50, 60\n")
    with pytest.raises(InputError, match="only solid elements"):
        mesh_of(file)
    file.write_text(INP + "*ELEMENT, TYPE=C3D4\n8, 10, 20, 50, 60\n")
    assert "solid.inp: 1 solid elements left out" in mesh_of(file).notes
