"""A .geo is a program: refused statements, the sandbox, and limits on time and memory."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from mesh_sources import MeshSource, mesh_of
from patience import run_program

from lyra_petsc.errors import InputError
from lyra_petsc.mesh import library_file as geo
from lyra_petsc.mesh.build import build_mesh
from lyra_petsc.mesh.geo_script import check_script
from lyra_petsc.mesh.gmsh_sandbox import supported_layers

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
    ("text", "message"),
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
        ('Field[1] = Structured; Field[1].FileName = "/etc/passwd";', "'Structured' reads"),
        ('Field[1] = MathEval; Field[1].FileName = "/etc/passwd";', "'FileName' reads"),
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
        # words that are on no list, and names that gmsh takes from a text
        ('PoolAcid "touch mark";', "line 5: 'PoolAcid' is no statement that is known here"),
        ('x = 1; x "touch mark";', "line 5: 'x' is no statement"),
        ('SystemCall = 1; SystemCall "touch mark";', "'SystemCall' starts other programs"),
        ('S2N["SystemCall"] "touch mark";', "'S2N' makes a command of a text"),
        ('StringToName["SystemCall"] "touch mark";', "'StringToName' makes a command"),
        ('Call Foo; Macro Foo SystemCall StrCat("touch", " mark"); Return', "'SystemCall'"),
        ('Macro("f", "SystemCall \'touch mark\';");', "'Macro' must be followed by a name"),
        ('SetString("Solver.Executable0", "touch");', "'SetString'"),
        ('General.ErrorFileName = "mark";', "'ErrorFileName'"),
        ("General.SaveOptions = 1;", "'SaveOptions' is no option"),
        ('Geometry.DoubleClickedPointCommand = "touch mark";', "'DoubleClickedPointCommand' is no option"),
        ("Mesh.EndIf = 1;", "'EndIf' is no option"),
        ("Mesh.None = 1;", "Mesh.None"),  # in gmsh's message
        ('PostProcessing.GraphPointCommand = "touch mark";', "'PostProcessing'"),
        ('DefineConstant[ a = {1, GmshOption "Solver.Executable0"} ];', "'GmshOption'"),
        ('DefineConstant[ a = {1, Macro "touch"} ];', "'Macro' must be followed by a name"),
        ('a = FileExists("/etc/passwd");', "'FileExists' reads"),
        ('Merge "script.GEO.py";', "'Merge' of 'script.GEO.py'"),
        ('name = "mark"; Printf("a") > name;', "'Printf' writes files"),
        ('Printf("a"\nIf (1)\n) > "mark";\nEndIf', "'Printf' writes files"),
        ('View[0].FileName = "mark";', "'FileName' reads"),
        ('Save View[0] "mark";', "'Save' writes files"),
        ("a = 1 @ 2;", "'@' has no meaning"),
        ('a = "touch', "a text in quotes does not end"),
        # at jumps gmsh does not recognise quotes
        ('If (0)\n" EndIf SystemCall "touch mark"; "\nEndIf', "line 6: 'EndIf' stands in a quoted text"),
        ('If (0) E" EndIf SystemCall "touch mark"; //"\nEndIf', "line 5: 'EndIf' stands in a quoted text"),
        ('If (0) E// EndIf SystemCall\n"touch mark";\nEndIf', "line 5: 'E'"),
        ("If (0)\nx1EndIf2Save = 1;\nEndIf", "line 6: 'x1EndIf2Save'"),
        ("For i In {0:1}\na = \"\nSave 'mark.msh';\n\";\nEndFor", "line 6: a quoted text of several lines"),
        (f"For i In {{0:1}}\n{'a = 1; ' * 800}\nEndFor", "line 6: 5600 characters"),
        (f'a = "{"a" * 1100}"; //', "a text of 1102 characters"),
        ("// \0 hidden", "no text file"),
        # formats with which gmsh would write to arbitrary memory
        ('Printf("%n%n%n");', "line 5: a '%' in a text of 'Printf' must begin the format of a number"),
        ('Error("%s%s%s%n");', "a '%' in a text of 'Error'"),
        ('Printf("%999999999g", 1);', "a '%' in a text of 'Printf'"),
        ('Printf("%*g", 1, 2);', "a '%' in a text of 'Printf'"),
        ('a = Sprintf("%%n", 1);', "a '%' in a text of 'Sprintf'"),
        ('a = "%n"; Printf(a);', "line 5: 'Printf' must be followed by"),
        ('Warning(StrCat("%", "n"));', "'Warning' must be followed by"),
        (f'a = Sprintf("%g{"A" * 400}", 1);', "a format of 404 characters"),
        (f"{'a' * 1500} = 1;", "line 5: a name of 1500 characters"),
    ],
)
def test_refused_with_line_and_command(tmp_path: Path, text: str, message: str) -> None:
    assert message in meshed(tmp_path, text + "\n")


def test_remedies_for_a_script_that_saves_its_mesh(tmp_path: Path) -> None:
    save = 'Physical Surface(0) = {1};\nMesh 2;\nSave "square.msh";\nPrintf("%g", 1) > "log";\n'
    assert "'Save' writes files, of which none is needed: take it out" in meshed(tmp_path, save)
    script = tmp_path / "script.geo"
    trusted = build_mesh([MeshSource(file=script)], trust_scripts=True)
    script.write_text(script.read_text().replace('Save "square.msh";', "").replace(' > "log"', ""))
    without = mesh_of(script)
    assert trusted.n_triangles == without.n_triangles > 0
    assert list(tmp_path.iterdir()) == [script]
    script.write_text(SQUARE + 'Merge "square.msh";\n')
    with pytest.raises(InputError, match=r"Unable to open file 'square\.msh'"):
        build_mesh([MeshSource(file=script)], trust_scripts=True)


def test_included_files_are_checked_with_a_note(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    part = tmp_path / "parts" / "part.geo"
    part.write_text('// one\nSystemCall "touch mark";\n')
    assert meshed(tmp_path, 'Include "parts/part.geo";\n').startswith("line 2: 'SystemCall'")
    assert meshed(tmp_path, 'Merge "parts/part.geo";\n').startswith("line 2: 'SystemCall'")
    part.write_text('Include "part.geo";\nPhysical Curve("west") = {4};\n')
    script = tmp_path / "script.geo"
    assert [path.name for path in check_script(script).files] == ["script.geo", "part.geo"]
    part.write_text('Physical Curve("west") = {4}; Physical Surface("sheet") = {1};\n')
    mesh = mesh_of(script)
    assert set(mesh.groups) == {"west", "sheet"}
    assert "script.geo: the script includes part.geo" in mesh.notes


def test_option_files_beside_scripts_are_checked(tmp_path: Path) -> None:
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
        'For i In {0:1} /*\nSystemCall "touch mark";\n*/\nEndFor\n',
        'Macro f /*\nSystemCall "touch mark";\n*/\na = 1;\nReturn\nCall f;\n',
        "If (0) a = 1; // EndIf SystemCall\nEndIf\n",
        'Savings = 1; Printer = Savings; Printf("%g", Printer);\n',
        'a = Sprintf("layer%02.0f of %g", 3, 4); Printf("100 cotton %-12.3e", 2);\n',
    ],
)
def test_words_that_only_look_like_commands_are_allowed(tmp_path: Path, text: str) -> None:
    script = tmp_path / "script.geo"
    script.write_text(SQUARE + text + 'Physical Surface("Save it") = {1};\n')
    assert "Save it" in mesh_of(script).groups
    assert [path.name for path in tmp_path.iterdir()] == ["script.geo"]


# -- files whose content does not fit their ending ------------------------------------------------------

CALL = 'SystemCall "touch mark";\n'
MSH = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("x.msh", CALL, "x.msh: line 1: 'SystemCall'"),
        ("X.MSH", CALL, "X.MSH: line 1: 'SystemCall'"),
        ("x.Msh", MSH + CALL, "x.Msh: line 1: '$'"),  # an ending that gmsh does not know: a script to it
        ("x.msh", "\n\n" + CALL, "line 3: 'SystemCall'"),
        ("x.msh", "\xef\xbb\xbf" + CALL, "line 1: 'SystemCall'"),
        ("x.msh", "\n" + MSH + CALL, "line 2: '$'"),
        ("x.msh", "// $MeshFormat\n" + CALL, "line 2: 'SystemCall'"),
        ("x.msh", "$MeshFormats\n" + CALL, "line 1: '$'"),
        ("x.msh", "ISO-10303-21;\n" + CALL, "line 1: 'ISO'"),
        ("x.step", CALL, "x.step: line 1: 'SystemCall'"),
        ("x.Step", "ISO-10303-21;\n" + CALL, "line 1: 'ISO'"),
        ("x.iges", CALL, "x.iges: line 1: 'SystemCall'"),
        ("x.brep", CALL, "x.brep: line 1: 'SystemCall'"),
        ("x.BREP", "DBRep_DrawableShape\n" + CALL, "line 1: 'DBRep_DrawableShape'"),
        ("x.stl", CALL, "x.stl: line 1: 'SystemCall'"),
        ("x.Stl", "solid\n" + CALL, "line 1: 'solid'"),
        ("x.pos", 'View "a" {\nSP(0,0,0){1};\n};\n' + CALL, "line 4: 'SystemCall'"),
        ("x.GEO", CALL, "x.GEO: line 1: 'SystemCall'"),
        ("x.msh", "\x1f\x8b\x08\x00 zipped", "line 1: is no text file"),
    ],
)
def test_merged_files_are_recognised_by_their_content(
    tmp_path: Path, name: str, content: str, message: str
) -> None:
    (tmp_path / name).write_text(content, encoding="latin-1")
    script = tmp_path / "script.geo"
    script.write_text(f'{SQUARE}Merge "{name}";\n')
    with pytest.raises(InputError) as caught:
        mesh_of(script)
    assert message in str(caught.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["script.geo", name])


def test_included_files_are_always_scripts(tmp_path: Path) -> None:
    (tmp_path / "x.geo").write_text(MSH + CALL)
    assert "line 1: '$'" in meshed(tmp_path, 'Include "x.geo";\n')
    assert "line 1: '$'" in meshed(tmp_path, 'Merge "x.geo"; Include "x.geo";\n')
    (tmp_path / "x.msh.opt").write_text(CALL)
    (tmp_path / "x.msh").write_text(MSH + "$Nodes\n1\n1 0 0 0\n$EndNodes\n$Elements\n0\n$EndElements\n")
    assert "line 1: 'SystemCall'" in meshed(tmp_path, 'Merge "x.msh";\n')
    (tmp_path / "x.msh.opt").unlink()
    (tmp_path / "script.geo").write_text(SQUARE + 'Merge "x.msh";\nPhysical Surface("sheet") = {1};\n')
    assert "sheet" in mesh_of(tmp_path / "script.geo").groups


def test_trusted_scripts_are_limited_by_the_sandbox_only(tmp_path: Path) -> None:
    script = tmp_path / "script.geo"
    script.write_text(f'{SQUARE}a = Str("x");\nPrintf("note") > "mark";\nSystemCall "touch called";\n')
    with pytest.raises(InputError, match="writes files"):
        mesh_of(script)
    sheet = geo.mesh_geo(script, 0.3, trusted=True) if "seccomp" not in supported_layers() else None
    if sheet is None:
        with suppress(InputError):  # gmsh reports files that it cannot write
            geo.mesh_geo(script, 0.3, trusted=True)
        assert [path.name for path in tmp_path.iterdir()] == ["script.geo"]
    script.write_text(f'{SQUARE}a = GetEnv("HOME");\n')
    assert len(geo.mesh_geo(script, 0.3, trusted=True).triangles) > 10


# -- the sandbox of the kernel -----------------------------------------------------------------------

ATTEMPTS = """
import os, resource, socket, subprocess, sys, threading
from lyra_petsc.mesh.gmsh_sandbox import enter_sandbox
written = open("before", "w")
layers = enter_sandbox([os.getcwd(), "/usr", sys.prefix])
def outcome(work):
    try:
        return work()
    except OSError:
        return "refused"
