"""What runs and films show on the terminal: how far they are, and at the end where a run's time went."""

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

FEWEST_STEPS = 3
LEAST_SECONDS, LEAST_PART = 2.0, 0.05
"""Steps, and seconds or part of the run, that have to be over for an estimate of the time left."""

REDRAW_SECONDS = 0.1
LINE_SECONDS = 2.0  # plain lines never come faster than this,
LINE_FRACTION = 0.05  # and then one for each 5 % of the run
LINE_AT_LEAST_SECONDS = 60.0  # or each minute, whichever is first


class ProgressBar:
    """A progress bar where stderr is a terminal, plain lines where not. Shown by rank 0 only.

    Parameters
    ----------
    comm : MPI.Comm
        All ranks may make the same calls; none communicates.
    plain : bool
        Lines also on a terminal.
    stream : text stream
        stderr unless given, so that stdout has results only.
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
        self._drawn, self._told, self._part_told = -math.inf, clock(), 0.0
        self._pending = ""
        self._first: tuple[float, float] | None = None
        self._bar: Bar | None = None
        if self._shown and not plain and self._stream.isatty():
            self._bar = _bar(self._stream)
            self._task = self._bar.add_task("", total=1.0, state="")
            self._bar.start()

    def say(self, text: str) -> None:
        """Print a line for the user, above the bar."""
        if not self._shown:
            return
        with suppress(OSError, ValueError):  # a run goes on also if its messages cannot be written
            if self._bar is not None:
                self._bar.console.print(text, markup=False, highlight=False)
            else:
                print(text, file=self._stream, flush=True)

    def _show(
        self, fraction: float, state: str, *, seconds: float = LINE_AT_LEAST_SECONDS, part: float = math.inf
    ) -> None:
        """Move the bar, or print a line where none has come for so many seconds, or for that part of all."""
        now = self._clock()
        if self._bar is not None:  # redrawn a few times a second and at the end
            with suppress(OSError):
                self._bar.update(self._task, completed=fraction, state=state)
                if fraction >= 1.0 or now - self._drawn >= REDRAW_SECONDS:
                    self._drawn = now
                    self._bar.refresh()
            return
        self._pending, since = f"{fraction:4.0%}  {state}", now - self._told
        if since >= seconds or (since >= LINE_SECONDS and fraction - self._part_told >= part - 1e-9):
            self._part_told = fraction
            self._line(self._pending)

    def _line(self, text: str) -> None:
        self.say(text)
        self._told, self._pending = self._clock(), ""

    def _left(self, done: float, whole: float = 1.0) -> float:
        """Estimated seconds left, at the mean speed since the first call; NaN at the first call."""
        began, before = self._first = self._first or (self._clock(), done)
        if done <= before:
            return 0.0 if done >= whole else math.nan
        return (self._clock() - began) * (whole - done) / (done - before)

    def close(self) -> None:
        """Leave the terminal as it was."""
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
        Simulated time at which it starts or goes on [s].
    unit : str
        Of the time; empty: it is a load factor.
    **options
        Of `ProgressBar`.
    """

    def __init__(
        self, comm: MPI.Comm, end: float, *, start: float = 0.0, unit: str = "s", **options: Any
    ) -> None:
        super().__init__(comm, **options)
        self._name = "t" if unit else "load"
        self._unit = f" {unit}" if unit else ""
        self._start, self._end = start, end
        self._steps, self._told = 0, -math.inf  # the first step is told at once

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
            Of this step.
        energy : float
            Kinetic and potential energy [J].
        """
        now = self._clock()
        span = self._end - self._start
        fraction = min(max((time - self._start) / span, 0.0), 1.0) if span > 0 else 1.0
        # the first step does what later ones need not, so the time left is estimated from the others
        left, self._steps = self._left(fraction), self._steps + 1
        began, done = self._first or (now, fraction)
        enough = now - began >= LEAST_SECONDS or fraction - done >= LEAST_PART
        state = (
            f"{self._name} {time:.4g} of {self._end:.4g}{self._unit}  step {step}  "
            f"Newton {newton_iterations}  linear {linear_iterations}  energy {energy:.4g} J"
        )
        if self._steps > FEWEST_STEPS and enough and math.isfinite(left):
            state += f"  {duration(left)} left"
        self._show(fraction, state, part=LINE_FRACTION)

    def close(self) -> None:
        """Show the last step and leave the terminal as it was."""
        super().close()
        if self._pending:
            self._line(self._pending)


class FrameProgress(ProgressBar):
    """The progress of drawing."""

    LINE_SECONDS = 10.0

    def update(self, done: int, count: int) -> None:
        """Show how many of the states are drawn."""
        text = f"{done} of {count} states drawn  {duration(self._left(done, count))} left"
        self._show(done / count, text, seconds=self.LINE_SECONDS)


class StudyProgress(ProgressBar):
    """The progress of a study.

    Parameters
    ----------
    comm : MPI.Comm
    stop : callable
        Called after every step on all ranks; may raise to end the study.
    combinations : int
        How many there are.
    **options
        Of `ProgressBar`.
    """

    def __init__(self, comm: MPI.Comm, stop: Callable[[], None], combinations: int, **options: Any) -> None:
        super().__init__(comm, **options)
        self._stop, self._combinations = stop, combinations
        self._label, self._number, self._told = "", 0, -math.inf

    def case(self, label: str, *, resumed: bool) -> None:
        """A case begins, or was found finished."""
        reference = label.startswith("reference")
        self._number += not reference
        self._label = label if reference else f"{self._number}/{self._combinations} {label}"
        if self._bar is None:
            self._line(f"{self._label}: finished before" if resumed else self._label)

    def progress(self, done: float, whole: float) -> None:
        """Work done and in all; may raise, see ``stop``."""
        self._stop()
        fraction = min(max(done / whole, 0.0), 1.0) if whole > 0.0 else 1.0
        # what was finished before took no time now
        self._show(fraction, f"{self._label}  {duration(self._left(done, whole))} left")

    def note(self, text: str) -> None:
        """A line for the user, above the bar."""
        self._line(f"note: {text}")


def closing_table(comm: MPI.Comm, phases: Mapping[str, float], folder: Path | str, outcome: str) -> None:
    """Show where the time went, where the results are and how to open them. Rank 0 only.

    Parameters
    ----------
    comm : MPI.Comm
        Only its rank 0 prints.
    phases : mapping of str to float
        Wall seconds by phase; they add up to the total.
    folder : path
        The run's folder.
    outcome : str
        How the run ended, in words.
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
    """``1:05:09``, ``5:09`` or ``?``."""
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
        auto_refresh=False,  # without a thread beside MPI: redrawn with the steps
    )
