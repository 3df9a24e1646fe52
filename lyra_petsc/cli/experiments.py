"""What the verbs of experiments share: signals, the command that repeats them, the terminal."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI
from rich.console import Console
from rich.table import Table
from rich.text import Text

from lyra_petsc.cli.arguments import split
from lyra_petsc.cli.progress import duration
from lyra_petsc.cli.signals import StopRequest
from lyra_petsc.errors import Interrupted
from lyra_petsc.experiments.case import Case, Outcome, passed_of
from lyra_petsc.linear.petsc_options import unused

FAILED = 1
"""Exit code when a verdict failed."""


def watched(comm: MPI.Comm, kept: Callable[[], str] = str) -> Callable[[], None]:
    """What is to be called before every step; raises `Interrupted` on all ranks when a signal has come.

    ``kept`` gives the words after the signal's name: what has been done, and how to go on.
    """
    stop = StopRequest(comm)

    def watch() -> None:
        number = stop.signal_number()
        if number:
            raise Interrupted(f"stopped by {signal.Signals(number).name}{kept()}", number)

    return watch


def petsc_words() -> list[str]:
    """PETSc's options of the command line."""
    return split(sys.argv[1:])[1]


def command(comm: MPI.Comm, verb: str, words: Sequence[str]) -> list[str]:
    """The command line that repeats a verb."""
    launcher = ["mpirun", "-n", str(comm.size)] if comm.size > 1 else []
    return [*launcher, "python", "-m", "lyra_petsc", verb, *words, *petsc_words()]


def tell_unused() -> None:
    """Warn of PETSc options that nothing has used. On one rank."""
    left = unused([])
    if left:
        listed = ", ".join(f"-{name}" for name in left)
        print(f"lyra-petsc: warning: PETSc options that nothing used: {listed}", file=sys.stderr)


def plain_table(words: Sequence[str], numbers: Sequence[str]) -> Table:
    """A table without lines: columns of words, then columns of numbers, by their headings."""
    table = Table(*words, box=None, header_style="", pad_edge=False, padding=(0, 2, 0, 0))
    for heading in numbers:
        table.add_column(Text(heading), justify="right")
    return table


class Terminal:
    """Shows the progress of cases on the terminal; on rank 0 only.

    Parameters
    ----------
    comm : MPI.Comm
    count : int
        Cases to come.
    width : int
        Columns at least, so that numbers are never cut.
    """

    def __init__(self, comm: MPI.Comm, count: int, width: int) -> None:
        self._speaks, self._count, self._done = comm.rank == 0, count, 0
        self._console = Console(width=max(width, Console().width), highlight=False, soft_wrap=True)

    def print(self, text: str | Table = "", style: str = "") -> None:
        """A line or a table."""
        if self._speaks:
            self._console.print(Text(text, style=style) if isinstance(text, str) else text)

    def announce(self, known: int) -> None:
        """Say how many cases will run, of how many that there are."""
        of = f" of {known}" if known != self._count else ""
        self.print(f"{self._count}{of} cases")

    def begin(self, case: Case) -> None:
        """A case begins: a line on a terminal, until the case has ended."""
        self._done += 1
        if self._speaks and sys.stderr.isatty():
            print(f"{self._done} of {self._count}: {case.name} …", file=sys.stderr, end="\r", flush=True)

    def end(self, outcome: Outcome[Any]) -> None:
        """A case has ended."""
        if self._speaks and sys.stderr.isatty():
            print("\x1b[2K", file=sys.stderr, end="\r", flush=True)

    def summary(self, outcomes: Sequence[Outcome[Any]], table: Table, folder: Path | None, note: str) -> None:
        """The end: a table, what passed, where results are, what is missing, options that nothing used."""
        if not self._speaks:
            return
        self.print(table)
        total = sum(outcome.seconds for outcome in outcomes)
        self.print(f"{passed_of(outcomes)}, {duration(total)} in all")
        if folder is not None:
            self.print(f"results: {folder}")
        if note:
            self.print(f"note: {note}")
        tell_unused()
