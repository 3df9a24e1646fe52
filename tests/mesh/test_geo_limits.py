"""A .geo is a program: what its process may not do, and its limits on time and memory."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest
from mesh_sources import MeshSource, mesh_of
from patience import run_program

from lyra_petsc.errors import InputError
from lyra_petsc.mesh import library_file
from lyra_petsc.mesh.build import build_mesh
from lyra_petsc.mesh.gmsh_sandbox import supported_layers

pytest.importorskip("gmsh")
guarded = pytest.mark.skipif("seccomp" not in supported_layers(), reason="the kernel has no seccomp for us")
landlocked = pytest.mark.skipif("Landlock" not in supported_layers(), reason="the kernel has no Landlock")

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


STARTS = "the script tried to start a program"


@guarded
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('SystemCall "touch mark";', STARTS),
        ('NonBlockingSystemCall "touch mark";', STARTS),
        ('If (0) E" EndIf SystemCall "touch mark"; //"\nEndIf', STARTS),
        (
            'Field[1] = ExternalProcess; Field[1].CommandLine = "touch mark"; Background Field = 1;',
            STARTS,
        ),
        ('OnelabRun("a", "touch mark");', "gmsh: "),
        ('Save "mark.msh";', "Unable to open file 'mark.msh' (is it there"),
        ('Printf("text") > "mark";', "scripts write no files"),
        ('Printf("text") >> "../mark";', "scripts write no files"),
        ('Print "mark.png";', "gmsh: "),
        ('CreateDir "mark"; Error("made?");', "made?"),
        ('Include "none.geo";', "Unable to open file 'none.geo' (is it there"),
        ('Error("%s%s%s%n");', "gmsh broke down (SIG"),
        ("Exit;", "gmsh ended early (0) reading the script"),
        ("Sleep 1e9;", "gmsh did not finish reading the script in 1 s"),
        ("For i In {0:1e15}\na = i;\nEndFor", "did not finish reading the script in 1 s of CPU time"),
        ("Macro f\nCall f;\nReturn\nCall f;", ""),
        ('Include "script.geo";', ""),
    ],
)
def test_scripts_start_no_programs_write_no_files_and_end(
    tmp_path: Path, text: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(library_file, "READ_SECONDS", 1 if not message or "1 s" in message else 60)
    monkeypatch.setattr(library_file, "WALL_TIME_RATIO", 1 if "Sleep" in text else 100)
    (tmp_path / "inside").mkdir()
    assert message in meshed(tmp_path / "inside", text + "\n")
    assert [path.name for path in tmp_path.iterdir()] == ["inside"]


def test_scripts_read_what_is_in_their_folder(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "part.geo").write_text('Include "more.geo";\nPhysical Curve("west") = {4};\n')
    (tmp_path / "parts" / "more.geo").write_text('Physical Surface("sheet") = {1};\n')
    (tmp_path / "script.geo.opt").write_text('Physical Point("beside") = {1};\n')
    script = tmp_path / "script.geo"
    script.write_text(SQUARE + 'Include "parts/part.geo";\n')
    assert set(mesh_of(script).groups) == {"beside", "west", "sheet"}
    (tmp_path / "link.geo").symlink_to(script)
    assert mesh_of(tmp_path / "link.geo").n_triangles > 10


@landlocked
def test_other_files_are_read_for_trusted_scripts_only(tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "outside.geo").write_text('Physical Surface("sheet") = {1};\n')
    (inside / "link.geo").symlink_to(tmp_path / "outside.geo")
    for name in ("../outside.geo", "link.geo", str(tmp_path / "outside.geo")):
        assert "in the folder of the script?" in meshed(inside, f'Include "{name}";\n')
        trusted = build_mesh([MeshSource(file=inside / "script.geo")], trust_scripts=True)
        assert set(trusted.groups) == {"sheet"}


def test_without_seccomp_scripts_must_be_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "libraries"
    broken.mkdir()
    (broken / "libseccomp.so.2").touch()
    monkeypatch.setenv("LD_LIBRARY_PATH", str(broken))
    assert "no seccomp to confine them: give --trust-mesh" in meshed(tmp_path, "")
    script = tmp_path / "script.geo"
    assert build_mesh([MeshSource(file=script)], trust_scripts=True).n_triangles > 10


# -- the sandbox of the kernel -----------------------------------------------------------------------

STARTING = """
import os, subprocess
from lyra_petsc.mesh.gmsh_sandbox import enter_sandbox
true = ["/bin/true"]
for work in (lambda: os.execv(*true, true), os.fork, lambda: os.posix_spawn(*true, true, {}),
             lambda: subprocess.run(true), lambda: os.system("touch mark")):
    if (child := os.fork()) == 0:
        enter_sandbox(["/"])
        work()
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""

ATTEMPTS = """
import os, resource, socket, sys, threading
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
    "socket": socket.socket, "pair": socket.socketpair, "write": lambda: open("mark", "w"),
    "append": lambda: open("before", "a"), "remove": lambda: os.unlink("before"),
    "mkdir": lambda: os.mkdir("m"),
    "rename": lambda: os.rename("before", "after"), "truncate": lambda: os.truncate("before", 0),
    "link": lambda: os.symlink("before", "after"), "hard link": lambda: os.link("before", "after"),
    "mode": lambda: os.chmod("before", 0o777), "kill": lambda: os.kill(os.getppid(), 0),
    "memory": lambda: os.memfd_create("x"),
    "limit": lambda: resource.prlimit(os.getppid(), resource.RLIMIT_CORE, (0, 0)),
}.items():
    print(name, outcome(work))
print("outside", outcome(lambda: open("/etc/passwd")) == "refused", "Landlock" in layers)
written.write("still open")
"""


def attack(folder: Path, program: str) -> list[str]:
    """Lines that a Python program prints in ``folder``."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = run_program([sys.executable, "-c", program], cwd=folder, env=environment, seconds=60)
    assert done.returncode == 0, done.stderr
    lines: list[str] = done.stdout.splitlines()
    return lines


@guarded
def test_the_sandbox_ends_a_process_that_starts_another(tmp_path: Path) -> None:
    assert attack(tmp_path, STARTING) == [str(-signal.SIGSYS)] * 5
    assert list(tmp_path.iterdir()) == []


@guarded
def test_the_sandbox_refuses_what_gmsh_does_not_need(tmp_path: Path) -> None:
    thread, *attempts, outside = attack(tmp_path, ATTEMPTS)
    assert thread == "thread"
    assert len(attempts) == 14
    assert [line for line in attempts if not line.endswith(" refused")] == []
    assert outside in ("outside True True", "outside False False")
    assert (tmp_path / "before").read_text() == "still open"
    assert [path.name for path in tmp_path.iterdir()] == ["before"]


# -- memory ------------------------------------------------------------------------------------------


def test_meshes_larger_than_memory_are_refused_with_their_size(tmp_path: Path) -> None:
    assert "size 1e-06 m would give about 5e+11 triangles" in meshed(tmp_path, "", size=1e-6)
    fine = "MeshSize {1, 2, 3, 4} = 2e-5;\n"
    assert "the sizes in the script would give about 1.2e+09 triangles" in meshed(tmp_path, fine)


def test_a_script_that_needs_more_memory_than_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(library_file, "available_memory", lambda: 2**30)
    message = meshed(tmp_path, "MeshSize {1, 2, 3, 4} = 1e-9;\n")
    assert "gmsh needs more than the 1 GiB there are, meshing" in message
