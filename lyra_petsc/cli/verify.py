"""``verify``: exact and published answers, a table and a verdict for each."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import click
from mpi4py import MPI
from rich.console import Console
from rich.table import Table
from rich.text import Text

from lyra_petsc.cli.progress import duration
from lyra_petsc.cli.signals import StopRequest
from lyra_petsc.errors import Interrupted
from lyra_petsc.solvers.options import unused
from lyra_petsc.verification.registry import NAMES, load
from lyra_petsc.verification.report import cells, headings
from lyra_petsc.verification.results import finish, prepare, write
from lyra_petsc.verification.runner import Outcome, run_case

FAILED = 1
"""Exit code when a verdict failed."""

WIDTH = 110
"""Columns at least, so that numbers are never cut."""


def verify(comm: MPI.Comm, names: Sequence[str], *, quick: bool, out: Path | None, force: bool) -> int:
    """Run cases (all of them without names) and print what came of each; the exit code; collective.

    Raises
    ------
    InputError
        An unknown case, or a folder that cannot be used; nothing has run then.
    Interrupted
        A signal; what had been done is in the folder.
    """
    cases = [load(name) for name in dict.fromkeys(names or NAMES)]
    prepare(comm, out, force=force)
    stop = StopRequest(comm)

    def watch() -> None:
        number = stop.signal_number()
        if number:
            raise Interrupted(f"stopped by {signal.Signals(number).name}", number)

    console = Console(width=WIDTH if Console().width < WIDTH else None, highlight=False, soft_wrap=True)
    outcomes: list[Outcome] = []
    for number, case in enumerate(cases, 1):
        if comm.rank == 0 and sys.stderr.isatty():
            print(f"{number} of {len(cases)}: {case.name} …", file=sys.stderr, end="\r", flush=True)
        outcome = run_case(comm, case, quick=quick, watch=watch)
        outcomes.append(outcome)
        if comm.rank == 0:
            if sys.stderr.isatty():
                print("\x1b[2K", file=sys.stderr, end="\r", flush=True)
            _print_case(console, outcome)
        write(comm, out, outcomes)
    command = _command(comm, names, quick)
    note = finish(comm, out, outcomes, command)
    passed = sum(outcome.passed for outcome in outcomes)
    if comm.rank == 0:
        _print_summary(console, outcomes, out)
        if note:
            console.print(Text(f"note: {note}"))
        left = unused([])
        if left:
            listed = ", ".join(f"-{name}" for name in left)
            print(f"lyra-petsc: warning: PETSc options that nothing used: {listed}", file=sys.stderr)
    return 0 if passed == len(outcomes) else FAILED


def _command(comm: MPI.Comm, names: Sequence[str], quick: bool) -> list[str]:
    launcher = ["mpirun", "-n", str(comm.size)] if comm.size > 1 else []
    return [*launcher, "python", "-m", "lyra_petsc", "verify", *names, *(["--quick"] if quick else [])]


def list_cases(comm: MPI.Comm) -> None:
    """Print name and title of every case on rank 0."""
    cases = [load(name) for name in NAMES]
    if comm.rank == 0:
        width = max(len(name) for name in NAMES)
        for case in cases:
            click.echo(f"{case.name:<{width}}  {case.title}")


def _print_case(console: Console, outcome: Outcome) -> None:
    case = outcome.case
    console.print(Text(f"{case.name}: {case.title}", style="bold"))
    console.print(Text(f"source: {case.source}; n: {case.counts}"))
    for quantity in outcome.quantities():
        rows = outcome.rows_of(quantity)
        verdict = outcome.verdicts[quantity]
        if not rows[0].problem:
            table = Table(box=None, header_style="", pad_edge=False, padding=(0, 2, 0, 0))
            for heading in headings(rows[0].unit):
                table.add_column(Text(heading), justify="right")
            for row in rows:
                table.add_row(*cells(row))
            console.print(Text(f"  {quantity}"))
            console.print(table)
        word = "passed" if verdict.passed else "FAILED"
        console.print(Text(f"  {word}: {verdict.words}", style="" if verdict.passed else "bold red"))
    console.print()


def _print_summary(console: Console, outcomes: Sequence[Outcome], out: Path | None) -> None:
    table = Table("case", "verdict", box=None, header_style="", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(Text("run time [s]"), justify="right")
    for outcome in outcomes:
        table.add_row(outcome.case.name, "passed" if outcome.passed else "FAILED", f"{outcome.seconds:.1f}")
    console.print(table)
    passed = sum(outcome.passed for outcome in outcomes)
    total = sum(outcome.seconds for outcome in outcomes)
    console.print(f"{passed} of {len(outcomes)} cases passed, {duration(total)} in all")
    if out is not None:
        console.print(Text(f"results: {out}"))
