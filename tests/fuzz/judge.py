"""Runs a fuzz case in a forked process as the program would, and judges its output and files.

Allowed are a run (exit 0, finite states), one line on bad input (exit 2, nothing written) and one line on a
solver that failed (exit 3, the last good state kept). All else is a bug: a traceback, a signal, a warning of
numpy, unbounded CPU time or memory, more than one line, another file.
"""

from __future__ import annotations

import gc
import importlib
import os
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path

from patience import Patience

CPU_SECONDS = 60
"""Limit on the CPU time of a case; the first cases in a new checkout compile kernels."""

WALL_SECONDS = 300.0
MEMORY = 4 * 2**30
"""Limit on the address space [B] of a case, in addition to that of its parent process."""

LONGEST_LINE = 1000
STEPS = 2
"""Largest number of steps of a case."""

UNSTABLE = 71
"""Exit code of a case whose scene is another one after writing and reading."""

WARM = """\
mesh: {grid: {width: 1.0, height: 1.0, nx: 2, ny: 2}}
material: {density: 0.15, membrane: {c11: 800, c22: 800, c12: 160, c33: 240}, bending: 2.0e-5, damping: 0.005}
gravity: [0, 0, -9.81]
wind: {velocity: [0, 3, 0], density: 1.2, drag: 0.1}
handles: [{nodes: [0, 1], clamp: true}, {nodes: [8], stiffness: 100}]
loads: [{nodes: [4], force: [0, 0, 1]}, {pressure: 1}, {traction: [0, 0, 1]}]
time: {end: 0.02, step: 0.01}
"""


@dataclass(frozen=True)
class Case:
    """Files, among them a scene, and arguments of the command line.

    Attributes
    ----------
    kind : str
        Kind of the case, for statistics.
    files : mapping of name → content
    scene : str
        Name of the scene file.
    settings : tuple of str
        ``--set`` arguments.
    verb : str
        ``run`` or ``check``.
    """

    kind: str
    files: Mapping[str, bytes]
    scene: str = "scene.yaml"
    settings: tuple[str, ...] = ()
    verb: str = "run"

    def write(self, folder: Path) -> None:
        """Write the files to an empty folder."""
        for name, content in self.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)

    @property
    def arguments(self) -> list[str]:
        """Arguments of the command line."""
        chosen = [word for setting in self.settings for word in ("--set", setting)]
        folder = ["--out", "out"] if self.verb == "run" else []
        return [self.verb, self.scene, *chosen, *folder]


@dataclass
class Outcome:
    """How a case ended.

    Attributes
    ----------
    code : int
        Exit code, negative for a signal.
    line : str
        The line with which the program reports how it ended; empty if there is none.
    complaint : str
        What is wrong with the outcome; empty if nothing is.
    seconds : float
    """

    code: int
    out: str = ""
    err: str = ""
    seconds: float = 0.0
    complaint: str = field(default="")

    @property
    def line(self) -> str:
        return "".join(_report_lines(self.err.splitlines())[:1])


def _report_lines(lines: list[str]) -> list[str]:
    """Lines with which the program reports how it ended, without warnings."""
    return [line for line in lines if line.startswith("lyra-petsc: ") and ": warning: " not in line]


def warm(folder: Path) -> None:
    """Import and compile all that a run needs in this process, from which cases are forked."""
    scene = folder / "warm.yaml"
    scene.write_text(WARM)
    from lyra_petsc.cli.app import run_command_line

    for module in ("scene.original", "mesh.obj_file", "mesh.msh_file", "mesh.library_file"):
        importlib.import_module(f"lyra_petsc.{module}")
    with (
        (folder / "warm.txt").open("w") as output,
        redirect_stdout(output),
        redirect_stderr(output),
    ):
        for integrator in ("beuler", "bdf2", "alpha2", "midpoint", "semi-implicit"):
            out = str(folder / f"warm-{integrator}")
            arguments = ["run", str(scene), "--set", f"time.integrator={integrator}", "--out", out]
            assert run_command_line(["lyra-petsc", *arguments]) == 0
    gc.collect()
    gc.freeze()  # else the garbage collector of each forked process would copy all memory pages


def judge(case: Case, folder: Path) -> Outcome:
    """Run a case in an empty folder, in a child process, and judge it."""
    inside = folder / "case"
    inside.mkdir()
    case.write(inside)
    before = listing(inside)
    started = time.monotonic()
    pid = os.fork()
    if pid == 0:
        _child(case, inside, folder)
    status = _wait(pid)
    code = os.waitstatus_to_exitcode(status)
    outcome = Outcome(
        code,
        (folder / "stdout").read_text(errors="replace"),
        (folder / "stderr").read_text(errors="replace"),
        time.monotonic() - started,
    )
    outcome.complaint = complaint(outcome, inside, before)
    return outcome


