"""Starting in a stranger's folder runs none of its files: modules, settings of libraries, PETSc options."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from launch import PLAIN, ROOT, SCENE, Left, finish, lyra, start, write_scene

from lyra_petsc.startup import python_command

MARK = "open({!r}, 'a').write(__name__ + '\\n')\nraise SystemExit(99)\n"

GEO = SCENE.replace("{grid: {width: 1.0, height: 1.0, nx: 4, ny: 4}}", "{file: sheet.geo}").replace(
    "nodes: [0, 4]", "nodes: [0, 1]"
)
SHEET = """\
size = 0.5;
Point(1) = {0, 0, 0, size};
Point(2) = {1, 0, 0, size};
Point(3) = {0, 1, 0, size};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 1};
Curve Loop(1) = {1, 2, 3};
Plane Surface(1) = {1};
"""

STARTS = {
    "-m": ["-m", "lyra_petsc"],
    "folder": [str(ROOT / "lyra_petsc")],
    "command": ["lyra-petsc"],
}
"""How users, the scripts and installed commands start the program."""

STRESS = ["stress", "grid.yaml", "--only", "stiff-1e3-40ms", "--ranks", "2", "--out", "stress"]


def names() -> set[str]:
    """Modules that might be imported, the standard library's and those installed."""
    installed = {path.stem.partition(".")[0] for folder in sys.path for path in Path(folder).glob("*")}
    return {name for name in {*sys.stdlib_module_names, *installed} if name.isidentifier()}


@pytest.fixture
def stranger(tmp_path: Path) -> Path:
    """A folder with a scene, and with modules of all names that leave a mark."""
    folder = tmp_path / "stranger"
    folder.mkdir()
    write_scene(folder, GEO)
    write_scene(folder, SCENE, "grid.yaml")
    (folder / "sheet.geo").write_text(SHEET)
    for name in {*names(), "sitecustomize", "usercustomize"}:
        (folder / f"{name}.py").write_text(MARK.format(str(tmp_path / "mark")))
    return folder


def loaded_before(tmp_path: Path) -> set[str]:
    """Modules that ``python -m`` itself imports before it looks into a package; they cannot be helped."""
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "__init__.py").write_text("import sys\nprint(*sys.modules)\n")
    (tmp_path / "package" / "__main__.py").touch()
    words = [sys.executable, "-m", "package"]
    return set(subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split())


@pytest.mark.parametrize(
    ("how", "arguments"),
    [*((how, ["check", "scene.yaml"]) for how in STARTS), ("-m", STRESS), ("folder", ["view", "nowhere"])],
)
def test_modules_of_the_working_directory_are_not_imported(
    stranger: Path, tmp_path: Path, how: str, arguments: list[str]
) -> None:
    if how == "-m":
        for name in {*loaded_before(tmp_path), "lyra_petsc"}:
            (stranger / f"{name}.py").unlink(missing_ok=True)
    command = tmp_path / "bin" / "lyra-petsc"
    command.parent.mkdir()
    command.write_text("import sys\nfrom lyra_petsc.__main__ import main\nsys.exit(main())\n")
    program = [str(command) if word == "lyra-petsc" else word for word in STARTS[how]]
    left = finish(start(arguments, stranger, extra=PLAIN, program=program))
    assert not (tmp_path / "mark").exists(), (tmp_path / "mark").read_text()
    assert left.code == (2 if "nowhere" in arguments else 0), left.err


def test_other_processes_have_the_same_import_path(stranger: Path, tmp_path: Path) -> None:
    words = python_command("import click, json, runpy, lyra_petsc; print(lyra_petsc.__file__, sys.path)")
    done = subprocess.run(words, cwd=stranger, capture_output=True, text=True, check=True)
    path = [folder for folder in sys.path if folder]
    assert done.stdout.split(maxsplit=1) == [f"{ROOT}/lyra_petsc/__init__.py", f"{path}\n"]
    assert not (tmp_path / "mark").exists()


def test_petsc4py_is_not_led_to_another_library(tmp_path: Path) -> None:
    """petsc4py takes the name of the build that it loads from ``petsc.cfg`` of the working directory."""
    (tmp_path / "evil").mkdir()
    (tmp_path / "evil" / "PETSc.py").write_text(MARK.format(str(tmp_path / "mark")))
    (tmp_path / "petsc.cfg").write_text(f"PETSC_ARCH = {tmp_path / 'evil'}\n")
    assert lyra(["check", write_scene(tmp_path)], tmp_path).code == 0
    assert not (tmp_path / "mark").exists()


def test_settings_of_numba_are_refused(tmp_path: Path) -> None:
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: evil\n")
    words = ["-c", "from lyra_petsc.__main__ import main; main()"]
    left = lyra(["check", write_scene(tmp_path)], tmp_path, program=words)
    assert left.code == 2
    assert left.ours == [line for line in left.ours if "numba would take settings from it" in line] != []


