"""Every type that PETSc lists either works or is refused in one line: no crash, traceback or hang."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from launch import SCENE, done, environment, lyra, write_scene

LISTS = ("ksp_type", "pc_type", "snes_type", "snes_linesearch_type")
SLOW = ("cp", "deflation")
"""Runs that halve Δt twelve times before they fail."""

REFUSED = [
    ["-ksp_rtol", "nan"],
    ["-ksp_rtol", "1e999"],
    ["-snes_atol", "inf"],
    ["-pc_type", "mg", "-ksp_rtol", "foo"],
    ["-pc_type", "mg", "-ksp_type", "nosuch"],
    ["--set", "petsc.pc_type=mg", "--set", "petsc.ksp_type=nosuch"],
    ["-ksp_type", "python"],
    ["-pc_type", "python", "-pc_python_type", "nosuch"],
    ["-ksp_type", "python", "-ksp_python_type", "nosuch.Thing"],
    ["-pc_type", "python", "-pc_python_type", "os.path.join"],
    ["-pc_type", "kaczmarz"],
    ["-pc_type", "redistribute"],
    ["-ts_init_time", "5"],
    ["-ts_dt", "1e-30"],
    ["-snes_mf"],
    ["-snes_mf_operator"],
    ["-snes_fd"],
    ["-snes_fd_color"],
    ["-fp_trap"],
    ["-snes_convergence_test", "skip"],
    ["-pc_type", "mg", "-mg_coarse_pc_type", "nosuch"],
    ["-snes_convergence_estimate"],
    ["-snes_grid_sequence", "1"],
    ["-snes_monitor_fields"],
    ["-snes_fd_function"],
    ["-ksp_view_diagonal_scale"],
    ["-ksp_monitor_python", "nosuch"],
    ["-snes_monitor_python"],
    ["-mat_seqaij_type"],
    ["-pc_python_type"],
    ["-ts_adapt_clip", "1e30"],
    ["-ts_adapt_safety", "-1"],
    ["-log_view", "draw"],
    ["-log_view", ":/nonexistent/log"],
    ["-citations", "/nonexistent/refs"],
    ["-malloc_view", "/nonexistent/log"],
    ["-options_view", "x"],
    ["--set", "output.every=1e-12"],
    ["--set", "time.step=auto", "--set", "time.tolerance=1e-30"],
    ["--set", "time.step=auto", "-ts_adapt_dt_max", "1e-12"],
]

SOLVED = [
    ["-pc_type", "fieldsplit", "-pc_fieldsplit_block_size", "3"],
    ["-pc_type", "eisenstat"],
    ["-pc_type", "kaczmarz", "-pc_kaczmarz_symmetric"],
    ["-pc_type", "redistribute", "-mat_type", "aij"],
    ["-mat_type", "mpiaij"],
    ["-mat_type", "mpibaij", "-pc_type", "bjacobi"],
    ["-mat_type", "seqaij"],
    ["-ksp_initial_guess_nonzero"],
    ["-pc_type", "mg", "-ksp_initial_guess_nonzero"],
    ["-pc_type", "svd"],
    ["-pc_type", "python"],
    ["-snes_test_jacobian"],
    ["-snes_mf", "false"],
]


class Walk:
    """The process from which the runs are forked."""

    def __init__(self, folder: Path) -> None:
        write_scene(folder, SCENE.replace("end: 0.05", "end: 0.01"))
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("walk.py")), str(folder)],
            env=environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def ends(self, runs: list[list[str]]) -> list[tuple[int, list[str]]]:
        """Exit code of each run, and the lines with which the program reports the reason."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(runs), file=self._process.stdin, flush=True)
        found = []
        for code, out, err in json.loads(self._process.stdout.readline()):
            assert "Traceback" not in out + err
            found.append((code, [line for line in err.splitlines() if line.startswith("lyra-petsc: ")]))
        return found

    def end(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Walk]:
    walk = Walk(tmp_path_factory.mktemp("walk"))
    yield walk
    walk.end()


