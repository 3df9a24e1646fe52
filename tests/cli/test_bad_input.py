"""Bad input on the command line: one line, exit code 2, no files, on one rank and on two."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from launch import SCENE, Left, done, lyra, refusal, without, write_scene
from written_run import written

GRID = "{grid: {width: 1.0, height: 1.0, nx: 4, ny: 4}}"
LONG = 3000 * "x"
EMPTY = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
FIT = (
    "fit={parameters: {material.bending: {start: 1.0e-5, bounds: [1.0e-6, 1.0e-3]}}, "
    "measurements: [{points: points.csv}]}"
)

# name: (change of the scene (old, new) or None, arguments after `run scene.yaml`, words in the line)
CASES: dict[str, tuple[tuple[str, str] | None, list[str], str]] = {
    "unknown key": (("gravity:", "gravitty:"), [], "gravitty: unknown key, did you mean 'gravity'"),
    "wrong type": (("step: 0.01", "step: [1]"), [], "time.step: must be a number"),
    "out of range": (("density: 0.15", "density: -1"), [], "material.density: must be > 0"),
    "not a number": (("[0, 0, -9.81]", "[0, 0, .nan]"), [], "gravity: must be a finite number"),
    "missing mesh": ((GRID, "{file: none.msh}"), [], "none.msh"),
    "empty mesh": ((GRID, "{file: empty.obj}"), [], "empty.obj"),
    "binary mesh": ((GRID, "{file: noise.msh}"), [], "noise.msh"),
    "unknown group": (("nodes: [0, 4]", "group: pole"), [], "handles[0].group"),
    "vertex out of range": (("nodes: [0, 4]", "nodes: [0, 25]"), [], "handles[0].nodes"),
    "curvature without bending": (
        ("output: {every: 0.02}", "output: {every: 0.02, fields: [curvature]}"),
        ["--set", "material.bending=0"],
        "output.fields",
    ),
    "set without equals": (None, ["--set", "rubbish"], "--set"),
    "set of an unknown key": (None, ["--set", "time.stepp=1"], "time.stepp"),
    "set of an unknown word": (None, ["--set", "time.step=abc"], "time.step"),
    "unknown preconditioner": (None, ["-pc_type", "foo"], "foo"),
    "unknown Krylov method": (None, ["-ksp_type", "foo"], "foo"),
    "another time scheme": (None, ["-ts_type", "cn"], "-ts_type"),
    "theta endpoint": (None, ["-ts_theta_endpoint"], "-ts_theta_endpoint"),
    "no number for PETSc": (None, ["-ts_dt", "abc"], "must be a number, not 'abc'"),
    "negative step for PETSc": (None, ["-ts_dt", "-1"], "-ts_dt"),
    "unknown option": (None, ["--ouut", "x"], "--ouut: no such option"),
    "option without value": (None, ["--out"], "--out"),
    "force with resume": (None, ["--force", "--resume"], "--force"),
    "nothing to resume": (None, ["--resume"], "--resume"),
    "folder in use": (None, ["--out", "used"], "used"),
    "folder is a file": (None, ["--out", "empty.obj"], "empty.obj"),
    "title that is no text": (("gravity:", 'title: "\\uD800"\ngravity:'), [], "title: must be text in UTF-8"),
    "probe that is no text": (
        ("gravity:", 'probes: {"\\uD800": {nodes: [0]}}\ngravity:'),
        [],
        "must be text in UTF-8",
    ),
    "option that is no text": (None, ["-ksp_type", "a\udcff"], "a\\udcff: must be text in UTF-8"),
    "override that is no text": (None, ["--set", "title=a\udcff"], "--set title=a\\udcff"),
    "second scene": (None, ["other.yaml"], "other.yaml"),
}


WORDS: list[tuple[list[str], str]] = [
    (["runn", "scene.yaml"], "runn: unknown verb, did you mean 'run'"),
    (["scene.yaml"], "give a verb first, as in: run scene.yaml"),
    (["run", "none.yaml"], "none.yaml"),
    (["run", "used"], "used"),
    (["check", "noise.msh"], "noise.msh"),
    (["check", "scene.yaml", "--out", "x"], "--out: no such option"),
    (["run", "--resume", "--out", "used"], "used"),
    (["check", "scene.yaml", "--set", f"{LONG}=1"], "unknown key"),
    (["check", "scene.yaml", "--set", f"handles=[{{group: {LONG}}}]"], "handles[0].group"),
    (["check", "scene.yaml", "--set", f"mesh.file=/{LONG}/x.obj"], "file name too long"),
    (
        [
            *("check", "scene.yaml", "--set", "handles[0].motion=fast"),
            *("--set", "motions={fast: [{time: 0}, {time: 1e-9, translate: [1, 0, 0]}]}"),
        ],
        "scene.yaml: motions.fast: goes at 1e+09 m/s",
    ),
    (["report", LONG], "file name too long"),
    (["check", "scene.yaml", f"--{LONG}"], "no such option"),
    (["export", "run"], "Missing option '--to'"),
    (["export", "run", "--to", "objj"], "--to: unknown format 'objj', did you mean 'obj'"),
    (["export", "nowhere", "--to", "obj"], "nowhere: no such folder"),
    (["export", "run", "--to", "obj", "--every", "x"], "Invalid value for '--every'"),
    (["export", "run", "--to", "obj", "--out", "run"], "run: --out: exists"),
    (["fabric", "bendin", "gray-interlock"], "did you mean 'bending'"),
    (["fabric", "bending", "gray-interlok"], "did you mean 'gray-interlock'"),
    (["fabric", "bending"], "give a material"),
    (["fabric", "bending", "gray-interlock", "--cloth", "gray-interlock"], "give a material"),
    (["fabric", "cantilever", "scene.yaml", "--set", "material.bending=0"], "does not resist"),
    (["fit", "scene.yaml", "--set", FIT], ": measures vertex 99, but the mesh has vertices 0 to 24"),
    (["new", "scene"], "scene.yaml: exists and is left as it is"),
    (["new", "scene.yaml"], "scene.yaml: exists and is left as it is"),
    (["new", "nowhere/x"], "cannot be written"),
    (["new", ""], "must be a name"),
    (["new", "a\nb"], "must be a name"),
    (["new"], "Missing argument"),
    (["new", "x", "--mesh", "none.geo"], "none.geo: no such file"),
    (["new", "x", "--mesh", "a.step"], "a.step: file: 'a.step' must end in"),
    (["new", "x", "--mesh", "empty.obj"], "empty.obj"),
    (["stress", "--quick", "--full"], "--quick"),
    (["stress", "none.yaml"], "none.yaml"),
    (["stress", "--set", "material.density=-1"], "density"),
    (["stress", "--set", "time.analysis=static"], "time"),
    (["stress", "--set", "handles=[{group: nowhere}]"], "nowhere"),
    (["stress", "--ranks", "0"], "--ranks"),
    (["stress", "--only", "products"], "--full"),
    (["stress", "--only", "chain-1e6,wint"], "wint: unknown case or family, did you mean 'wind'"),
    (["stress", "--out", "used"], "--force"),
    (["verify", "free-fall", "patch-state"], "patch-state: unknown case, did you mean 'patch-states'"),
    (["verify", "free-fall", "--out", "used"], "--force"),
    (["verify", "free-fall", "--out", "empty.obj/out"], "empty.obj/out"),
]

# name: (scene, arguments, words in the line)
MISTAKES = {
    name: (SCENE.replace(*change) if change else SCENE, ["run", "scene.yaml", *arguments], words)
    for name, (change, arguments, words) in CASES.items()
} | {" ".join(arguments)[:60]: (SCENE, arguments, words) for arguments, words in WORDS}

OF_PETSC = [
    name for name, (_, words, _) in MISTAKES.items() if any(re.match("-[a-z]", word) for word in words)
]
"""Mistakes in options that PETSc reads only at its start, once per process."""

ONE_BY_ONE = """
import json
import re
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any
import os, sys
from mpi4py import MPI
from lyra_petsc.cli.app import run_command_line

