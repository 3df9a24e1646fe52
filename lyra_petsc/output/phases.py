"""Wall time of a run, by phase; each phase is a stage of PETSc's profile, too."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from lyra_petsc.profiling import stage


class Phases:
    """Charges every second since construction to exactly one phase.

    ``with phases("assembly"):`` charges the block to ``assembly``; a phase entered inside
    another takes its time out of the outer one, so that all phases add up to the total.

    Parameters
    ----------
    clock : callable
        Returns seconds; the wall clock unless a test brings its own.
    """

    OTHER = "other"

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._seconds: dict[str, float] = {}
        self._open = [self.OTHER]
        self._start = self._charged_until = clock()

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        self._charge()
        self._seconds.setdefault(name, 0.0)
        self._open.append(name)
        try:
            with stage(name):
                yield
        finally:
            self._charge()
            self._open.pop()

    @property
    def total(self) -> float:
        """Seconds since construction."""
        return self._clock() - self._start

    def seconds(self) -> dict[str, float]:
        """Seconds of each phase in the order of first entry, then ``other``: time in none."""
        self._charge()
        other = self._seconds.get(self.OTHER, 0.0)
        return {
            **{name: value for name, value in self._seconds.items() if name != self.OTHER},
            self.OTHER: other,
        }

    def _charge(self) -> None:
        now = self._clock()
        current = self._open[-1]
        self._seconds[current] = self._seconds.get(current, 0.0) + now - self._charged_until
        self._charged_until = now
