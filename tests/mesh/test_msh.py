"""The .msh reader: both versions, ASCII and binary, files by gmsh and by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from mesh_sources import mesh_of, rest_areas

from lyra_petsc.errors import InputError

pytestmark = pytest.mark.quick

gmsh_module = pytest.importorskip("gmsh")

FORMATS = [(version, binary) for version in (2.2, 4.1) for binary in (0, 1)]


@pytest.fixture
def gmsh() -> Iterator[ModuleType]:
    gmsh_module.initialize(readConfigFiles=False)
    gmsh_module.option.setNumber("General.Terminal", 0)
    yield gmsh_module
    gmsh_module.finalize()


@pytest.fixture
def two_squares(gmsh: ModuleType) -> Callable[..., None]:
    """Two unit squares side by side; groups that share elements, names and numbers."""

    def write(file: Path, version: float, binary: int, **options: float) -> None:
        occ, model = gmsh.model.geo, gmsh.model
        points = [occ.addPoint(x, y, 0, 0.4) for y in (0, 1) for x in (0, 1, 2)]
        ends = [(0, 1), (1, 4), (4, 3), (3, 0), (1, 2), (2, 5), (5, 4)]
        lines = [occ.addLine(points[a], points[b]) for a, b in ends]
        occ.addPlaneSurface([occ.addCurveLoop(lines[:4])])
        occ.addPlaneSurface([occ.addCurveLoop([lines[4], lines[5], lines[6], -lines[1]])])
        occ.synchronize()
        model.setPhysicalName(2, model.addPhysicalGroup(2, [1, 2], 11), "both")
        model.setPhysicalName(2, model.addPhysicalGroup(2, [2], 12), "east")
        model.addPhysicalGroup(2, [1], 7)
        model.setPhysicalName(1, model.addPhysicalGroup(1, [lines[3], lines[5]], 13), "ends")
        model.setPhysicalName(0, model.addPhysicalGroup(0, [points[2], points[5]], 14), "far corners")
        for name, value in options.items():
            gmsh.option.setNumber(f"Mesh.{name}", value)
        model.mesh.generate(2)
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.option.setNumber("Mesh.Binary", binary)
        gmsh.write(str(file))

    return write


@pytest.mark.parametrize(("version", "binary"), FORMATS)
def test_groups_and_node_order(
    tmp_path: Path, gmsh: ModuleType, two_squares: Callable[..., None], version: float, binary: int
) -> None:
    file = tmp_path / "two.msh"
    two_squares(file, version, binary)
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    mesh = mesh_of(file)
    assert mesh.notes == []
    assert rest_areas(mesh).sum() == pytest.approx(2.0)
    assert np.allclose(mesh.positions, coordinates.reshape(-1, 3))  # gmsh writes its order of nodes
    assert len(tags) == mesh.n_vertices
    groups = mesh.groups
    assert sorted(groups) == ["7", "both", "east", "ends", "far corners"]
    centre = mesh.positions[mesh.triangles].mean(axis=1)
    assert set(groups["east"].triangles) == set(np.flatnonzero(centre[:, 0] > 1))
    assert set(groups["7"].triangles) == set(np.flatnonzero(centre[:, 0] < 1))
    assert len(groups["both"].triangles) == mesh.n_triangles
    assert set(np.unique(mesh.positions[groups["ends"].vertices, 0])) == {0.0, 2.0}
    assert [groups[name].dimension for name in ("both", "ends", "far corners")] == [2, 1, 0]
    assert mesh.positions[groups["far corners"].vertices].tolist() == [[2, 0, 0], [2, 1, 0]]
    assert len(groups["ends"].edges) == len(groups["ends"].vertices) - 2


@pytest.mark.parametrize(("version", "binary"), FORMATS)
def test_quads_and_second_order(
    tmp_path: Path, two_squares: Callable[..., None], version: float, binary: int
) -> None:
    file = tmp_path / "quads.msh"
    two_squares(file, version, binary, RecombineAll=1, ElementOrder=2)
    mesh = mesh_of(file)
    text = " ".join(mesh.notes)
    assert "quads split" in text
    assert "higher order reduced to their corners" in text
    assert "dropped" in text
    assert rest_areas(mesh).sum() == pytest.approx(2.0)
    assert rest_areas(mesh)[mesh.groups["east"].triangles].sum() == pytest.approx(1.0)
    assert len(mesh.groups["ends"].vertices) == len(mesh.groups["ends"].edges) + 2


@pytest.mark.parametrize(("version", "binary"), FORMATS)
def test_truncated_files_are_refused(
    tmp_path: Path, two_squares: Callable[..., None], version: float, binary: int
) -> None:
    whole, part = tmp_path / "whole.msh", tmp_path / "part.msh"
    two_squares(whole, version, binary)
    data = whole.read_bytes()
    last = data.rindex(b"$EndElements") + len(b"$EndElements")
    for length in range(1, last, max(1, last // 60)):
        part.write_bytes(data[:length])
        with pytest.raises(InputError) as caught:
            mesh_of(part)
        assert caught.value.file == str(part)
        assert "\n" not in str(caught.value)


def ascii_2(nodes: str, elements: str, names: str = "") -> str:
    return (
        f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n{names}"
        f"$Nodes\n{len(nodes.split(';'))}\n{nodes.replace(';', chr(10))}\n$EndNodes\n"
        f"$Elements\n{len(elements.split(';'))}\n{elements.replace(';', chr(10))}\n$EndElements\n"
    )


NODES = "40 0 0 0;7 1 0 0;99 9 9 9;3 1 1 0;12 0 1 0"


def test_shuffled_tags_keep_file_order_and_loose_nodes_are_dropped(tmp_path: Path) -> None:
    file = tmp_path / "shuffled.msh"
    file.write_text(ascii_2(NODES, "1 2 2 0 1 40 7 3;2 2 2 0 1 40 3 12"))
    mesh = mesh_of(file)
    assert mesh.positions.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.notes == [
        "shuffled.msh: 1 vertex that is in no triangle dropped (tag 99; later ones are numbered anew)"
    ]


def test_one_name_for_two_dimensions_gives_a_note(tmp_path: Path) -> None:
    file = tmp_path / "clash.msh"
    file.write_text(ascii_2(NODES, "1 1 2 5 1 40 7;2 2 2 5 1 40 7 3;3 2 2 5 1 40 3 12"))
    mesh = mesh_of(file)
    assert mesh.groups["5"].dimension == 2
    assert mesh.groups["5.curve"].edges.tolist() == [[0, 1]]
    assert any("'5' is used for several dimensions" in note for note in mesh.notes)


@pytest.mark.parametrize("binary", [0, 1])
def test_parametric_nodes_of_format_2(tmp_path: Path, two_squares: Callable[..., None], binary: int) -> None:
    plain, parametric = tmp_path / "plain.msh", tmp_path / "parametric.msh"
    two_squares(plain, 2.2, binary)
    gmsh_module.option.setNumber("Mesh.SaveParametric", 1)
    gmsh_module.write(str(parametric))
    assert b"$ParametricNodes" in parametric.read_bytes()
    one, other = mesh_of(plain), mesh_of(parametric)
    assert np.array_equal(one.positions, other.positions)
    assert np.array_equal(one.triangles, other.triangles)
    assert sorted(one.groups) == sorted(other.groups)


def test_a_file_with_curves_alone_says_what_gmsh_saves(tmp_path: Path, gmsh: ModuleType) -> None:
    file, script = tmp_path / "curves.msh", tmp_path / "curves.geo"
    file.write_text(ascii_2(NODES, "1 1 2 5 1 40 7;2 1 2 5 1 7 3"))
    script.write_text(
        'Point(1) = {0, 0, 0}; Point(2) = {1, 0, 0}; Line(1) = {1, 2}; Physical Curve("a") = {1};\n'
    )
    for path in (file, script):
        with pytest.raises(
            InputError, match=r"no triangles, only curves: make a surface, .* Physical Surface"
        ):
            mesh_of(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ascii_2(NODES, "1 2 2 0 1 40 7 3;2 2 2 0 1 40 7 3"), "repeat another one: 1 "),
        (ascii_2(NODES, "1 2 2 0 1 40 7 5"), "nodes that do not exist: tag 5"),
        (ascii_2("1 0 0 0;1 1 0 0;2 0 1 0", "1 2 2 0 1 1 1 2"), "several nodes have the tag 1"),
        (ascii_2(NODES, "1 77 2 0 1 40 7 3"), "unknown type 77"),
        (ascii_2(NODES, "1 1 2 0 1 40 7"), "no triangles"),
        (ascii_2(NODES, "1 4 2 0 1 40 7 3 12"), "only solid elements"),
        (ascii_2(NODES.replace("1 1 0", "1 nan 0"), "1 2 2 0 1 40 7 3"), "not finite: vertices 2"),
        (ascii_2(NODES.replace("1 1 0", "1 one 0"), "1 2 2 0 1 40 7 3"), "no number"),
        (ascii_2(NODES, "1 2 2 0 1 40 7.5 3"), "where a count or a tag belongs"),
        ("$MeshFormat\n4 0 8\n$EndMeshFormat\n", "2.2 and 4.1 are"),
        ("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n", r"\$Nodes is missing"),
        ("$NOD\n0\n$ENDNOD\n", "format 1"),
        ("solid cube\n", "is no gmsh mesh"),
        ("", "empty"),
    ],
)
def test_invalid_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "bad.msh"
    file.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        mesh_of(file)
    assert caught.value.file == str(file)


def test_control_characters_in_names_are_replaced(tmp_path: Path) -> None:
    file = tmp_path / "mesh.msh"
    file.write_bytes(
        b'$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n1\n2 3 "a\0b\x1b[31m"\n$EndPhysicalNames\n'
        b"$Nodes\n3\n1 0 0 0\n2 1 0 0\n3 0 1 0\n$EndNodes\n$Elements\n1\n1 2 2 3 1 1 2 3\n$EndElements\n"
    )
    assert list(mesh_of(file).groups) == ["a\N{REPLACEMENT CHARACTER}b\N{REPLACEMENT CHARACTER}[31m"]
