"""The folder that ``verify --out`` leaves: verify.csv and verify.json."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI

from lyra_petsc.errors import InputError
from lyra_petsc.output.atomic import replace_text
from lyra_petsc.output.summary import versions, write_summary
from lyra_petsc.parallel import on_root
from lyra_petsc.verification.report import write_report
from lyra_petsc.verification.runner import Outcome

COLUMNS = (
    "case",
    "quantity",
    "unit",
    "n",
    "h",
    "value",
    "exact",
    "error",
    "order",
    "steps",
    "wall_seconds",
    "passed",
    "problem",
)


def prepare(comm: MPI.Comm, folder: Path | None, *, force: bool) -> None:
    """Make the folder, if one is asked for; collective.

    Raises
    ------
    InputError
        If it exists and ``force`` is not given, or cannot be made.
    """

    def work() -> None:
        if folder is None:
            return
        if folder.exists() and not (force and folder.is_dir()):
            raise InputError("exists; choose another folder, or give --force", key=f"--out {folder}")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot be made ({error.strerror})", key=f"--out {folder}") from None

    on_root(comm, work)


def write(comm: MPI.Comm, folder: Path | None, outcomes: Sequence[Outcome]) -> None:
    """Write what came of the cases so far; collective.

    Raises
    ------
    OutputError
        On every rank, if it could not be written.
    """
    if folder is None:
        return
    on_root(comm, lambda: replace_text(folder / "verify.csv", _csv(outcomes)))
    write_summary(folder / "verify.json", _content(comm, outcomes), comm)


def finish(comm: MPI.Comm, folder: Path | None, outcomes: Sequence[Outcome], command: Sequence[str]) -> str:
    """Write the report; what is missing for its plots, in words; collective."""
    if folder is None:
        return ""
    return on_root(comm, lambda: write_report(folder, outcomes, versions(), comm.size, command)) or ""


def _csv(outcomes: Sequence[Outcome]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for outcome in outcomes:
        for row in outcome.rows:
            passed = outcome.verdicts[row.quantity].passed
            cells = dataclasses.asdict(row) | {"case": outcome.case.name, "passed": passed}
            writer.writerow({name: "" if value != value else value for name, value in cells.items()})
    return text.getvalue()


def _content(comm: MPI.Comm, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    return {
        "passed": all(outcome.passed for outcome in outcomes),
        "ranks": comm.size,
        "versions": versions(),
        "cases": [
            {
                "name": outcome.case.name,
                "title": outcome.case.title,
                "source": outcome.case.source,
                "counts": outcome.case.counts,
                "passed": outcome.passed,
                "wall_seconds": outcome.seconds,
                "verdicts": {
                    quantity: dataclasses.asdict(verdict) for quantity, verdict in outcome.verdicts.items()
                },
                "rows": [dataclasses.asdict(row) for row in outcome.rows],
            }
            for outcome in outcomes
        ],
    }
