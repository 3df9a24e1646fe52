"""Progress of runs, films and studies on the terminal, and the closing table of a run's wall time."""

from __future__ import annotations

import math
import sys
import time as wall
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from mpi4py import MPI
    from rich.progress import Progress as Bar
    from typing_extensions import Self

ESTIMATE_UPDATES, ESTIMATE_SECONDS, ESTIMATE_FRACTION = 3, 2.0, 0.05
"""Updates, and seconds or part of the work, after which the remaining time is shown."""

REDRAW_SECONDS = 0.1
LINE_SECONDS, LINE_FRACTION = 2.0, 0.05
MAX_LINE_SECONDS = 60.0
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
        self._drawn = -math.inf  # clock time when the bar was last drawn
        self._printed = -math.inf, -math.inf  # clock time and fraction of the last plain line
        self._pending = ""  # a line that is not printed yet
        self._first, self._updates, self._fraction = (0.0, 0.0), 0, 0.0
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
        """Show the fraction of the work that is done, a text, and after some updates the time left.

        Cheap enough to be called after each step.
        """
        now = self._clock()
        if not self._updates or fraction < self._fraction:  # the work begins, also once more
            self._first, self._updates = (now, fraction), 0
        self._updates, self._fraction = self._updates + 1, fraction
        text += self._time_left(now - self._first[0], fraction - self._first[1])
        if self._bar is not None:
            with suppress(OSError):
                self._bar.update(self._task, completed=fraction, state=text)
                if fraction >= 1.0 or now - self._drawn >= REDRAW_SECONDS:
                    self._drawn = now
                    self._bar.refresh()
            return
        self._pending, since = f"{fraction:4.0%}  {text}", now - self._printed[0]
        due = fraction - self._printed[1] >= LINE_FRACTION - 1e-9
        if since >= MAX_LINE_SECONDS or (since >= LINE_SECONDS and due):
            self._print_pending()

    def _time_left(self, seconds: float, done: float) -> str:
        """Estimate by the mean speed since the first update, as the first step takes longest."""
        enough = seconds >= ESTIMATE_SECONDS or done >= ESTIMATE_FRACTION
        if self._updates <= ESTIMATE_UPDATES or not enough or done <= 0.0:
            return ""
        return f"  {duration(seconds * (1.0 - self._fraction) / done)} left"

    def _print_pending(self) -> None:
        self.say(self._pending)
        self._printed, self._pending = (self._clock(), self._fraction), ""

    def close(self) -> None:
        """Show the last update and remove the bar."""
        if self._bar is not None:
            with suppress(OSError):
                self._bar.refresh()
                self._bar.stop()
            self._bar = None
        elif self._pending:
            self._print_pending()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class Progress(ProgressBar):
    """The progress of a run.

    Parameters
    ----------
    comm : MPI.Comm
    end : float
        Simulated time at which the run ends [s] (static: load factor 1).
    start : float
        Simulated time at which it starts or resumes [s].
    unit : str
        Unit of the time; empty for a load factor.
    **options
        Parameters of `ProgressBar`.
    """

    def __init__(
        self, comm: MPI.Comm, end: float, *, start: float = 0.0, unit: str = "s", **options: Any
    ) -> None:
        super().__init__(comm, **options)
        self._name = "t" if unit else "load"
        self._unit = f" {unit}" if unit else ""
        self._start, self._end = start, end

    def update(
        self, step: int, time: float, newton_iterations: int, linear_iterations: int, energy: float
    ) -> None:
        """Show an accepted step.

        Parameters
        ----------
        step : int
            Accepted steps so far.
        time : float
            Simulated time [s].
        newton_iterations, linear_iterations : int
            Iterations of this step.
        energy : float
            Kinetic and potential energy [J].
        """
        span = self._end - self._start
        fraction = min(max((time - self._start) / span, 0.0), 1.0) if span > 0 else 1.0
        self.show(
            fraction,
            f"{self._name} {time:.4g} of {self._end:.4g}{self._unit}  step {step}  "
            f"Newton {newton_iterations}  linear {linear_iterations}  energy {energy:.4g} J",
        )


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
        fraction = min(max(done / whole, 0.0), 1.0) if whole > 0.0 else 1.0
        self.show(fraction, self._label)

    def note(self, text: str) -> None:
        """Print a line for the user, above the bar."""
        self.say(f"note: {text}")


def closing_table(comm: MPI.Comm, phases: Mapping[str, float], folder: Path | str, outcome: str) -> None:
    """Print the wall time of each phase, where the results are and how to open them. Rank 0 only.

    Parameters
    ----------
    comm : MPI.Comm
        Only its rank 0 prints.
    phases : mapping of str to float
        Wall seconds by phase; they add up to the total.
    folder : path
        The run's folder.
    outcome : str
        Text on how the run ended.
    """
    if comm.rank > 0:
        return
    total = sum(phases.values())
    lines = [f"{'phase':<12} {'wall time':>12} {'share':>5}"]
    lines += [
        f"{name:<12} {seconds:>10.2f} s {f'{seconds / total:.0%}' if total > 0 else '':>5}".rstrip()
        for name, seconds in [*phases.items(), ("total", total)]
        if seconds >= 0.005 or name == "total"
    ]
    states = f"paraview {Path(folder) / 'states.xdmf'}"
    for name, text in (("results", folder), ("open", states), ("outcome", outcome)):
        lines.append(f"{name:<12} {text}")
    with suppress(OSError):
        print("\n".join(lines), flush=True)


def duration(seconds: float) -> str:
    """A duration [s] as ``1:05:09`` or ``5:09``; ``?`` if it is not finite."""
    if not math.isfinite(seconds):
        return "?"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _bar(stream: TextIO) -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn
    from rich.progress import Progress as Bar

    return Bar(
        BarColumn(bar_width=24),
        TaskProgressColumn(),
        TextColumn("{task.fields[state]}", markup=False),
        console=Console(file=stream),
        auto_refresh=False,  # no thread beside MPI; redrawn with the steps
    )
