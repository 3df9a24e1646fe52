"""``scripts/bench``: its files, comparisons with other programs, one line for each failure."""

import json
import shlex
import signal
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import measures
import numpy as np
import processes
import pytest
from cases import corners, hanging_square, square_number
from launch import FORKS
from module_of import module_of
from peers import write_files, write_scene

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
    tables: list[list[list[str]]] = [[]]
    for line in markdown.splitlines():
        if line.startswith("|"):
            tables[-1].append([cell.strip() for cell in line.strip("|").split(" | ")])
        elif tables[-1]:
            tables.append([])
    return [[lines[0], *lines[2:]] for lines in tables if lines]


def forked_worker(folder: Path) -> Path:
    """A program that lets the tests' forks run the worker: imports take longer than its measurements here."""
    program = folder / "worker.py"
    words = [sys.executable, *FORKS.program, str(SCRIPTS / "benchmarks" / "worker.py")]
    lines = f"import os, sys\nos.execv({sys.executable!r}, {words} + sys.argv[1:])\n"
    program.write_text(lines, encoding="utf-8")
    return program


@pytest.mark.slow
def test_both_files_have_every_measurement_and_a_program_that_fails_is_one_line(tmp_path):
    peers = {"slow": "for i in $(seq {steps}); do sleep 0.2; done", "bad": "echo oh >&2; echo no >&2; exit 3"}
    words = shlex.split("--quick --vertices 36 --ranks 1,2 --steps 3 --seconds 0.2 --weak 50")
    words += [word for name, line in peers.items() for word in ("--peer", f"{name}={line}")]
    meshes = ("diagonal", "gmsh, midedge")
    with pytest.MonkeyPatch.context() as few:
        few.setitem(program.QUICK, "output", 400)
        few.setattr(measures, "REPEATS", 1)
        few.setattr(measures, "MESHES", meshes)
        few.setattr(measures, "PROBLEM_CLASSES", dict(list(measures.PROBLEM_CLASSES.items())[:2]))
        few.setattr(processes, "WORKER", forked_worker(tmp_path))
        done = bench(tmp_path, *words, "--presets", "block-jacobi", "-ksp_rtol", "1e-9")
    said = "36 vertices, peer bad: ended with exit code 3: no"
    assert [line for line in done.stderr.splitlines() if "failed" in line] == [f"bench: failed: {said}"]
    assert done.returncode == 1
    results = json.loads((tmp_path / "bench" / "bench.json").read_text())
    assert results["failures"] == [said]
    *ours, slow = results["rows"]
    methods = [("semi-implicit", 1), ("semi-implicit", 2), ("beuler", 1), ("beuler", 2)]
    assert [(row["who"], row["ranks"]) for row in ours] == methods
    for row in ours:
        assert row["vertices"] == 36
        assert len(row["peak_bytes"]) == row["ranks"]
        assert row["set_up_seconds"] > row["build_seconds"] > 0.0
        assert row["petsc_options"]["ksp_rtol"] == "1e-9"
        for step in row["steps"]:
            parts = ("residual", "jacobian", "frozen", "energy", "preconditioner", "solve", "rest")
            assert sum(step[part] for part in parts) == pytest.approx(step["seconds"])
            assert (step["newton"] == 1) == (row["who"] == "semi-implicit")
    assert np.median(slow["step_seconds"]) > 0.1 > np.median(slow["cpu_seconds"])
    assert {"output", "default_scene", "start_up"} <= set(results)
    assert [row["vertices"] for row in results["weak"]] == [square_number(50), square_number(100)]
    assert not (tmp_path / "bench" / "scratch").exists()
    text = (tmp_path / "bench" / "bench.md").read_text()
    assert done.stdout.strip() == text.strip()
    rows, kinds, *others = tables_of(text)
    assert [line[1] for line in rows[1:]] == [*(who for who, _ in methods), "slow"]
    assert [line[1] for line in kinds[1:]] == list(meshes)
    assert list(map(len, others)) == [3, 2, 3, 7]  # weak scaling, sheets apart, presets, single numbers
    for lines in (rows, kinds, *others):
        assert {len(line) for line in lines} == {len(lines[0])}
        assert all(cell for line in lines for cell in line)


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
    theirs, ours = load_scene(write_scene(tmp_path, 100, 7), []), Scene.model_validate(hanging_square(100))
    meshes = build_mesh(theirs.mesh, file=theirs.source), build_mesh(ours.mesh)
    for name in ("positions", "triangles", "triangle_uv"):
        np.testing.assert_array_equal(getattr(meshes[0], name), getattr(meshes[1], name))
    (shell, _), (expected, _) = resolve_material(theirs.material[0]), resolve_material(ours.material[0])
    for name in ("density", "c11", "c22", "c33", "bending"):
        assert getattr(shell, name) == pytest.approx(getattr(expected, name)), name
    assert theirs.time.end == pytest.approx(7 * ours.time.step)
    assert list(theirs.handles[0].nodes) == corners(100)
