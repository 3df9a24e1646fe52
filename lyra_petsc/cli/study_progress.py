"""What a study shows while it runs: a bar with the time left, or plain lines."""

from __future__ import annotations

import math
import sys
import time as wall
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, TextIO

from mpi4py import MPI

from lyra_petsc.cli.progress import LINE_AT_LEAST_SECONDS, REDRAW_SECONDS, _bar, duration

if TYPE_CHECKING:
    from rich.progress import Progress as Bar


class StudyProgress:
    """A progress bar where stderr is a terminal, plain lines where not. Shown by rank 0 only.

    Parameters
    ----------
    comm : MPI.Comm
        All ranks may make the same calls; none communicates but through ``stop``.
    stop : callable
        Called after every step on all ranks; may raise to end the study.
    combinations : int
        How many there are.
    plain : bool
        Lines also on a terminal.
    stream : text stream
        stderr unless given.
    clock : callable
        Returns seconds.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        stop: Callable[[], None],
        combinations: int,
        *,
        plain: bool = False,
        stream: TextIO | None = None,
        clock: Callable[[], float] = wall.monotonic,
    ) -> None:
        self._shown, self._stop, self._combinations = comm.rank == 0, stop, combinations
        self._stream, self._clock = stream or sys.stderr, clock
        self._began: float | None = None
        self._begun_with = 0.0
        self._label, self._number = "", 0
        self._last_shown = -math.inf
        self._bar: Bar | None = None
        if self._shown and not plain and self._stream.isatty():
            self._bar = _bar(self._stream)
            self._task = self._bar.add_task("", total=1.0, state="")
            self._bar.start()

    def case(self, label: str, *, resumed: bool) -> None:
        """A case begins, or was found finished."""
        reference = label.startswith("reference")
        self._number += not reference
        self._label = label if reference else f"{self._number}/{self._combinations} {label}"
        if self._shown and self._bar is None:
            self._line(f"{self._label}: finished before" if resumed else self._label)

    def progress(self, done: float, whole: float) -> None:
        """Work done and in all; may raise, see ``stop``."""
        self._stop()
        if not self._shown:
            return
        now = self._clock()
        if self._began is None:
            # what was finished before took no time now
            self._began, self._begun_with = now, done
        fraction = min(max(done / whole, 0.0), 1.0) if whole > 0.0 else 1.0
        fresh = (done - self._begun_with) / (whole - self._begun_with) if whole > self._begun_with else 1.0
        left = (now - self._began) * (1.0 - fresh) / fresh if fresh > 0.0 else math.nan
        if self._bar is not None:
            if now - self._last_shown >= REDRAW_SECONDS or fraction >= 1.0:
                state = f"{self._label}  {duration(left)} left"
                self._bar.update(self._task, completed=fraction, state=state)
                self._bar.refresh()
                self._last_shown = now
        elif now - self._last_shown >= LINE_AT_LEAST_SECONDS:
            self._line(f"{fraction:4.0%}  {self._label}  {duration(left)} left")

    def note(self, text: str) -> None:
        """A line for the user, above the bar."""
        if not self._shown:
            return
        if self._bar is not None:
            self._bar.console.print(f"note: {text}", markup=False, highlight=False)
        else:
            self._line(f"note: {text}")

    def _line(self, text: str) -> None:
        print(text, file=self._stream, flush=True)
        self._last_shown = self._clock()

    def __enter__(self) -> StudyProgress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.refresh()
            self._bar.stop()
            self._bar = None
