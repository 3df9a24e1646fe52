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

MIN_STEPS = 3
MIN_SECONDS, MIN_FRACTION = 2.0, 0.05
"""Steps, and seconds or fraction of the run, after which the remaining time is estimated."""

REDRAW_SECONDS = 0.1
LINE_SECONDS = 2.0  # minimum time between plain lines;
LINE_FRACTION = 0.05  # one is printed for each 5 % of the run
MAX_LINE_SECONDS = 60.0  # or each minute, whichever comes first


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
        self._last_line, self._last_fraction = clock(), 0.0  # time and fraction of the last plain line
        self._pending = ""  # a line that is not printed yet
        self._first: tuple[float, float] | None = None  # time and work done at the first estimate
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

    def _show(
        self, fraction: float, state: str, *, seconds: float = MAX_LINE_SECONDS, part: float = math.inf
    ) -> None:
        """Update the bar, or print a line if the last one is ``seconds`` or the fraction ``part`` ago."""
        now = self._clock()
        if self._bar is not None:
            with suppress(OSError):
                self._bar.update(self._task, completed=fraction, state=state)
                if fraction >= 1.0 or now - self._drawn >= REDRAW_SECONDS:
                    self._drawn = now
                    self._bar.refresh()
            return
        self._pending, since = f"{fraction:4.0%}  {state}", now - self._last_line
        if since >= seconds or (since >= LINE_SECONDS and fraction - self._last_fraction >= part - 1e-9):
            self._last_fraction = fraction
            self._print_line(self._pending)

    def _print_line(self, text: str) -> None:
        self.say(text)
        self._last_line, self._pending = self._clock(), ""

    def _remaining(self, done: float, whole: float = 1.0) -> float:
        """Estimated remaining seconds, at the mean speed since the first call; NaN at the first call."""
        began, before = self._first = self._first or (self._clock(), done)
        if done <= before:
            return 0.0 if done >= whole else math.nan
        return (self._clock() - began) * (whole - done) / (done - before)

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            with suppress(OSError):
                self._bar.refresh()
                self._bar.stop()
            self._bar = None

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
        self._steps, self._last_line = 0, -math.inf  # the first step is shown at once

    def update(
        self, step: int, time: float, newton_iterations: int, linear_iterations: int, energy: float
    ) -> None:
        """Show an accepted step; cheap enough to be called after each.

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
        now = self._clock()
        span = self._end - self._start
        fraction = min(max((time - self._start) / span, 0.0), 1.0) if span > 0 else 1.0
        # the estimate begins after the first step, which takes longer than later ones
        remaining, self._steps = self._remaining(fraction), self._steps + 1
        began, done = self._first or (now, fraction)
        enough = now - began >= MIN_SECONDS or fraction - done >= MIN_FRACTION
        state = (
            f"{self._name} {time:.4g} of {self._end:.4g}{self._unit}  step {step}  "
            f"Newton {newton_iterations}  linear {linear_iterations}  energy {energy:.4g} J"
        )
        if self._steps > MIN_STEPS and enough and math.isfinite(remaining):
            state += f"  {duration(remaining)} left"
        self._show(fraction, state, part=LINE_FRACTION)

    def close(self) -> None:
        """Show the last step and remove the bar."""
        super().close()
        if self._pending:
            self._print_line(self._pending)


class FrameProgress(ProgressBar):
    """The progress of drawing."""

    LINE_SECONDS = 10.0

    def update(self, done: int, count: int) -> None:
        """Show the number of states that are drawn."""
        text = f"{done} of {count} states drawn  {duration(self._remaining(done, count))} left"
        self._show(done / count, text, seconds=self.LINE_SECONDS)


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
        self._label, self._number, self._last_line = "", 0, -math.inf

    def case(self, label: str, *, resumed: bool) -> None:
        """A case begins, or was finished before."""
        reference = label.startswith("reference")
        self._number += not reference
        self._label = label if reference else f"{self._number}/{self._combinations} {label}"
        if self._bar is None:
            self._print_line(f"{self._label}: finished before" if resumed else self._label)

    def progress(self, done: float, whole: float) -> None:
        """Show the work done of the whole work; may raise, see ``stop``."""
        self._stop()
        fraction = min(max(done / whole, 0.0), 1.0) if whole > 0.0 else 1.0
        self._show(fraction, f"{self._label}  {duration(self._remaining(done, whole))} left")

    def note(self, text: str) -> None:
        """Print a line for the user, above the bar."""
        self._print_line(f"note: {text}")


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