def lists(folder: Path) -> dict[str, list[str]]:
    """Types that ``-help`` lists."""
    text = done(["run", write_scene(folder), "--out", "out", "-help"], folder).out
    found = {}
    for option in LISTS:
        line = re.search(rf"^\s*-{option}:? <[^\n]*\(one of\)([^\n]*)", text, re.MULTILINE)
        assert line, option
        found[option] = re.sub(r"\([^)]*\)", "", line[1]).split()
    return found


@pytest.mark.slow
def test_each_type_works_or_is_refused_in_one_line(tmp_path: Path, walk: Walk) -> None:
    from petsc4py import PETSc

    types = lists(tmp_path)
    assert min(map(len, types.values())) > 6
    runs = [[f"-{option}", kind] for option, kinds in types.items() for kind in kinds if kind not in SLOW]
    runs += [["-pc_type", "mg", "-ksp_type", kind] for kind in types["ksp_type"]]
    runs += [["-pc_type", "mg", "-snes_type", kind] for kind in ("qn", "ngmres", "anderson", "ncg", "fas")]
    runs += [["-mat_type", kind] for name, kind in vars(PETSc.Mat.Type).items() if name.isupper()]
    solved = []
    for words, (code, lines) in zip(runs, walk.ends(runs), strict=True):
        assert (code, len(lines)) in ((0, 0), (2, 1), (3, 1)), (words, code, lines)
        if code == 0:
            solved.append(" ".join(words))
    assert {"-ksp_type gmres", "-pc_type gamg", "-pc_type fieldsplit", "-snes_linesearch_type l2"} <= set(
        solved
    )


def test_types_without_meaning_are_refused_before_the_run(walk: Walk) -> None:
    for words, (code, lines) in zip(REFUSED, walk.ends(REFUSED), strict=True):
        assert (code, len(lines)) == (2, 1), (words, code, lines)
        option = next(word for word in reversed(words) if word.startswith("-"))
        assert option == "--set" or option in lines[0] or words[-1] == "nosuch", lines


def test_types_that_petsc_supports_work(walk: Walk) -> None:
    for words, end in zip(SOLVED, walk.ends(SOLVED), strict=True):
        assert end == (0, []), (words, end)


AT_THE_START_OR_END = [
    ["-pc_type", "mg", "-ksp_type", "nosuch"],
    ["-options_file", "nosuch.txt"],
    ["-fp_trap"],
    ["-prefix_pop"],
    ["-python"],
    ["-history", "/nonexistent/log"],
    ["-log_trace", "/nonexistent/log"],
    ["-log_view", ":/nonexistent/log"],
    ["-is_view", "nosuch"],
    ["-ts_monitor_sp_swarm"],
]
NEEDS_A_DISPLAY = ("-ts_monitor_sp_swarm",)
"""PETSc reports that there is no display, and continues."""


@pytest.mark.parametrize("words", AT_THE_START_OR_END, ids=" ".join)
def test_the_exit_code_fits_the_message(tmp_path: Path, words: list[str]) -> None:
    """PETSc reads some options at its start only; at its end it frees objects that call Python."""
    left = lyra(["run", write_scene(tmp_path), "--out", "out", *words], tmp_path)
    assert left.code == 2, left.err
    lines = left.lines
    assert len(lines) == 1 or words[0] in NEEDS_A_DISPLAY, left.err
    assert lines[-1].startswith("lyra-petsc: "), left.err
    assert "Traceback" not in left.out + left.err
    message = {"-prefix_pop": "prefixes popped"}.get(
        words[-1], words[-1].removeprefix(":").removesuffix("/log")
    )
    assert message in left.err


@pytest.mark.parametrize("line", ["-fp_trap", "-python", "-history /nonexistent/log", "-options_file mine"])
def test_options_files_are_checked_before_petsc_reads_them(tmp_path: Path, line: str) -> None:
    (tmp_path / "mine").write_text(f"# mine\n-ksp_type cg # usual\n{line}\n")
    left = lyra(["run", write_scene(tmp_path), "--out", "out", "--petscrc", "mine"], tmp_path)
    assert left.code == 2, left.err
    (message,) = left.err.splitlines()
    assert message.startswith(f"lyra-petsc: --petscrc: mine: {line.split()[0]}: ")