def _wait(pid: int) -> int:
    patience = Patience(WALL_SECONDS)
    pause = 1e-3
    while True:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            return status
        if patience.over:
            os.kill(pid, signal.SIGKILL)
            return os.waitpid(pid, 0)[1]
        time.sleep(pause)
        pause = min(2 * pause, 0.02)


def _child(case: Case, inside: Path, folder: Path) -> None:
    """Run the program in the child process; never returns."""
    code = 99
    gc.freeze()  # else the collector would find here, and warn of, files that earlier tests left open
    try:
        os.setsid()
        os.chdir(inside)
        for number, name in ((1, "stdout"), (2, "stderr")):
            file = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(file, number)
        sys.stdout = os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", closefd=False)
        warnings.resetwarnings()
        warnings.showwarning = lambda message, kind, file, line, *_: print(
            f"{file}:{line}: {kind.__name__}: {message}", file=sys.stderr
        )
        here = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (here + MEMORY, here + MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        used = resource.getrusage(resource.RUSAGE_SELF)
        seconds = int(used.ru_utime + used.ru_stime) + CPU_SECONDS
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
        code = _run(case)
    except BaseException:
        traceback.print_exc()
    finally:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)


def _run(case: Case) -> int:
    from petsc4py import PETSc

    from lyra_petsc.cli.app import run_command_line
    from lyra_petsc.mesh import library_file

    os.environ["LYRA_TRACEBACK"] = "1"
    library_file.READ_SECONDS, library_file.MESH_SECONDS = 2, 3
    PETSc.Options().setValue("ts_max_steps", STEPS)
    code = run_command_line(["lyra-petsc", *case.arguments])
    if code == 0 and case.verb == "run":
        from lyra_petsc.scene.load import load_scene

        if load_scene(case.scene, case.settings) != load_scene("out/scene.yaml"):
            return UNSTABLE
    return code


def complaint(outcome: Outcome, inside: Path, before: Mapping[str, float]) -> str:
    """What is wrong with an outcome; empty if nothing is.

    Parameters
    ----------
    outcome : Outcome
    inside : Path
        The folder of the case, as the program left it.
    before : mapping
        `listing` of it before.
    """
    # without reports of gmsh's progress, which depend on the load of the machine
    lines = [line for line in outcome.err.splitlines() if not line.endswith(" s so far")]
    ours = _report_lines(lines)
    if outcome.code < 0:
        return f"ended by {signal.Signals(-outcome.code).name}"
    if outcome.code not in (0, 2, 3):
        return f"exit code {outcome.code}"
    for mark in ("Traceback", "Warning:", "PETSC ERROR", "Exception ignored", "Segmentation"):
        if mark in outcome.err:
            return f"{mark} on stderr"
    for name, changed in before.items():
        if listing(inside).get(name) != changed:
            return f"{name} was changed"
    left = sorted(set(listing(inside)) - set(before))
    if outcome.code == 2:
        if len(lines) != 1 or ours != lines:
            return f"{len(lines)} lines on stderr instead of one of ours"
        if outcome.out:
            return "bad input, and words on stdout"
        if left:
            return f"bad input, and {left[0]} is left"
    if outcome.code == 3 and len(ours) != 1:
        return f"{len(ours)} lines of ours on stderr instead of one"
    if outcome.code != 0:
        if len(ours[0]) > LONGEST_LINE:
            return f"a line of {len(ours[0])} characters"
        if not ours[0].isprintable():
            return "a line with characters that cannot be printed"
    elif ours:
        return "done, and a line of ours on stderr"
    strange = [name for name in left if name.split("/")[0] != "out"]
    if strange:
        return f"{strange[0]} is left"
    if outcome.code == 0 and not left:
        return "" if "linear solver" in outcome.out else "neither a plan nor results"
    return "" if outcome.code == 2 else _unreadable(inside / "out")


def _unreadable(out: Path) -> str:
    """What is wrong with the states of a run."""
    import numpy as np

    from lyra_petsc.errors import InputError
    from lyra_petsc.output.read_run import StoredRun

    if not (out / "states.xdmf").exists():
        return "no states.xdmf"
    try:
        np.asarray(StoredRun(out).positions)
    except InputError as error:
        return str(error)
    return ""


def listing(folder: Path) -> dict[str, float]:
    """Times of the last modification of all files of a folder."""
    return {
        str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()
    }
