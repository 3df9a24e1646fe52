"""Starts the program as a user does, in another process or in several under mpirun.

Runs that tests do not watch are forked, on each rank, from a process that has done half of the imports (see
``forks``), which take longer than most of these runs.
"""

from __future__ import annotations

import atexit
import csv
import json
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from patience import SECONDS, Patience, communicate

ROOT = Path(__file__).parents[2]
RANK = Path(__file__).with_name("rank.py")
SESSIONS = tempfile.mkdtemp(prefix="lyra-")
"""Folder of Open MPI's sessions: jobs of other processes that end at the same time remove a common one."""
atexit.register(shutil.rmtree, SESSIONS, ignore_errors=True)

LAUNCHER = {
    "OMPI_MCA_orte_tmpdir_base": SESSIONS,
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    # more ranks than cores: a waiting rank yields its core
    "OMPI_MCA_mpi_yield_when_idle": "1",
    # a process without mpirun starts no daemon, and none looks for networks: up to half a second each
    "OMPI_MCA_ess_singleton_isolated": "1",
    "OMPI_MCA_pml": "ob1",
}

SCENE = """\
mesh: {grid: {width: 1.0, height: 1.0, nx: 4, ny: 4}}
material: {density: 0.15, membrane: {c11: 800, c22: 800, c12: 160, c33: 240}, bending: 2.0e-5, damping: 0.005}
gravity: [0, 0, -9.81]
handles: [{nodes: [0, 4]}]
time: {end: 0.05, step: 0.01}
output: {every: 0.02}
"""
"""A hanging square of 25 vertices and five steps; states at 0, 0.02, 0.04 and 0.05 s."""

DIRECT = ("-ksp_type", "preonly", "-pc_type", "lu")

REDUNDANT = ("-ksp_type", "preonly", "-pc_type", "redundant")
"""Options of a direct solver on any number of ranks, which communicates less often than iterative ones."""

UNHURRIED = """
import sys, time
import lyra_petsc.stepping.simulation as simulation
from lyra_petsc.cli.app import run_command_line

step = simulation.SteppedScene.step

def unhurried(self):
    time.sleep(0.01)
    return step(self)

simulation.SteppedScene.step = unhurried
sys.exit(run_command_line(sys.argv))
"""
"""The program, for runs beside others: between its steps it leaves the processor to them."""

PICTURES = ("matplotlib", "jinja2")
"""Packages without which reports have no pictures."""

PLAIN = {"TESTS_WITHOUT": " ".join(PICTURES)}
"""Environment for commands whose pages a test does not look at: drawing takes longer than small cases."""


@dataclass
class Left:
    """Output and exit code of a process."""

    code: int
    out: str
    err: str

    @property
    def lines(self) -> list[str]:
        """Lines on stderr, without that on compilation: kernels may be compiled by earlier tests."""
        return [line for line in self.err.splitlines() if not line.startswith("compiling kernels")]

    @property
    def ours(self) -> list[str]:
        """Lines on stderr that begin with the program's name, without a launcher's banner."""
        return [line for line in self.err.splitlines() if line.startswith("lyra-petsc: ")]


