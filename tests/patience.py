"""Waiting for programs for as long as they may take, on an idle machine or a busy one."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SECONDS = 60.0
"""Time [s] that no program of the tests takes on an idle machine."""

LOOK = 0.5
"""Time [s] between two looks at the load of the machine."""

LOAD = Path("/proc/stat")


def share() -> float:
    """Part of the time in which a process has a processor, by the number of processes that want one now."""
    try:
        lines = LOAD.read_text(encoding="ascii").splitlines()
    except OSError:  # not Linux
        return 1.0
    wanting = next((int(line.split()[1]) for line in lines if line.startswith("procs_running ")), 1)
    return min(1.0, (os.cpu_count() or 1) / max(wanting, 1))


class Patience:
    """Is over after as many seconds as a process would take on an idle machine.

    Parameters
    ----------
    seconds : float
        Time [s] on an idle machine.
    """

    def __init__(self, seconds: float = SECONDS) -> None:
        self._left, self._looked, self._share = seconds, time.monotonic(), share()

    @property
    def over(self) -> bool:
        """Whether the time is over; to be asked again and again."""
        now = time.monotonic()
        if now - self._looked > LOOK:
            self._left -= (now - self._looked) * min(self._share, share())
            self._looked, self._share = now, share()
        return self._left < 0.0


def communicate(process: subprocess.Popen[Any], seconds: float = SECONDS) -> tuple[Any, Any]:
    """Output and errors of a process after its end.

    Raises
    ------
    subprocess.TimeoutExpired
        If it takes too long.
    """
    patience = Patience(seconds)
    while True:
        try:
            return process.communicate(timeout=1.0)
        except subprocess.TimeoutExpired:
            if patience.over:
                raise


def run_program(
    words: Sequence[Any], seconds: float = SECONDS, **keywords: Any
) -> subprocess.CompletedProcess[str]:
    """Run a program to its end, with its output and errors as text; kill it and fail if it takes too long."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, **(pipes | keywords)) as process:
        try:
            out, err = communicate(process, seconds)
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(words, process.returncode, out, err)