def test_settings_of_matplotlib_start_no_latex(tmp_path: Path) -> None:
    from written_run import written

    written(tmp_path / "run")
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\n")
    (tmp_path / "latex").write_text(f"#!/bin/sh\ntouch '{tmp_path}/mark'\n")
    (tmp_path / "latex").chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    words = ["-c", "from lyra_petsc.__main__ import main; main()"]
    left = lyra(["report", "run"], tmp_path, program=words, extra={"PATH": path})
    assert left.code == 0, left.err
    assert not (tmp_path / "mark").exists()


def monitored(left: Left) -> bool:
    assert left.code == 0, left.err
    return "KSP Residual norm" in left.out


def test_petsc_options_of_the_working_directory_are_not_read(tmp_path: Path) -> None:
    write_scene(tmp_path)
    for name in (".petscrc", "petscrc"):
        (tmp_path / name).write_text("-ksp_monitor\n-log_view :log.txt\n-dll_prepend /nonexistent.so\n")
    assert not monitored(lyra(["run", "scene.yaml"], tmp_path))
    program = ["-c", "import lyra_petsc; lyra_petsc.run('scene.yaml')"]
    assert not monitored(lyra([], tmp_path, program=program))
    assert not (tmp_path / "log.txt").exists()


@pytest.mark.parametrize(
    ("files", "variable", "line", "steps"),
    [
        ({".petscrc": 1}, "", [], 1),
        ({".petscrc": 1, "mine": 2}, "", ["--petscrc", "mine"], 2),
        ({"mine": 2}, "-ts_max_steps 3", ["--petscrc=mine"], 3),
        ({"mine": 2}, "-ts_max_steps 3", ["--petscrc=mine", "-ts_max_steps", "4"], 4),
        ({".petscrc": 1}, "-skip_petscrc", [], 5),
    ],
)
def test_later_sources_of_petsc_options_override_earlier_ones(
    tmp_path: Path, files: Mapping[str, int], variable: str, line: list[str], steps: int
) -> None:
    """In this order: the file in the home folder, that of the option, the variable, the command line."""
    home, work = tmp_path / "home", tmp_path / "work"
    home.mkdir()
    work.mkdir()
    for name, number in files.items():
        (home if name == ".petscrc" else work).joinpath(name).write_text(f"-ts_max_steps {number}\n")
    scene = write_scene(work)
    left = lyra(["run", scene, *line], work, extra={"HOME": str(home), "PETSC_OPTIONS": variable})
    assert left.code == 0, left.err
    assert "warning" not in left.err
    assert len((work / "runs/scene/history.csv").read_text().splitlines()) == 2 + steps


def test_processes_of_an_experiment_get_the_file_of_options(tmp_path: Path) -> None:
    write_scene(tmp_path)
    (tmp_path / "mine").write_text("-fp_trap\n")
    words = ["stress", "scene.yaml", "--only", "stiff-1e3-40ms", "--ranks", "2", "--out", "new"]
    left = lyra([*words, "--petscrc", "mine"], tmp_path, extra=PLAIN)
    assert left.code == 2
    assert "--petscrc: mine: -fp_trap" in left.err


LISTENING = """\
import atexit, os, sys

def report():
    files = os.listdir("/proc/self/fd")
    files = {os.readlink(f"/proc/self/fd/{fd}") for fd in files if os.path.lexists(f"/proc/self/fd/{fd}")}
    lines = [line.split() for kind in ("tcp", "tcp6", "udp", "udp6") for line in open(f"/proc/net/{kind}")]
    sockets = [words[1] for words in lines if words[3] in ("0A", "07") and f"socket:[{words[9]}]" in files]
    sys.stdout.write(f"{'MPI' if 'mpi4py.MPI' in sys.modules else 'no MPI'} {sockets}\\n")

from lyra_petsc.__main__ import main
atexit.register(report)
main()
"""
"""The program, which says at its end whether MPI was started, and at which addresses it listens."""


@pytest.mark.parametrize("ranks", [1, 2])
def test_on_one_machine_mpi_does_not_listen(tmp_path: Path, ranks: int) -> None:
    left = lyra(["check", write_scene(tmp_path)], tmp_path, ranks, program=("-c", LISTENING))
    assert left.code == 0, left.err
    assert left.out.splitlines()[-ranks:] == ["MPI []"] * ranks


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--version"],
        ["run", "--help"],
        ["run", "scene.yaml", "--otu"],
        ["new", "mine"],
        ["check", "--schema"],
        ["check", "run"],
        ["report", "run"],
        ["render", "run", "--at", "0", "--size", "64x36"],
        ["export", "run", "--to", "npz"],
        ["view", "nowhere"],
    ],
    ids=" ".join,
)
def test_verbs_that_need_no_mpi_do_not_start_it(tmp_path: Path, arguments: list[str]) -> None:
    from written_run import written

    written(tmp_path / "run")
    left = lyra(
        arguments, tmp_path, program=("-c", LISTENING), extra=PLAIN if "report" in arguments else None
    )
    assert left.out.splitlines()[-1] == "no MPI []", left.err


def test_petsc_options_of_verbs_without_petsc_are_refused(tmp_path: Path) -> None:
    left = lyra(["report", "run", "-ksp_type", "cg"], tmp_path)
    assert left.code == 2
    assert left.ours == ["lyra-petsc: -ksp_type: is an option of PETSc, which has no part in this"]
