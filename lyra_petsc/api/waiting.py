"""Detects ranks that share processors, and estimates the number of ranks for which these suffice."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from mpi4py import MPI

from lyra_petsc.kernels.compilation import COMPILATION

MIN_SECONDS = 3.0
"""Wall time of steps [s] before a note is given."""

MAX_WAIT = 0.3
"""Fraction of the time without a processor above which a note is given; it fluctuates."""


@dataclass(frozen=True)
class Share:
    """Processor time of a rank over wall time, and the processors on which it may run."""

    machine: str
    share: float
    processors: frozenset[int]


class Waiting:
    """Compares the CPU time of steps with their wall time.

    Waiting in MPI keeps a core busy, so that both are equal unless ranks share cores.

    Parameters
    ----------
    comm : MPI.Comm

    Attributes
    ----------
    note : str
        Note for the user; empty if ranks do not wait.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm, self.note = comm, ""
        self._wall = self._used = 0.0
        self._steps, self._next_check = 0, 8

    @contextmanager
    def step(self) -> Iterator[None]:
        """Measure the step taken within the context, unless it compiles kernels."""
        compiled, wall, used = COMPILATION.seconds, time.perf_counter(), time.process_time()
        yield
        self._steps += 1
        if COMPILATION.seconds == compiled:
            self._wall += time.perf_counter() - wall
            self._used += time.process_time() - used

    def check(self, *, last: bool = False) -> str:
        """Check after 8, 16, 32, … steps and the last one; returns the note, only once; collective."""
        if self.note or self._comm.size == 1 or not (last or self._steps == self._next_check):
            return ""
        self._next_check *= 2
        share = min(1.0, self._used / self._wall) if self._wall > 0.0 else 1.0
        mine = Share(platform.node(), share, frozenset(_processors()))
        everyone = self._comm.allgather((self._wall, mine))
        if everyone[0][0] >= MIN_SECONDS:
            self.note = note_on([one for _, one in everyone])
        return self.note


def note_on(shares: Sequence[Share]) -> str:
    """Note for the user on the shares of all ranks; empty if there are enough processors."""
    ranks = len(shares)
    machines: dict[str, list[Share]] = {}
    for share in shares:
        machines.setdefault(share.machine, []).append(share)
    suitable, processors = 0, 0
    for here in machines.values():
        available = len(frozenset().union(*(one.processors for one in here)))
        processors += available
        suitable += max(1, min(available, len(here), round(sum(one.share for one in here))))
    waiting = 1.0 - sum(one.share for one in shares) / ranks
    if waiting < MAX_WAIT or suitable >= ranks:
        return ""
    why = f"there are {processors}" if processors < ranks else "other programs use them"
    return (
        f"{ranks} ranks were without a processor for {100.0 * waiting:.0f} % of the time ({why}) and waited "
        f"for each other; {suitable} {'rank' if suitable == 1 else 'ranks'} would be faster"
    )


def _processors() -> Sequence[int]:
    """Numbers of the processors on which this process may run."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return range(os.cpu_count() or 1)