left = []
for folder, words in json.loads(Path("mistakes.json").read_text()):
    os.chdir(folder)
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        code = run_command_line(["lyra-petsc", *words])
    left.append([code, out.getvalue(), err.getvalue()])
Path(sys.argv[1], f"left-{MPI.COMM_WORLD.rank}.json").write_text(json.dumps(left))
"""


QUICK = (
    "unknown key",
    "missing mesh",
    "unknown group",
    "no number for PETSc",
    "folder in use",
    "runn scene.yaml",
)
"""One mistake of each kind: in the scene, its files and mesh, PETSc's and the program's options, the command.

"""

Listing = dict[Path, int]


def listing(folder: Path) -> Listing:
    """Times of the last changes in a folder."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def set_out(folder: Path, name: str) -> tuple[list[str], str]:
    """Write the files of a mistake; returns its command and the words of the expected line."""
    scene, arguments, words = MISTAKES[name]
    write_scene(folder, scene)
    (folder / "empty.obj").write_text(EMPTY)
    (folder / "noise.msh").write_bytes(bytes(range(256)) * 8)
    (folder / "used").mkdir()
    (folder / "points.csv").write_text("vertex,x,uncertainty\n99,0,1\n")
    if "run" in arguments[1:]:
        written(folder / "run")
    return arguments, words


