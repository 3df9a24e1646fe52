"""What a run shows on the terminal: how far it is, and a closing table."""

from __future__ import annotations

import math
import sys
import time as wall
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TextIO

from mpi4py import MPI

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

REDRAW_SECONDS = 0.1
LINE_SECONDS = 2.0  # plain lines never come faster than this,
LINE_FRACTION = 0.05  # and then one for each 5 % of the run
LINE_AT_LEAST_SECONDS = 60.0  # or each minute, whichever is first


class Progress:
    """A progress bar where stderr is a terminal, plain lines where not. Shown by rank 0 only.

    Parameters
    ----------
    comm : MPI.Comm
        All ranks may make the same calls; none communicates.
    end : float
        Simulated time at which the run ends [s] (static: load factor 1).
    start : float
        Simulated time at which it starts or goes on [s].
    plain : bool
        Lines also on a terminal: PETSc's monitors would tear a bar apart.
    unit : str
        Of the time; empty: it is a load factor.
    stream : text stream
        Where to write; stderr, so that stdout stays free for results.
    clock : callable
        Returns seconds.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        end: float,
        *,
        start: float = 0.0,
        plain: bool = False,
        unit: str = "s",
        stream: TextIO | None = None,
        clock: Callable[[], float] = wall.monotonic,
    ) -> None:
        self._name = "t" if unit else "load"
        self._unit = f" {unit}" if unit else ""
        self._shown = comm.rank == 0
        self._start, self._end = start, end
        self._clock = clock
        self._stream = stream or sys.stderr
        self._began = clock()
        self._first: tuple[float, float] | None = None
        self._last_shown: float | None = None
        self._fraction_shown = 0.0
        self._latest: str | None = None
        self._bar: Bar | None = None
        if self._shown and not plain and self._stream.isatty():
            self._bar = _bar(self._stream)
            self._task = self._bar.add_task("", total=1.0, state="")
            self._bar.start()

    def update(
        self, step: int, time: float, newton_iterations: int, linear_iterations: int, energy: float
    ) -> None:
        """Tell of an accepted step; cheap enough to be called after each.

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
        if not self._shown:
            return
        now = self._clock()
        span = self._end - self._start
        fraction = min(max((time - self._start) / span, 0.0), 1.0) if span > 0 else 1.0
        began, done = self._first or (self._began, 0.0)
        left = (now - began) * (1 - fraction) / (fraction - done) if fraction > done else math.nan
        # the first step compiles and loads what the others find ready: it is no measure for them
        self._first = self._first or (now, fraction)
        state = (
            f"{self._name} {time:.4g} of {self._end:.4g}{self._unit}  step {step}  "
            f"Newton {newton_iterations}  linear {linear_iterations}  energy {energy:.4g} J"
        )
        since = math.inf if self._last_shown is None else now - self._last_shown
        if self._bar is not None:
            # in `state`, so that nothing of it is taken for markup
            with suppress(OSError):
                self._bar.update(self._task, completed=fraction, state=f"{state}  {duration(left)} left")
                if since >= REDRAW_SECONDS or fraction >= 1.0:
                    self._last_shown = now
                    self._bar.refresh()
            return
        self._latest = f"{fraction:4.0%}  {state}  {duration(left)} left"
        far = fraction - self._fraction_shown >= LINE_FRACTION - 1e-9
        if since >= LINE_SECONDS and (self._last_shown is None or far or since >= LINE_AT_LEAST_SECONDS):
            self._last_shown, self._fraction_shown = now, fraction
            self._line()

    def say(self, text: str) -> None:
        """A line for the user, above the bar."""
        if not self._shown:
            return
        with suppress(OSError):  # a run goes on when nobody reads what it says, or cannot
            if self._bar is not None:
                self._bar.console.print(text, markup=False, highlight=False)
            else:
                print(text, file=self._stream, flush=True)

    def close(self) -> None:
        """Show the last step and leave the terminal as it was."""
        if self._bar is not None:
            with suppress(OSError):
                self._bar.refresh()
                self._bar.stop()
            self._bar = None
        self._line()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _line(self) -> None:
        if self._latest is not None:
            with suppress(OSError):
                print(self._latest, file=self._stream, flush=True)
            self._latest = None


def closing_table(
    comm: MPI.Comm,
    phases: Mapping[str, float],
    folder: Path | str,
    outcome: str,
    *,
    stream: TextIO | None = None,
) -> None:
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
    stream : text stream
        stdout unless given.
    """
    if comm.rank == 0:
        with suppress(OSError):
            _print_closing(phases, folder, outcome, stream or sys.stdout)


def _print_closing(phases: Mapping[str, float], folder: Path | str, outcome: str, stream: TextIO) -> None:
    total = sum(phases.values())
    rows = [
        (name, f"{seconds:.2f} s", f"{seconds / total:.0%}" if total > 0 else "")
        for name, seconds in [*phases.items(), ("total", total)]
        if seconds >= 0.005 or name == "total"
    ]
    facts = [
        ("outcome", outcome),
        ("results", str(folder)),
        ("open", f"paraview {Path(folder) / 'states.xdmf'}"),
    ]
    if not stream.isatty():
        for name, seconds, share in rows:
            print(f"{name:<12} {seconds:>12} {share:>5}".rstrip(), file=stream)
        for name, text in facts:
            print(f"{name:<12} {text}", file=stream)
        stream.flush()
        return
    _print_table(rows, facts, stream)


def _print_table(rows: list[tuple[str, str, str]], facts: list[tuple[str, str]], stream: TextIO) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table("phase", box=None, pad_edge=False, header_style="")
    table.add_column("wall time", justify="right")
    table.add_column("share", justify="right")
    for row in rows:
        table.add_row(*row)
    console = Console(file=stream)
    console.print(table)
    for name, text in facts:  # unwrapped: a path is there to be copied
        console.print(Text(f"{name:<8} {text}"), soft_wrap=True)


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
        auto_refresh=False,  # no thread beside MPI: it is redrawn with the steps
    )