def write_scene(folder: Path, text: str = SCENE, name: str = "scene.yaml") -> Path:
    """Write a scene file."""
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def read_csv(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def read_json(path: Path) -> dict[str, Any]:
    """Content of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


def command(
    arguments: Sequence[object], ranks: int = 1, program: Sequence[str] = ("-m", "lyra_petsc")
) -> list[str]:
    """Words of a command line; skips the test if mpirun is needed and missing."""
    words = [sys.executable, *program, *map(str, arguments)]
    if ranks == 1:
        return words
    mpirun = shutil.which("mpirun")
    if mpirun is None:
        pytest.skip("needs mpirun")
    return [mpirun, "-n", str(ranks), *words]


def environment(extra: Mapping[str, str] | None = None) -> dict[str, str]:
    """Environment without the variables that mark a process as part of a parallel job."""
    ours = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("OMPI_", "PMIX_", "PMI_", "HYDRA_", "PETSC_OPTIONS"))
    }
    path = str(ROOT) + os.pathsep + ours.get("PYTHONPATH", "")
    return {**ours, **LAUNCHER, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", **(extra or {})}


def start(
    arguments: Sequence[object],
    folder: Path,
    ranks: int = 1,
    extra: Mapping[str, str] | None = None,
    **keywords: Any,
) -> subprocess.Popen[str]:
    """Start the program in ``folder`` without waiting for it."""
    return subprocess.Popen(
        command(arguments, ranks, **keywords),
        cwd=folder,
        env=environment(extra),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=restore_signal_handlers,
    )


def finish(process: subprocess.Popen[str], patience: float = SECONDS) -> Left:
    """Wait for a process; one that hangs is killed with all its ranks and fails the test."""
    try:
        out, err = communicate(process, patience)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, err = process.communicate()
        pytest.fail(f"hangs: {process.args}\n{out}\n{err}")
    return Left(process.returncode, out, err)


def wait_until(
    condition: Callable[[], object], process: subprocess.Popen[str] | None = None, patience: float = SECONDS
) -> None:
    """Wait for an effect of a started process; fails if the process ends before, or takes too long."""
    waiting = Patience(patience)
    while not condition():
        assert process is None or process.poll() is None, process.communicate()
        assert not waiting.over, "the program does not get on"
        time.sleep(0.01)


class Forks:
    """Starts ``forks`` and sends it command lines."""

    def __init__(self) -> None:
        self._name = ""

    @property
    def name(self) -> str:
        """Name of the socket."""
        if not self._name:
            name = f"lyra-petsc-tests-{os.getpid()}"
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
                listener.bind("\0" + name)
                listener.listen(16)
                process = subprocess.Popen(
                    [sys.executable, str(Path(__file__).with_name("forks.py"))],
                    # else numba has stdout's colours reset at the end, where only bad input is met too
                    env=environment({"NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}),
                    stdin=listener,
                    stdout=subprocess.DEVNULL,
                    start_new_session=True,
                    preexec_fn=restore_signal_handlers,
                )
            atexit.register(process.kill)
            self._name = name
        return self._name

    @property
    def program(self) -> tuple[str, ...]:
        """Arguments of python before those of a command line, which then runs in a forked process."""
        return "-IS", str(RANK), self.name

    def run(
        self, arguments: Sequence[object], folder: Path, extra: Mapping[str, str] | None, patience: float
    ) -> Left:
        """Run on one rank to the end; a run that hangs is killed and fails the test."""
        words = [str(argument) for argument in arguments]
        asked = {"arguments": words, "folder": str(folder), "environment": environment(extra)}
        (out, to_out), (err, to_err) = os.pipe(), os.pipe()
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
            connection.connect("\0" + self.name)
            socket.send_fds(connection, [json.dumps(asked).encode()], [to_out, to_err])
            os.close(to_out)
            os.close(to_err)
            said, ended = read_pipes({out, err}, patience)
            connection.settimeout(patience if ended else 0.0)
            try:
                code = json.loads(connection.recv(64))
            except OSError:
                pytest.fail(f"hangs: {words}\n{said[out]}\n{said[err]}")
        return Left(code, said[out], said[err])


def read_pipes(files: set[int], patience: float) -> tuple[dict[int, str], bool]:
    """Text from pipes until they are closed, and whether this happened in time."""
    pieces = {file: bytearray() for file in files}
    waiting, still = Patience(patience), set(files)
    while still and not waiting.over:
        for file in select.select(still, [], [], 1.0)[0]:
            piece = os.read(file, 2**16)
            pieces[file] += piece
            if not piece:
                still.remove(file)
    for file in files:
        os.close(file)
    texts = {file: bytes(piece).decode() for file, piece in pieces.items()}
    return {f: text.replace("\r\n", "\n").replace("\r", "\n") for f, text in texts.items()}, not still


FORKS = Forks()


def restore_signal_handlers() -> None:
    """Restore default handlers: under nohup, or in the background, signals are ignored by inheritance."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def lyra(
    arguments: Sequence[object],
    folder: Path,
    ranks: int = 1,
    extra: Mapping[str, str] | None = None,
    patience: float = SECONDS,
    **keywords: Any,
) -> Left:
    """Run the program in ``folder`` to its end."""
    if not keywords:
        if ranks == 1:
            return FORKS.run(arguments, folder, extra, patience)
        keywords = {"program": FORKS.program}
    return finish(start(arguments, folder, ranks, extra, **keywords), patience)


def without(packages: Sequence[str], arguments: Sequence[object], folder: Path) -> Left:
    """Run the program on one rank as if these packages were not installed."""
    return lyra(arguments, folder, extra={"TESTS_WITHOUT": " ".join(packages)})


def done(
    arguments: Sequence[object],
    folder: Path,
    ranks: int = 1,
    extra: Mapping[str, str] | None = None,
    **keywords: Any,
) -> Left:
    """Run the program and require success."""
    left = lyra(arguments, folder, ranks, extra, **keywords)
    assert left.code == 0, left.err + left.out
    return left


def refused(arguments: Sequence[object], folder: Path, words: str, ranks: int = 1) -> None:
    """Run the program and require a refusal in one line with these words, without any files."""
    before = sorted(os.listdir(folder))
    left = lyra(arguments, folder, ranks)
    refusal(left, words)
    assert sorted(os.listdir(folder)) == before


def refusal(left: Left, words: str) -> None:
    """Check exit code 2 and one line of the program with these words."""
    assert left.code == 2, left.err
    assert len(left.ours) == 1, left.err
    assert len(left.ours[0]) < 800
    assert words in left.ours[0]
    assert "Traceback" not in left.err
    assert left.out == ""
