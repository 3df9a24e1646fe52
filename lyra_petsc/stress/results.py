"""The folder that ``stress`` leaves: stress.csv, stress.json, report.md and report.html."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mpi4py import MPI

from lyra_petsc.output.atomic import replace_text
from lyra_petsc.output.summary import versions, write_summary
from lyra_petsc.parallel import on_root
from lyra_petsc.stress.case import Setting
from lyra_petsc.stress.report import write_report
from lyra_petsc.stress.runner import Outcome
from lyra_petsc.stress.table import COLUMNS, row_of


def write(comm: MPI.Comm, folder: Path, outcomes: Sequence[Outcome], ranks: int, *, complete: bool) -> None:
    """Write what came of the cases so far, each run on so many ranks; collective.

    Raises
    ------
    OutputError
        On every rank, if it could not be written.
    """
    on_root(comm, lambda: replace_text(folder / "stress.csv", _csv(outcomes)))
    write_summary(folder / "stress.json", _content(outcomes, ranks, complete), comm)


def finish(
    comm: MPI.Comm,
    folder: Path,
    outcomes: Sequence[Outcome],
    setting: Setting,
    ranks: int,
    command: Sequence[str],
) -> str:
    """Write the page; what is missing for its pictures, in words; collective."""
    work = lambda: write_report(folder, outcomes, setting, versions(), ranks, command)  # noqa: E731
    return on_root(comm, work) or ""


def _csv(outcomes: Sequence[Outcome]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for outcome in outcomes:
        if not outcome.left_out:
            cells = row_of(outcome)
            writer.writerow({name: "" if value != value else value for name, value in cells.items()})
    return text.getvalue()


def _content(outcomes: Sequence[Outcome], ranks: int, complete: bool) -> dict[str, Any]:
    run = [outcome for outcome in outcomes if not outcome.left_out]
    return {
        "complete": complete,
        "passed": all(outcome.passed for outcome in run),
        "ranks": ranks,
        "versions": versions(),
        "cases": [
            {
                "name": outcome.case.name,
                "title": outcome.case.title,
                **row_of(outcome),
                "verdicts": {name: asdict(verdict) for name, verdict in outcome.verdicts.items()},
                "notes": outcome.record.notes,
                "newton_iterations": outcome.record.newton,
                "times": outcome.record.times,
                "energies": [outcome.record.start_energy, *outcome.record.energies],
            }
            for outcome in run
        ],
        "left_out": {outcome.case.name: outcome.left_out for outcome in outcomes if outcome.left_out},
    }
