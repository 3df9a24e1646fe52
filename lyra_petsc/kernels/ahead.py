"""Compilation of kernels on a second core, before a run on one rank calls them.

``signatures.txt`` has a line for each kernel of usual scenes and the types of its arguments, in the order in
which runs first call them. ``scripts/cold_start.py --record`` writes it, and a test compares it with runs. A
kernel that it lacks is compiled when it is called, as without this module.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterable
from contextlib import suppress
from importlib.resources import files

from numba.core.sigutils import normalize_signature

from lyra_petsc.kernels.cache import KERNELS

Line = tuple[str, str]
"""Name of a kernel, and types of its arguments."""


def listed() -> list[Line]:
    """The lines of ``signatures.txt``."""
    text = files(__package__).joinpath("signatures.txt").read_text()
    return [(name, types) for name, _, types in (line.partition(" ") for line in text.splitlines())]


class CompilationAhead:
    """Compiles the listed kernels of imported modules; called whenever numba starts to compile.

    It forks a process that compiles those first that are called last, so that both meet in the middle.
    """

    def __init__(self) -> None:
        self._waiting = listed()
        self._child: int | None = None

    def __call__(self) -> None:
        """Start with the kernels of modules that have been imported since the last call."""
        lines = [line for line in self._waiting if line[0] in KERNELS]
        one_core = hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) == 1
        if one_core or not lines or self._child_is_busy():
            return
        self._waiting = [line for line in self._waiting if line[0] not in KERNELS]
        parent = os.getpid()
        self._child = os.fork()
        if self._child == 0:
            _compile_in_child(reversed(lines), parent)

    def _child_is_busy(self) -> bool:
        with suppress(ChildProcessError):
            return self._child is not None and os.waitpid(self._child, os.WNOHANG) == (0, 0)
        return False


def _compile_in_child(lines: Iterable[Line], parent: int) -> None:
    """Compile until nothing is left or the parent has ended; does not return."""
    try:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
            signal.signal(number, signal.SIG_DFL)
        signal.alarm(300)  # ends it in any case: another thread may have held a lock when it was forked
        for line in lines:
            if os.getppid() != parent:
                break
            KERNELS[line[0]].compile(normalize_signature(line[1])[0])  # type: ignore[no-untyped-call]
    finally:
        os._exit(0)
