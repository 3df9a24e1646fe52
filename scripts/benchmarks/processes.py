"""Starts measured processes with a time limit, reads their errors, and ends them with all their children."""

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
"""Seconds after the request to end before a process is killed."""

HERE = Path(__file__).parents[2]
WORKER = Path("scripts", "benchmarks", "worker.py")


class Failed(Exception):
    """A measurement failed; the message is one line."""


@dataclass(frozen=True)
class Limits:
    """Limits of a measurement.

    Attributes
    ----------
    steps : int
        Maximum number of measured steps of a row.
    seconds : float
        Time [s] after which a row measures no further steps.
    process : float
        Time limit [s] of a process.
    """

    steps: int
    seconds: float
    process: float


class Spent(NamedTuple):
    """Wall time [s] of a process, and CPU time [s] of it and its children."""

    wall: float
    cpu: float


def run(
    command: Sequence[str] | str, limit: float, cwd: Path | None = None, *, program: Path = HERE
) -> Spent:
    """Run a command, a list of words or a line for the shell, with the package of the checkout ``program``.

    Raises
    ------
    Failed
        If it cannot be started, takes longer than ``limit`` [s] or has a nonzero exit code.
    """
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as errors:
        began, cpu = time.perf_counter(), _cpu_of_children()
        variables = environment()
        variables["PYTHONPATH"] = os.pathsep.join(filter(None, [str(program), variables.get("PYTHONPATH")]))
        try:
            process = subprocess.Popen(
                command,
                shell=isinstance(command, str),
                cwd=cwd,
                env=variables,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
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
        errors.seek(0)
        if code != 0:
            raise Failed(_error_message(errors.read(), code))
    return spent


def _cpu_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process that is still running, and its children."""
    if process.poll() is not None:
        return
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(GRACE)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _error_message(stderr: str, code: int) -> str:
    """Message of a failed process: this program's line if there is one, else the last line."""
    lines = [line.strip() for line in stderr.splitlines() if line.strip(" -\t*")]
    ours = [line.removeprefix("lyra-petsc: ") for line in lines if line.startswith("lyra-petsc: ")]
    errors = [line for line in lines if line.partition(":")[0].endswith(("Error", "Exception"))]
    if ours:
        return ours[0]
    last = (errors or lines)[-1:]
    reason = f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    return f"{reason}: {last[0][:200]}" if last else reason


def measure(
    kind: str, ranks: int, petsc: Sequence[str], limit: float, *, program: Path = HERE, **job: Any
) -> dict[str, Any]:
    """Perform one measurement by a checkout's ``worker.py`` on ``ranks`` ranks; returns its result.

    Raises
    ------
    Failed
    """
    with tempfile.TemporaryDirectory(prefix="lyra-bench-") as folder:
        job_file, result = Path(folder, "job.json"), Path(folder, "result.json")
        job_file.write_text(json.dumps({"kind": kind, **job}), encoding="utf-8")
        words = [sys.executable, str(program / WORKER), str(job_file), str(result), *petsc]
        run([*find_launcher(ranks), *words], limit, program=program)
        measured: dict[str, Any] = json.loads(result.read_text(encoding="utf-8"))
    return measured
