"""The page about a ``verify``: every case with its tables, its verdicts and its plots."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from lyra_petsc.report.closing import PLOTS, close, lacking
from lyra_petsc.report.document import Report
from lyra_petsc.report.numbers import seconds
from lyra_petsc.report.plots import Series, convergence, work_precision
from lyra_petsc.verification.claims import Row
from lyra_petsc.verification.runner import Outcome

COLUMNS = ("n", "h", "value", "exact", "error", "order", "steps", "run time [s]")


def cells(row: Row) -> list[str]:
    """A row of a quantity's table, as it is shown."""
    return [
        f"{row.n:g}",
        f"{row.h:.4g}",
        f"{row.value:.9g}",
        f"{row.exact:.9g}",
        f"{row.error:.2e}",
        "" if math.isnan(row.order) else f"{row.order:.2f}",
        str(row.steps),
        f"{row.wall_seconds:.2f}",
    ]


def headings(unit: str) -> list[str]:
    """The heads of ``cells``, with the quantity's unit."""
    suffix = "" if unit == "1" else f" [{unit}]"
    return [name + suffix if name in ("value", "exact") else name for name in COLUMNS]


def write_report(
    folder: Path, outcomes: Sequence[Outcome], versions: Mapping[str, str], ranks: int, command: Sequence[str]
) -> str:
    """Write ``report.md``, and ``report.html`` with plots where the extra ``study`` is there. On one rank.

    Returns
    -------
    str
        What is missing and how to get it; empty if nothing is.
    """
    drawn = not lacking()
    report = Report("Verification: exact and published answers")
    passed = sum(outcome.passed for outcome in outcomes)
    report.paragraph(
        f"{passed} of {len(outcomes)} cases passed on {ranks} rank{'s' if ranks > 1 else ''}. The error is "
        "|value − exact| over the size of the exact value, or over a natural scale where that is zero; the "
        "order is that between a row and the one before; the run time of a row is that of all its "
        "simulations, set-up included."
    )
    report.table(
        ["case", "what is compared", "verdict", "run time"],
        [
            [o.case.name, o.case.title, "passed" if o.passed else "FAILED", seconds(o.seconds)]
            for o in outcomes
        ],
        marked=[not o.passed for o in outcomes],
    )
    for outcome in outcomes:
        _case(report, outcome, plots=drawn)
    return close(report, folder, versions, command, pictures="plots")


def _case(report: Report, outcome: Outcome, *, plots: bool) -> None:
    case = outcome.case
    report.heading(case.name)
    report.paragraph(f"{case.title}. Source: {case.source}. n: {case.counts}.")
    for quantity in outcome.quantities():
        rows, verdict = outcome.rows_of(quantity), outcome.verdicts[quantity]
        if not rows[0].problem:
            report.table(headings(rows[0].unit), [cells(row) for row in rows], caption=quantity)
        report.paragraph(f"{'Passed' if verdict.passed else 'FAILED'}: {verdict.words}.")
    if plots:
        _figures(report, outcome)


def _figures(report: Report, outcome: Outcome) -> None:
    """Error against h and against run time, of the quantities that converge."""
    case = outcome.case
    tables = {
        quantity: outcome.rows_of(quantity)
        for quantity in outcome.quantities()
        if case.claim_of(quantity).has_order and len(outcome.rows_of(quantity)) > 1
    }
    tables = {quantity: rows for quantity, rows in tables.items() if not any(row.problem for row in rows)}
    if not tables:
        return
    errors = {quantity: [row.error for row in rows] for quantity, rows in tables.items()}
    against_h = [Series(q, [row.h for row in rows], errors[q]) for q, rows in tables.items()]
    against_time = [Series(q, [row.wall_seconds for row in rows], errors[q]) for q, rows in tables.items()]
    report.figure(
        convergence(
            against_h,
            name=f"{PLOTS}/{case.name}-convergence",
            caption=f"{case.name}: error against h",
            x_label="h",
            y_label="relative error",
        )
    )
    report.figure(
        work_precision(
            against_time,
            name=f"{PLOTS}/{case.name}-run-time",
            caption=f"{case.name}: error against run time",
            y_label="relative error",
        )
    )
