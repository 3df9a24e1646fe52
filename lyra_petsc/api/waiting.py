"""Detects ranks that wait for a processor, and how many ranks the processors suffice for."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from mpi4py import MPI

from lyra_petsc.kernels.compilation import COMPILATION

LEAST_SECONDS = 3.0
"""Wall time of steps [s] before anything is said."""

MOST = 0.4
"""Share of the time without a processor that is worth a note; a bit less than half, as shares fluctuate."""

MOST_CROWDED = 0.2
"""The same on machines with fewer processors than ranks, where waiting ranks use them up as well."""


@dataclass(frozen=True)
class Share:
    """What one rank got: processor time over wall time, and the processors that it may run on."""

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
        What was found; nothing where ranks do not wait.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm, self.note = comm, ""
        self._wall = self._used = 0.0
        self._steps, self._look_at = 0, 8

    @contextmanager
    def step(self) -> Iterator[None]:
        """Count the block, a step, unless kernels are compiled in it."""
        compiled, wall, used = COMPILATION.seconds, time.perf_counter(), time.process_time()
        yield
        self._steps += 1
        if COMPILATION.seconds == compiled:
            self._wall += time.perf_counter() - wall
            self._used += time.process_time() - used

    def look(self, *, last: bool = False) -> str:
        """A note, once, after 8, 16, 32, … steps, and the last one; collective."""
        if self.note or self._comm.size == 1 or not (last or self._steps == self._look_at):
            return ""
        self._look_at *= 2
        share = min(1.0, self._used / self._wall) if self._wall > 0.0 else 1.0
        mine = Share(platform.node(), share, frozenset(_processors()))
        everyone = self._comm.allgather((self._wall, mine))
        if everyone[0][0] >= LEAST_SECONDS:
            self.note = in_words([one for _, one in everyone])
        return self.note


def in_words(everyone: Sequence[Share]) -> str:
    """The note on what all ranks got; nothing where there are processors for them."""
    ranks = len(everyone)
    machines: dict[str, list[Share]] = {}
    for one in everyone:
        machines.setdefault(one.machine, []).append(one)
    faster, crowded, processors = 0, False, 0
    for here in machines.values():
        present = len(frozenset().union(*(one.processors for one in here)))
        processors += present
        crowded |= present < len(here)
        faster += max(1, min(present, len(here), round(sum(one.share for one in here))))
    without = 1.0 - sum(one.share for one in everyone) / ranks
    if without < (MOST_CROWDED if crowded else MOST) or faster >= ranks:
        return ""
    why = f"there are {processors}" if crowded else "other programs use them"
    return (
        f"{ranks} ranks were without a processor for {100.0 * without:.0f} % of the time ({why}) and waited "
        f"for each other; {faster} {'rank' if faster == 1 else 'ranks'} would be faster"
    )


def _processors() -> Sequence[int]:
    """The processors that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return range(os.cpu_count() or 1)
