"""``scripts/bench``: its files, comparisons with other programs, one line for each failure."""

import json
import shlex
import signal
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import measures
import numpy as np
import processes
import pytest
from cases import GRADED, MESHES, corners, hanging_square, on_mesh, square_number
from launch import FORKS
from module_of import module_of
from patience import Patience
from peers import write_files, write_scene
from processes import Failed, run
from tables import (
    against_table,
)

from lyra_petsc.mesh.build import build_mesh
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.materials.library import resolve_material
from lyra_petsc.scene.schema import Scene

SCRIPTS = Path(__file__).parents[2] / "scripts"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")


program = module_of(SCRIPTS / "benchmarks" / "__main__.py", "bench_program")


class Done(NamedTuple):
    """Output of the program."""

    returncode: int
    stdout: str
    stderr: str


def bench(folder: Path, *words: str) -> Done:
    """Run the program in this process; it starts the measured processes."""
    heeded = signal.getsignal(signal.SIGTERM)
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as out:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["bench", *words])
        try:
            with redirect_stderr(StringIO()) as err:
                code = program.main()
        finally:
            signal.signal(signal.SIGTERM, heeded)
    return Done(code, out.getvalue(), err.getvalue())


def tables_of(markdown: str) -> list[list[list[str]]]:
    """Cells of every table of a Markdown text, without separator lines."""
    found: list[list[list[str]]] = [[]]
    for line in markdown.splitlines():
        if line.startswith("|"):
            found[-1].append([cell.strip() for cell in line.strip("|").split(" | ")])
        elif found[-1]:
            found.append([])
    return [[lines[0], *lines[2:]] for lines in found if lines]


def forked_worker(folder: Path) -> Path:
    """A program that lets the tests' forks run the worker: imports take longer than its measurements here."""
    program = folder / "worker.py"
    words = [sys.executable, *FORKS.program, str(SCRIPTS / "benchmarks" / "worker.py")]
    lines = f"import os, sys\nos.execv({sys.executable!r}, {words} + sys.argv[1:])\n"
    program.write_text(lines, encoding="utf-8")
    return program


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    words = shlex.split("--quick --vertices 36 --ranks 1,2 --steps 3 --seconds 0.2 --weak 50")
    few = pytest.MonkeyPatch()
    few.setitem(program.QUICK, "output", 400)
    few.setattr(measures, "REPEATS", 1)
    few.setattr(measures, "PROBLEM_CLASSES", dict(list(measures.PROBLEM_CLASSES.items())[:2]))
    few.setattr(processes, "WORKER", forked_worker(folder))
    peers = [
        "slow=for i in $(seq {steps}); do sleep 0.2; done",
        "idle=true",
        "bad=echo oh >&2; echo no >&2; exit 3",
    ]
    for peer in peers:
        words += ["--peer", peer]
    done = bench(folder, *words, "--presets", "block-jacobi", "-ksp_rtol", "1e-9")
    few.undo()
    return done, folder / "bench"


@pytest.mark.slow
def test_json_has_every_measurement(measured):
    done, folder = measured
    results = json.loads((folder / "bench.json").read_text())
    ours = [row for row in results["rows"] if "command" not in row]
    assert [(row["who"], row["ranks"]) for row in ours] == [
        ("semi-implicit", 1),
        ("semi-implicit", 2),
        ("beuler", 1),
        ("beuler", 2),
    ], done.stderr
    for row in ours:
        assert row["vertices"] == 36
        assert len(row["peak_bytes"]) == row["ranks"]
        assert min(row["peak_bytes"]) > 0
        assert row["set_up_seconds"] > row["build_seconds"] > 0.0
        assert row["petsc_options"]["ksp_rtol"] == "1e-9"
        assert 2 <= len(row["steps"]) <= 3
        for step in row["steps"]:
            assert step["cpu"] > 0.0
            parts = ("residual", "jacobian", "frozen", "energy", "preconditioner", "solve", "rest")
            assert sum(step[part] for part in parts) == pytest.approx(step["seconds"])
            assert (step["newton"] == 1) == (row["who"] == "semi-implicit")
    assert {"overhead", "output", "default_scene", "start_up"} <= set(results)
    assert [row["vertices"] for row in results["weak"]] == [square_number(50), square_number(100)]
    (meshes,) = results["meshes"]
    assert tuple(meshes["meshes"]) == MESHES
    (apart,) = results["apart"]
    assert apart["vertices"] == square_number(18)
    assert [row["problem_class"] for row in results["presets"]] == list(measures.PROBLEM_CLASSES)[:2]
    assert not (folder / "scratch").exists()


@pytest.mark.slow
def test_markdown_has_every_measurement(measured):
    done, folder = measured
    text = (folder / "bench.md").read_text()
    assert done.stdout.strip() == text.strip()
    for lines in tables_of(text):
        assert {len(line) for line in lines} == {len(lines[0])}
        assert all(cell for line in lines for cell in line)
    rows, meshes, weak, apart, presets, single = tables_of(text)
    assert rows[0][:7] == [
        "vertices", "who", "ranks", "ms a step", "CPU ms", "times the first", "residual ms"
    ]  # fmt: skip
    assert [line[1] for line in rows[1:]] == [*["semi-implicit"] * 2, *["beuler"] * 2, "slow", "idle"]
    assert [line[1] for line in meshes[1:]] == list(MESHES)
    assert (len(weak), len(apart), len(presets), len(single)) == (3, 2, 3, 9)