@pytest.mark.parametrize(
    ("package", "words", "extra"),
    [
        ("pyvista", ["render", "run"], "view"),
        ("trame_vtk", ["view", "run"], "view"),
        ("matplotlib", ["study", "scene.yaml"], "study"),
    ],
)
def test_a_missing_package_is_one_line(tmp_path: Path, package: str, words: list[str], extra: str) -> None:
    write_scene(tmp_path)
    written(tmp_path / "run")
    before = listing(tmp_path)
    left = without([package], words, tmp_path)
    message = f"{words[0]}: {package} is not installed; get the extra: pip install 'lyra-petsc[{extra}]'"
    refusal(left, message)
    assert left.err == f"lyra-petsc: {message}\n"
    assert listing(tmp_path) == before


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.quick] * (name in QUICK))
        for name in MISTAKES
        if name in QUICK or name in OF_PETSC
    ],
)
def test_a_mistake_is_one_line(tmp_path: Path, name: str) -> None:
    arguments, words = set_out(tmp_path, name)
    before = listing(tmp_path)
    left = lyra(arguments, tmp_path, patience=30)
    refusal(left, words)
    assert left.lines == left.ours
    assert listing(tmp_path) == before


@pytest.mark.parametrize("name", ["unknown key", "nothing to resume", "runn scene.yaml", *OF_PETSC])
def test_a_job_of_two_ranks_ends_with_one_line(tmp_path: Path, name: str) -> None:
    arguments, words = set_out(tmp_path, name)
    before = listing(tmp_path)
    refusal(lyra(arguments, tmp_path, 2, patience=30), words)
    assert listing(tmp_path) == before


@pytest.fixture(scope="module", params=[1, 2])
def together(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, tuple[Path, Listing, list[Left]]]:
    """Output on each rank for every mistake but PETSc's, made one after the other in one job."""
    ranks = request.param
    work = tmp_path_factory.mktemp("together")
    made = {}
    for number, name in enumerate(name for name in MISTAKES if name not in OF_PETSC):
        folder = work / str(number)
        folder.mkdir()
        made[name] = folder, set_out(folder, name)[0], listing(folder)
    (work / "one_by_one.py").write_text(ONE_BY_ONE)
    (work / "mistakes.json").write_text(json.dumps([(str(f), words) for f, words, _ in made.values()]))
    left = done([work], work, ranks, program=("one_by_one.py",))
    assert (left.out, left.err) == ("", "")
    each = [json.loads((work / f"left-{rank}.json").read_text()) for rank in range(ranks)]
    return {
        name: (folder, before, [Left(*left[number]) for left in each])
        for number, (name, (folder, _, before)) in enumerate(made.items())
    }


@pytest.mark.parametrize("name", [name for name in MISTAKES if name not in OF_PETSC])
def test_ranks_agree_on_a_mistake(together: dict[str, tuple[Path, Listing, list[Left]]], name: str) -> None:
    folder, before, (first, *others) = together[name]
    refusal(first, MISTAKES[name][2])
    assert first.lines == first.ours
    assert all(other == Left(2, "", "") for other in others)
    assert listing(folder) == before


def test_names_of_files_need_not_be_text(tmp_path: Path) -> None:
    """Bytes that are not UTF-8 in the names of the scene and of folders, on a terminal for UTF-8 only."""
    strict: dict[str, Any] = {"extra": {"PYTHONIOENCODING": "utf-8:strict"}, "program": ("-m", "lyra_petsc")}
    folder = tmp_path / "in\udcff"
    folder.mkdir()
    scene = Path(write_scene(folder, SCENE)).rename(folder / "sc\udcfe.yaml")
    done(["check", scene], tmp_path, **strict)
    left = done(["run", scene, "--out", "out\udcff"], tmp_path, **strict)
    assert "results      out\\udcff" in left.out
    done(["check", "out\udcff"], tmp_path, **strict)
    done(["run", "--out", "out\udcff", "--resume", "--set", "time.end=0.06"], tmp_path, **strict)