thread = threading.Thread(target=lambda: print("thread"))
thread.start()
thread.join()
for name, work in {
    "exec": lambda: os.execv("/bin/true", ["true"]), "fork": os.fork, "socket": socket.socket,
    "spawn": lambda: subprocess.run(["/bin/true"]), "write": lambda: open("mark", "w"),
    "append": lambda: open("before", "a"), "remove": lambda: os.unlink("before"),
    "mkdir": lambda: os.mkdir("m"),
    "rename": lambda: os.rename("before", "after"), "truncate": lambda: os.truncate("before", 0),
    "link": lambda: os.symlink("before", "after"), "hard link": lambda: os.link("before", "after"),
    "mode": lambda: os.chmod("before", 0o777), "kill": lambda: os.kill(os.getppid(), 0),
    "memory": lambda: os.memfd_create("x"),
    "limit": lambda: resource.prlimit(os.getppid(), resource.RLIMIT_CORE, (0, 0)),
}.items():
    print(name, outcome(work))
print("system", os.system("touch mark") != 0)
print("outside", outcome(lambda: open("/etc/passwd")) == "refused", "Landlock" in layers)
written.write("still open")
"""


@pytest.mark.skipif("seccomp" not in supported_layers(), reason="the kernel has no seccomp for us")
def test_the_sandbox_refuses_what_gmsh_does_not_need(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = run_program(
        [sys.executable, "-c", ATTEMPTS],
        cwd=tmp_path,
        env=environment,
        seconds=60,
    )
    *attempts, system, outside = done.stdout.splitlines()
    assert attempts.pop(0) == "thread", done.stderr
    assert len(attempts) == 16
    assert [line for line in attempts if not line.endswith(" refused")] == []
    assert system == "system True"
    assert outside in ("outside True True", "outside False False")
    assert (tmp_path / "before").read_text() == "still open"
    assert [path.name for path in tmp_path.iterdir()] == ["before"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("For i In {0:1e15}\na = i;\nEndFor\n", "did not finish reading the script in 1 s"),
        ("Macro f\nCall f;\nReturn\nCall f;\n", ""),
        ('Include "script.geo";\n', ""),
    ],
)
def test_endless_scripts_are_stopped(
    tmp_path: Path, text: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(geo, "SCRIPT_SECONDS", 1)
    assert message in meshed(tmp_path, text)


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