@pytest.mark.slow
def test_other_programs_are_compared_and_a_failing_one_is_one_line(measured):
    done, folder = measured
    results = json.loads((folder / "bench.json").read_text())
    slow, idle = (row for row in results["rows"] if "command" in row)
    assert np.median(slow["step_seconds"]) > 0.1
    assert np.median(idle["step_seconds"]) < 0.1
    assert np.median(slow["cpu_seconds"]) < 0.1
    said = "36 vertices, peer bad: ended with exit code 3: no"
    assert results["failures"] == [said]
    assert [line for line in done.stderr.splitlines() if "failed" in line] == [f"bench: failed: {said}"]
    assert done.returncode == 1


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--vertices", "1e3"], "'1e3' must be whole numbers from 1 on"),
        (["--peer", "nothing"], "--peer: must be NAME='command"),
        (["--presets", "magic"], "unknown preset 'magic'"),
        (["--nonsense"], "unrecognized arguments: --nonsense"),
        (["--against", "taken"], "--against: has no scripts/benchmarks/worker.py"),
    ],
)
def test_mistakes_are_one_line(tmp_path, words, says):
    (tmp_path / "taken").write_text("a file")
    done = bench(tmp_path, *words)
    assert done.returncode == 2
    assert says in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_files_for_other_programs_describe_the_scene(tmp_path):
    write_files(tmp_path, 100)
    theirs = load_scene(write_scene(tmp_path, 100, 7), [])
    ours = Scene.model_validate(hanging_square(100))
    meshes = build_mesh(theirs.mesh, file=theirs.source), build_mesh(ours.mesh)
    np.testing.assert_array_equal(meshes[0].positions, meshes[1].positions)
    np.testing.assert_array_equal(meshes[0].triangles, meshes[1].triangles)
    np.testing.assert_array_equal(meshes[0].triangle_uv, meshes[1].triangle_uv)
    (shell, _), (expected, _) = resolve_material(theirs.material[0]), resolve_material(ours.material[0])
    for name in ("density", "c11", "c22", "c33", "bending"):
        assert getattr(shell, name) == pytest.approx(getattr(expected, name)), name
    assert shell.c12 == 0.0  # as the original has it
    assert theirs.time.step == ours.time.step
    assert theirs.time.end == pytest.approx(7 * ours.time.step)
    assert theirs.gravity == ours.gravity
    assert list(theirs.handles[0].nodes) == corners(100)


@pytest.mark.parametrize("kind", MESHES)
def test_the_square_on_every_kind_of_mesh(tmp_path, kind):
    scene = Scene.model_validate(on_mesh(kind, 2500, tmp_path))
    mesh = build_mesh(scene.mesh)
    assert mesh.n_vertices == pytest.approx(2500, rel=0.2)
    (handle,) = scene.handles
    held = list(handle.nodes) if handle.nodes is not None else mesh.groups[handle.group].vertices
    assert sorted(map(tuple, mesh.positions[held])) == [(0.0, 1.0, 0.0), (1.0, 1.0, 0.0)]
    edges = mesh.positions[mesh.triangles] - mesh.positions[np.roll(mesh.triangles, 1, axis=1)]
    sizes = np.sort(np.linalg.norm(edges, axis=2).ravel())
    assert (sizes[-1] / sizes[0] > GRADED / 2) == (kind == "gmsh 1:20")


def test_two_checkouts_are_compared_in_pairs():
    def runs(*cpu: float) -> list[dict]:
        return [
            {"vertices": 36, "peak_bytes": 50, "set_up_seconds": 1.0, "steps": [{"cpu": c, "cg": 7}] * 3}
            for c in cpu
        ]

    results = [
        {"mesh": mesh, "who": "beuler", "ranks": 2, "here": runs(*here), "other": runs(1.0, 2.0, 4.0)}
        for mesh, here in (("diagonal", (1.1, 2.0, 3.6)), ("gmsh", (2.0, 6.0, 4.4)))
    ]
    _, _, first, last, _, most = against_table(results)
    assert [cell.strip() for cell in first.strip("|").split("|")][4] == "1.00 (0.900-1.10)"
    assert [cell.strip() for cell in last.strip("|").split("|")][4] == "2.00 (1.10-3.00)"
    assert most == "Median of the rows 1.50, largest 2.00."


def test_a_process_that_takes_too_long_is_ended_with_its_children(tmp_path):
    patience = Patience(40.0)
    with pytest.raises(Failed, match=r"not done within 0\.5 s"):
        run("sleep 60 & echo $! >child; wait", 0.5, tmp_path)
    child = Path("/proc", (tmp_path / "child").read_text().strip(), "stat")
    while not patience.over and child.exists() and child.read_text().split()[2] != "Z":
        time.sleep(0.1)
    assert not child.exists() or child.read_text().split()[2] == "Z"
