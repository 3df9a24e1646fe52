"""A .geo is a program: what it may not do, and how one that does not end is ended."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from mesh_sources import mesh_of

from lyra_petsc.errors import InputError
from lyra_petsc.mesh import geo_file as geo

SQUARE = """
Point(1) = {0, 0, 0, 0.5}; Point(2) = {1, 0, 0, 0.5}; Point(3) = {1, 1, 0, 0.5}; Point(4) = {0, 1, 0, 0.5};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
"""


def meshed(folder: Path, text: str, **options: object) -> str:
    """Mesh SQUARE and then ``text`` (which begins in line 5) in ``folder``; the message of the refusal."""
    script = folder / "script.geo"
    script.write_text(SQUARE + text, encoding="latin-1")
    before = sorted(folder.rglob("*"))
    with pytest.raises(InputError) as caught:
        mesh_of(script, **options)
    assert sorted(folder.rglob("*")) == before, "gmsh wrote something"
    assert caught.value.file is not None
    assert "\n" not in str(caught.value)
    return caught.value.message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('SystemCall "touch mark";', "line 5: 'SystemCall' starts other programs"),
        ('\n\n  SystemCall\n"touch mark";', "line 7: 'SystemCall'"),
        ('x = 1e5SystemCall "touch mark";', "line 5: 'SystemCall'"),
        ('/* */System/**/"touch mark";', "line 5: 'System'"),
        ('NonBlockingSystemCall "touch mark";', "'NonBlockingSystemCall'"),
        ('OnelabRun("a", "touch mark");', "'OnelabRun'"),
        ('Field[1] = ExternalProcess; Field[1].CommandLine = "touch mark";', "'ExternalProcess'"),
        ('Solver.Executable0 = "touch";', "'Solver'"),
        ("Plugin(MathEval).Run;", "'Plugin'"),
        ('Save "mark.msh";', "'Save' writes files"),
        ('Print "mark.png";', "'Print' writes files"),
        ('CreateDir "mark";', "'CreateDir' writes files"),
        ('Printf("text") > "mark";', "'Printf' writes files"),
        ('Printf("%g", 1)\n>> "mark";', "'Printf' writes files"),
        ('General.LogFileName = "mark";', "'LogFileName'"),
        ('Field[1] = Structured; Field[1].FileName = "/etc/passwd";', "'FileName' reads"),
        ('a = GetEnv("HOME");', "'GetEnv' reads"),
        ('ShapeFromFile("part.step");', "'ShapeFromFile' reads"),
        ("Exit;", "'Exit'"),
        ("Sleep 1e9;", "'Sleep'"),
        ('Include "/etc/passwd.geo";', "not in the folder"),
        ('Include "../other.geo";', "not in the folder"),
        ('Include "none.geo";', "does not exist"),
        ('Include "part.txt";', "'Include' of 'part.txt'; .geo are read"),
        ('Merge "part.gz";', "'Merge' of 'part.gz'"),
        ('Include StrCat("a", ".geo");', "name in quotes"),
        ('name = "part.geo"; Include name;', "name in quotes"),
        # where gmsh skips and jumps it takes quotes and comments otherwise than they look
        ('If (0)\n" EndIf SystemCall "touch mark"; "\nEndIf', "line 6: 'SystemCall' stands in a quoted text"),
        ('If (0) E" EndIf SystemCall "touch mark"; //"\nEndIf', "line 5: 'SystemCall'"),
        ('If (0) E// EndIf SystemCall\n"touch mark";\nEndIf', "line 5: 'SystemCall' stands in a comment"),
        ('If (0) E// EndIf Save\n"mark.msh";\nEndIf', "line 5: 'Save' stands in a comment"),
        ('If (0) E// EndIf Printf("a") > "mark";\nEndIf', "line 5: 'Printf' stands in a comment"),
        (
            'For i In {0:1} /*\nSystemCall "touch mark";\n*/ EndFor',
            "line 6: 'SystemCall' stands in a comment",
        ),
        ('Macro f /*\nSystemCall "touch mark";\n*/\nReturn\nCall f;', "line 6: 'SystemCall'"),
        (f'a = "{"a" * 1100}"; //', "a text of 1102 characters"),
        ("// \0 hidden", "no text file"),
    ],
)
def test_refused_with_line_and_command(tmp_path: Path, text: str, words: str) -> None:
    assert words in meshed(tmp_path, text + "\n")


def test_what_is_included_is_checked_alike_and_told(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    part = tmp_path / "parts" / "part.geo"
    part.write_text('// one\nSystemCall "touch mark";\n')
    assert meshed(tmp_path, 'Include "parts/part.geo";\n').startswith("line 2: 'SystemCall'")
    assert meshed(tmp_path, 'Merge "parts/part.geo";\n').startswith("line 2: 'SystemCall'")
    part.write_text('Include "part.geo";\nPhysical Curve("west") = {4};\n')
    script = tmp_path / "script.geo"
    assert [path.name for path in geo.check_script(script)] == ["script.geo", "part.geo"]
    part.write_text('Physical Curve("west") = {4}; Physical Surface("sheet") = {1};\n')
    mesh = mesh_of(script)
    assert set(mesh.groups) == {"west", "sheet"}
    assert "script.geo: the script includes part.geo" in mesh.notes


def test_the_options_that_gmsh_reads_beside_a_file_are_checked_alike(tmp_path: Path) -> None:
    (tmp_path / "script.geo.opt").write_text('SystemCall "touch mark";\n')
    assert "line 1: 'SystemCall'" in meshed(tmp_path, "")


def test_links_do_not_lead_out_of_the_folder(tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "outside.geo").write_text("a = 1;\n")
    os.symlink(tmp_path / "outside.geo", inside / "link.geo")
    assert "not in the folder" in meshed(inside, 'Include "link.geo";\n')


@pytest.mark.parametrize(
    "text",
    [
        "// Save the mesh, Print it, Merge others; no Plugin, no SystemCall\n",
        '/* Include "none.geo"; */ Printf("System: %g", 2 > 1);\n',
        "If (1) // Save the mesh\nPhysical Curve(1) = {1};\nEndIf // Print\n",
        "For i In {1:4} // Merge them\nPhysical Curve(i) = {i};\nEndFor\n",
        'Savings = 1; Printer = Savings; Printf("%g", Printer);\n',
    ],
)
def test_words_that_only_look_like_commands_are_allowed(tmp_path: Path, text: str) -> None:
    script = tmp_path / "script.geo"
    script.write_text(SQUARE + text + 'Physical Surface("Save it") = {1};\n')
    assert "Save it" in mesh_of(script).groups


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("For i In {0:1e15}\na = i;\nEndFor\n", "did not finish reading the script in 2 s"),
        ("Macro f\nCall f;\nReturn\nCall f;\n", ""),
        ('Include "script.geo";\n', ""),
    ],
)
def test_scripts_that_do_not_end_are_ended(
    tmp_path: Path, text: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(geo, "SCRIPT_SECONDS", 2)
    assert words in meshed(tmp_path, text)


def test_meshes_larger_than_memory_are_refused_with_their_size(tmp_path: Path) -> None:
    assert "size 1e-09 m would give about 4e+09 edges" in meshed(tmp_path, "", size=1e-9)
    assert "size 1e-06 m would give about 5.8e+11 triangles" in meshed(tmp_path, "", size=1e-6)
    fine = "MeshSize {1, 2, 3, 4} = 2e-5;\n"
    assert "the sizes in the script would give about 1.4e+09 triangles" in meshed(tmp_path, fine)


def test_a_script_that_needs_more_memory_than_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(geo, "available_memory", lambda: 2**30)
    message = meshed(tmp_path, "MeshSize {1, 2, 3, 4} = 1e-9;\n")
    assert "gmsh needs more than the 1 GiB there are, meshing" in message
