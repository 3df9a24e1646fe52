"""What ``verify`` tells: every case with its tables, its verdicts and its plots."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from lyra_petsc.experiments.results import Line, View, aligned
from lyra_petsc.experiments.verification.answers import ErrorRow, VerificationOutcome
from lyra_petsc.show.report.closing import PLOTS
from lyra_petsc.show.report.document import Report
from lyra_petsc.show.report.numbers import seconds
from lyra_petsc.show.report.plots import Series, convergence, work_precision

HEADINGS = ("n", "h", "value", "exact", "error", "order", "steps", "run time [s]")


def cells(row: ErrorRow) -> list[str]:
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
    return [name + suffix if name in ("value", "exact") else name for name in HEADINGS]


class Verification(View[VerificationOutcome]):
    """Rows by case, quantity and resolution."""

    verb = "verify"
    title = "Verification: exact and published answers"
    pictures = "plots"
    columns = (
        "case", "quantity", "unit", "n", "h", "value", "exact", "error", "order", "steps", "wall_seconds",
        "passed", "problem",
    )  # fmt: skip

    def lines(self, outcome: VerificationOutcome) -> Iterable[Line]:
        case = outcome.case
        yield f"{case.name}: {case.title}", "bold"
        yield f"source: {case.source}; n: {case.counts}", ""
        for quantity, rows in outcome.tables().items():
            if not rows[0].problem:
                yield f"  {quantity}", ""
                table = [headings(rows[0].unit), *map(cells, rows)]
                yield from ((line, "") for line in aligned(table, words=0))
            verdict = outcome.verdicts[quantity]
            word, style = ("passed", "") if verdict.passed else ("FAILED", "bold red")
            yield f"  {word}: {verdict.words}", style
        yield "", ""

    def summary(self, outcomes: Sequence[VerificationOutcome]) -> list[Sequence[str]]:
        table = [(o.case.name, "passed" if o.passed else "FAILED", f"{o.seconds:.1f}") for o in outcomes]
        return [("case", "verdict", "run time [s]"), *table]

    def rows(self, outcome: VerificationOutcome) -> Iterable[Mapping[str, Any]]:
        for row in outcome.rows:
            passed = outcome.verdicts[row.quantity].passed
            yield asdict(row) | {"case": outcome.case.name, "passed": passed}

    def told(self, outcome: VerificationOutcome) -> dict[str, Any]:
        return {
            "source": outcome.case.source,
            "counts": outcome.case.counts,
            "passed": outcome.passed,
            "wall_seconds": outcome.seconds,
            "rows": [asdict(row) for row in outcome.rows],
        }

    def page(
        self, report: Report, outcomes: Sequence[VerificationOutcome], summary: str, *, drawn: bool
    ) -> None:
        report.paragraph(
            f"{summary} The error is |value − exact| over the size of the exact value, or over a natural "
            "scale where that is zero; the order is that between a row and the one before; the run time of "
            "a row is that of all its simulations, set-up included."
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
            case = outcome.case
            report.heading(case.name)
            report.paragraph(f"{case.title}. Source: {case.source}. n: {case.counts}.")
            for quantity, rows in outcome.tables().items():
                if not rows[0].problem:
                    report.table(headings(rows[0].unit), [cells(row) for row in rows], caption=quantity)
                verdict = outcome.verdicts[quantity]
                report.paragraph(f"{'Passed' if verdict.passed else 'FAILED'}: {verdict.words}.")
            if drawn:
                _figures(report, outcome)


def _figures(report: Report, outcome: VerificationOutcome) -> None:
    """Error against h and against run time, of the quantities that converge."""
    case = outcome.case
    tables = {
        quantity: rows
        for quantity, rows in outcome.tables().items()
        if case.claim_of(quantity).has_order and len(rows) > 1 and not any(row.problem for row in rows)
    }
    if not tables:
        return

    def against(x: str) -> list[Series]:
        return [
            Series(quantity, [getattr(row, x) for row in rows], [row.error for row in rows])
            for quantity, rows in tables.items()
        ]

    report.figure(
        convergence(
            against("h"), name=f"{PLOTS}/{case.name}-convergence", caption=f"{case.name}: error against h",
            x_label="h", y_label="relative error",
        )
    )  # fmt: skip
    report.figure(
        work_precision(
            against("wall_seconds"), name=f"{PLOTS}/{case.name}-run-time",
            caption=f"{case.name}: error against run time", y_label="relative error",
        )
    )  # fmt: skip
