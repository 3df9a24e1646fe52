"""Processes that are measured: started, limited in time, listened to, and ended with all their children."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from lyra_petsc.api.mpirun import environment, find_launcher

GRACE = 10.0
"""Seconds [s] that a process gets to leave before it is killed."""

HERE = Path(__file__).parents[2]
WORKER = Path("scripts", "benchmarks", "worker.py")


class Failed(Exception):
    """A measurement that came to nothing; one line says why."""


@dataclass(frozen=True)
class Limits:
    """How long things may take.

    Attributes
    ----------
    steps : int
        Measured steps of a row, at most.
    seconds : float
        Time [s] after which a row measures no further steps.
    process : float
        Time [s] after which a process is given up.
    """

    steps: int
    seconds: float
    process: float


class Spent(NamedTuple):
    """Wall time [s] of a process, and CPU time [s] of it and of those that it has started."""

    wall: float
    cpu: float


def run(
    command: Sequence[str] | str, limit: float, cwd: Path | None = None, *, program: Path = HERE
) -> Spent:
    """Run a command, a list of words or one line for the shell, that imports the program of a checkout; what
    it took.

    Raises
    ------
    Failed
        If it cannot be started, takes longer than ``limit`` [s] or ends with another exit code than 0.
    """
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as heard:
        began, cpu = time.perf_counter(), _cpu_of_children()
        inherited = environment()
        if program != HERE:
            inherited["PYTHONPATH"] = os.pathsep.join([str(program), inherited.get("PYTHONPATH", "")])
        try:
            process = subprocess.Popen(
                command,
                shell=isinstance(command, str),
                cwd=cwd,
                env=inherited,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=heard,
                start_new_session=True,
            )
        except OSError as error:
            raise Failed(f"cannot be started: {error.strerror}") from None
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            raise Failed(f"not done within {limit:g} s") from None
        finally:
            _end(process)
        spent = Spent(time.perf_counter() - began, _cpu_of_children() - cpu)
        heard.seek(0)
        if code != 0:
            raise Failed(_last_words(heard.read(), code))
    return spent


def _cpu_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process that still runs, and what it has started."""
    if process.poll() is not None:
        return
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(GRACE)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _last_words(heard: str, code: int) -> str:
    """What a process said in the end: our line where there is one, else its last."""
    lines = [line.strip() for line in heard.splitlines() if line.strip(" -\t*")]
    ours = [line.removeprefix("lyra-petsc: ") for line in lines if line.startswith("lyra-petsc: ")]
    errors = [line for line in lines if line.partition(":")[0].endswith(("Error", "Exception"))]
    if ours:
        return ours[0]
    said = (errors or lines)[-1:]
    reason = f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    return f"{reason}: {said[0][:200]}" if said else reason


def measure(
    kind: str, ranks: int, petsc: Sequence[str], limit: float, *, program: Path = HERE, **job: Any
) -> dict[str, Any]:
    """One measurement of a checkout's ``worker.py`` on so many ranks; its result.

    Raises
    ------
    Failed
    """
    with tempfile.TemporaryDirectory(prefix="lyra-bench-") as folder:
        told, result = Path(folder, "job.json"), Path(folder, "result.json")
        told.write_text(json.dumps({"kind": kind, **job}), encoding="utf-8")
        words = [sys.executable, str(program / WORKER), str(told), str(result), *petsc]
        run([*find_launcher(ranks), *words], limit, program=program)
        found: dict[str, Any] = json.loads(result.read_text(encoding="utf-8"))
    return found
