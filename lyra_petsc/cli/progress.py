"""Progress of runs, films and studies on the terminal, and the closing table of a run's wall time."""

from __future__ import annotations

import math
import sys
import time as wall
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from mpi4py import MPI
    from rich.progress import Progress as Bar
    from typing_extensions import Self

REDRAW_SECONDS = 0.1
LINE_SECONDS, LINE_FRACTION, LATEST_LINE_SECONDS = 2.0, 0.05, 60.0
"""A plain line is printed for each 5 % of the work, not more often than each two seconds, or each minute."""


class ProgressBar:
    """A progress bar if stderr is a terminal, else plain lines. Shown by rank 0 only.

    Parameters
    ----------
    comm : MPI.Comm
        All ranks may make the same calls; no method communicates.
    plain : bool
        Print lines even on a terminal.
    stream : text stream
        Default stderr, so that stdout only has results.
    clock : callable
        Returns seconds.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        *,
        plain: bool = False,
        stream: TextIO | None = None,
        clock: Callable[[], float] = wall.monotonic,
    ) -> None:
        self._shown = comm.rank == 0
        self._stream, self._clock = stream or sys.stderr, clock
        self._at = self._shown_at = -math.inf, math.inf  # clock time and fraction: latest, latest shown
        self._first = 0.0, 0.0  # of the first update
        self._pending = ""  # a line that is not printed yet
        self._bar: Bar | None = None
        if self._shown and not plain and self._stream.isatty():
            self._bar = _bar(self._stream)
            self._task = self._bar.add_task("", total=1.0, state="")
            self._bar.start()

    def say(self, text: str) -> None:
        """Print a line for the user, above the bar."""
        if not self._shown:
            return
        with suppress(OSError, ValueError):  # a run continues even if its messages cannot be written
            if self._bar is not None:
                self._bar.console.print(text, markup=False, highlight=False)
            else:
                print(text, file=self._stream, flush=True)

    def show(self, fraction: float, text: str) -> None:
        """Show the fraction of the work that is done, a text, and after the first update the time left.

        Cheap enough to be called after each step.
        """
        now = self._clock()
        if fraction < self._at[1]:  # the work begins, also once more
            self._first, self._shown_at = (now, fraction), (-math.inf, -math.inf)
        self._at = now, fraction
        # by the mean speed since the first update, as the first step takes longest
        if (done := fraction - self._first[1]) > 0.0:
            text += f"  {duration((now - self._first[0]) * (1.0 - fraction) / done)} left"
        since, more = now - self._shown_at[0], fraction - self._shown_at[1]
        if self._bar is not None:
            with suppress(OSError):
                self._bar.update(self._task, completed=fraction, state=text)
                if fraction >= 1.0 or since >= REDRAW_SECONDS:
                    self._shown_at = self._at
                    self._bar.refresh()
            return
        self._pending = f"{fraction:4.0%}  {text}"
        due = since >= LINE_SECONDS and more >= LINE_FRACTION - 1e-9  # round-off
        if due or since >= LATEST_LINE_SECONDS:
            self.say(self._pending)
            self._shown_at, self._pending = self._at, ""

    def close(self) -> None:
        """Show the last update and remove the bar."""
        if self._bar is not None:
            with suppress(OSError):
                self._bar.refresh()
                self._bar.stop()
            self._bar = None
        elif self._pending:
            self.say(self._pending)
            self._pending = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class StudyProgress(ProgressBar):
    """The progress of a study.

    Parameters
    ----------
    comm : MPI.Comm
    stop : callable
        Called after every step on all ranks; may raise to end the study.
    combinations : int
        Number of combinations.
    **options
        Parameters of `ProgressBar`.
    """

    def __init__(self, comm: MPI.Comm, stop: Callable[[], None], combinations: int, **options: Any) -> None:
        super().__init__(comm, **options)
        self._stop, self._combinations = stop, combinations
        self._label, self._number = "", 0

    def case(self, label: str, *, resumed: bool) -> None:
        """A case begins, or was finished before."""
        reference = label.startswith("reference")
        self._number += not reference
        self._label = label if reference else f"{self._number}/{self._combinations} {label}"
        if self._bar is None:
            self.say(f"{self._label}: finished before" if resumed else self._label)

    def progress(self, done: float, whole: float) -> None:
        """Show the work done of the whole work; may raise, see ``stop``."""
        self._stop()
        self.show(min(done / whole, 1.0) if whole > 0.0 else 1.0, self._label)

    def note(self, text: str) -> None:
        """Print a line for the user, above the bar."""
        self.say(f"note: {text}")


def closing_table(phases: Mapping[str, float], folder: Path, outcome: str) -> None:
    """Print the wall time [s] of each phase, where the results are and how to open them; on one rank."""
    total = sum(phases.values())
    rows = [*phases.items(), ("total", total)]
    lines = [f"{'phase':<12} {'wall time':>12} {'share':>5}"]
    lines += [f"{name:<12} {s:>10.2f} s {s / total:>5.0%}" for name, s in rows if f"{s:.2f}" != "0.00"]
    lines += [f"results      {folder}", f"open         paraview {folder / 'states.xdmf'}"]
    lines.append(f"outcome      {outcome}")
    with suppress(OSError):
        print("\n".join(lines), flush=True)


def duration(seconds: float) -> str:
    """A duration [s] as ``1:05:09``; ``?`` if it is not finite."""
    return str(timedelta(seconds=round(seconds))) if math.isfinite(seconds) else "?"


def _bar(stream: TextIO) -> Bar:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = BarColumn(24), TaskProgressColumn(), TextColumn("{task.fields[state]}", markup=False)
    # no thread beside MPI; redrawn with the steps
    return Progress(*columns, console=Console(file=stream), auto_refresh=False)
