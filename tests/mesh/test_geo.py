"""gmsh scripts: meshing, sizes, errors, and side effects of gmsh."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest
from mesh_sources import mesh_of, rest_areas

from lyra_petsc.errors import InputError
from lyra_petsc.mesh import library_file
from lyra_petsc.mesh.measures import mean_edge_length, triangle_sides

gmsh = pytest.importorskip("gmsh")

MESHES = Path(__file__).parents[2] / "meshes"

SQUARE = """
Point(1) = {0, 0, 0, 0.5}; Point(2) = {1, 0, 0, 0.5}; Point(3) = {1, 1, 0, 0.5}; Point(4) = {0, 1, 0, 0.5};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
"""


@pytest.fixture
def script(tmp_path: Path) -> Path:
    return tmp_path / "script.geo"


@pytest.mark.parametrize(
    ("name", "spans", "groups"),
    [
        ("flag", (1.5, 0, 1), {"flag": 2, "pole": 1, "fly": 1, "tip": 0}),
        (
            "square",
            (1, 1, 0),
            {"sheet": 2, "left": 1, "right": 1, "bottom": 1, "top": 1, "corners": 0}
            | {f"corner{i}": 0 for i in (1, 2, 3, 4)},
        ),
        ("sail", None, {"sail": 2, "luff": 1, "leech": 1, "foot": 1, "head": 0, "tack": 0, "clew": 0}),
        ("plate", (1, 0.1, 0), {"plate": 2, "clamped": 1, "tip": 1}),
        (
            "shell",
            (10, 10, 10 * np.cos(np.pi / 10)),
            {"shell": 2, "pulled": 0, "pushed": 0} | dict.fromkeys(("plane x", "plane y", "rim", "hole"), 1),
        ),
    ],
)
def test_shipped_meshes(name: str, spans: tuple[float, ...] | None, groups: dict[str, int]) -> None:
    mesh = mesh_of(MESHES / f"{name}.geo")
    assert mesh.notes == []
    assert {group: found.dimension for group, found in mesh.groups.items()} == groups
    if spans is not None:
        assert np.allclose(np.ptp(mesh.rest, axis=0), spans, atol=1e-12)
    a, b = triangle_sides(mesh.rest[mesh.triangles])
    assert np.allclose(np.linalg.norm(np.cross(a, b), axis=1), 2 * rest_areas(mesh))
    # well shaped: no side is longer than four times that of an equilateral triangle of equal area
    longest = np.linalg.norm(np.stack([a, b, b - a]), axis=2).max(axis=0)
    assert (longest**2 < 16 * 4 / np.sqrt(3) * rest_areas(mesh)).all()


@pytest.mark.parametrize("size", [0.3, 0.05])
@pytest.mark.parametrize("options", ["", "Mesh.MeshSizeMax = 0.2; Mesh.MeshSizeFactor = 3;\n", "Mesh 2;\n"])
def test_size_overrides_the_script(script: Path, size: float, options: str) -> None:
    script.write_text(SQUARE + options)
    mesh = mesh_of(script, size=size)
    assert mean_edge_length(mesh) == pytest.approx(size, rel=0.25)
    assert mesh.notes == []


def test_fixed_divisions_stay_with_a_note(script: Path) -> None:
    script.write_text(SQUARE + "Transfinite Curve {1, 2, 3, 4} = 3; Transfinite Surface {1};\n")
    (note,) = mesh_of(script, size=0.05).notes
    assert "fixes its divisions" in note


def test_a_last_line_without_newline_counts(script: Path) -> None:
    """gmsh by itself ignores it silently."""
    script.write_text(SQUARE + 'Physical Surface("square") = {1}; Physical Curve("west") = {4};')
    assert set(mesh_of(script).groups) == {"west", "square"}


def test_a_script_may_mesh_by_itself_and_have_groups_on_parts_only(script: Path) -> None:
    script.write_text(SQUARE + 'Physical Curve("west") = {4};\nMesh.ElementOrder = 2;\nMesh 2;\n')
    mesh = mesh_of(script)
    assert rest_areas(mesh).sum() == pytest.approx(1.0)
    assert list(mesh.groups) == ["west"]
    assert any("higher order" in note for note in mesh.notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("// broken\nPoint(1) = {0, 0};\n", "geo: gmsh: line 2: syntax error"),
        (SQUARE + "Line(9) = {1, 77};\n", "gmsh: "),
        (SQUARE + 'Merge "nowhere.step";\n', "Unable to open file 'nowhere.step'"),
        ("Point(1) = {0, 0, 0};\n", "no triangles"),
        ("// nothing\n", "no triangles"),
        ("   \n", "empty"),
        ("caf\xe9 = {;\n", "gmsh: "),
        ("a = {;\n", "gmsh: line 1: syntax error"),
    ],
)
def test_invalid_scripts_are_refused(script: Path, text: str, message: str) -> None:
    script.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=message) as caught:
        mesh_of(script)
    assert caught.value.file == str(script)
    assert "\n" not in str(caught.value)


def test_gmsh_prints_nothing_and_leaves_no_files(script: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)]
    script.write_text(SQUARE)
    mesh_of(script)
    script.write_text("wrong")
    with pytest.raises(InputError):
        mesh_of(script)
    captured = capfd.readouterr()
    assert (captured.out, captured.err) == ("", "")
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)] == before
    if hasattr(gmsh, "isInitialized"):
        assert not gmsh.isInitialized()


def test_another_algorithm_on_request_only(script: Path) -> None:
    script.write_text(SQUARE + "Mesh.Algorithm = 5;\n")
    own, same = mesh_of(script, size=0.1), mesh_of(script, size=0.1, algorithm="delaunay")
    assert np.array_equal(own.triangles, same.triangles)
    assert np.array_equal(own.positions, same.positions)
    other = mesh_of(script, size=0.1, algorithm="mesh-adapt")
    assert not np.array_equal(own.triangles, other.triangles)
    script.write_text(SQUARE + "Mesh 2;\n")  # a script that meshes by itself
    assert mesh_of(script).n_triangles <= mesh_of(script, algorithm="mesh-adapt").n_triangles + 4


def test_progress_of_gmsh_is_reported(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library_file, "REPORT_INTERVAL", 0.1)
    script.write_text(SQUARE)
    lines: list[str] = []
    library_file.read_by_library(script, 0.006, report=lines.append)
    assert lines[0].startswith("script.geo: gmsh is ")
    assert any("gmsh is meshing, " in line for line in lines)


@pytest.mark.parametrize(
    ("fake", "message"),
    [
        ("raise ImportError('no library')", r"need gmsh \(no library\)"),
        ("def initialize(**_): raise AttributeError('undefined symbol')", r"start \(undefined symbol\)"),
    ],
)
def test_a_gmsh_that_does_not_start_is_reported(
    script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fake: str, message: str
) -> None:
    (tmp_path / "fake").mkdir()
    (tmp_path / "fake" / "gmsh.py").write_text(fake)
    script.write_text(SQUARE)
    monkeypatch.syspath_prepend(tmp_path / "fake")
    with pytest.raises(InputError, match=message):
        mesh_of(script)
