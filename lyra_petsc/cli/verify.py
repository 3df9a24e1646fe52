"""``verify``: exact and published answers, a table and a verdict for each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click
from mpi4py import MPI

from lyra_petsc.cli.experiments import FAILED, Terminal, command, plain_table, watched
from lyra_petsc.experiments.results import Results
from lyra_petsc.experiments.verification.registry import CASES
from lyra_petsc.experiments.verification.runner import Outcome, run_case
from lyra_petsc.experiments.verification.view import Verification, cells, headings

WIDTH = 110


def verify(comm: MPI.Comm, names: Sequence[str], *, quick: bool, out: Path | None, force: bool) -> int:
    """Run cases (all of them without names) and print what came of each; the exit code; collective.

    Raises
    ------
    InputError
        An unknown case, or a folder that cannot be used; nothing has run then.
    Interrupted
        A signal; what had been done is in the folder.
    """
    cases = [CASES.load(name) for name in dict.fromkeys(names or CASES.modules)]
    again = command(comm, "verify", [*names, *(["--quick"] if quick else [])])
    results = Results(comm, out, Verification(), ranks=comm.size, command=again, force=force)
    watch = watched(comm)
    show = Show(comm, len(cases), WIDTH)
    show.announce(len(CASES.modules))
    note = results.run(cases, lambda case: run_case(comm, case, quick=quick, watch=watch), show)
    table = plain_table(["case", "verdict"], ["run time [s]"])
    for outcome in results.outcomes:
        table.add_row(outcome.case.name, "passed" if outcome.passed else "FAILED", f"{outcome.seconds:.1f}")
    show.summary(results.outcomes, table, out, note)
    return 0 if all(outcome.passed for outcome in results.outcomes) else FAILED


def list_cases(comm: MPI.Comm) -> None:
    """Print name and title of every case on rank 0."""
    cases = CASES.all()
    if comm.rank == 0:
        width = max(len(case.name) for case in cases)
        for case in cases:
            click.echo(f"{case.name:<{width}}  {case.title}")
        click.echo(f"{len(cases)} cases", err=True)


class Show(Terminal):
    """The tables of a case and its verdicts as soon as it has ended."""

    def end(self, outcome: Outcome) -> None:  # type: ignore[override]
        super().end(outcome)
        case = outcome.case
        self.print(f"{case.name}: {case.title}", "bold")
        self.print(f"source: {case.source}; n: {case.counts}")
        for quantity, rows in outcome.tables().items():
            verdict = outcome.verdicts[quantity]
            if not rows[0].problem:
                table = plain_table([], headings(rows[0].unit))
                for row in rows:
                    table.add_row(*cells(row))
                self.print(f"  {quantity}")
                self.print(table)
            word = "passed" if verdict.passed else "FAILED"
            self.print(f"  {word}: {verdict.words}", "" if verdict.passed else "bold red")
        self.print()
