"""Cases of ``verify``: problems with known solutions, and how they are run, judged and reported."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase
from importlib.resources import files
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.experiments.bench import Bench, failure_message
from lyra_petsc.experiments.case import Case, Outcome, Verdict
from lyra_petsc.experiments.results import Line, View, align_columns, verdict_line
from lyra_petsc.extras import install_hint
from lyra_petsc.show.report.document import PLOTS, Report, seconds
from lyra_petsc.show.report.plots import Series, convergence


@dataclass
class ErrorRow:
    """One row in the table of a case.

    Attributes
    ----------
    quantity, unit : str
    n, h : float
        Resolution n, and the length or time h that decreases with it.
    value, exact : float
        Measured and exact value, in ``unit``.
    error : float
        Error relative to the scale of the quantity.
    order : float
        Order of convergence from the row before; NaN if there is none.
    problem : str
        Why there is no value; empty if there is one.
    """

    quantity: str
    unit: str
    n: float
    h: float
    value: float = math.nan
    exact: float = math.nan
    error: float = math.nan
    order: float = math.nan
    problem: str = ""


@dataclass(frozen=True)
class Claim:
    """A claim about the errors of one quantity.

    Attributes
    ----------
    exact : float or None
        Bound of the error at every resolution: round-off and the tolerance of the solver.
    order : float or None
        Order in h between the two finest resolutions, ± ``slack``.
    within : float
        Bound of the error at the finest resolution of the case. A quick run, which does not reach it, may
        have the larger error of the ``order``, or of the order ``growth`` where none is claimed.
    """

    exact: float | None = None
    order: float | None = None
    slack: float = 0.25
    within: float = math.inf
    growth: float = 2.0

    def judge(self, rows: Sequence[ErrorRow], finest: float) -> Verdict:
        """The verdict on one or more rows without problems, coarsest first; ``finest`` is the last h."""
        last = rows[-1]
        if self.exact is not None:
            error = max(math.inf if math.isnan(row.error) else row.error for row in rows)
            good = error <= self.exact
            return Verdict(
                good, f"largest error {error:.1e}, {'within' if good else 'above'} {self.exact:.0e}"
            )
        growth = self.growth if self.order is None else self.order
        bound = self.within * max(1.0, last.h / finest) ** growth
        good = last.error <= bound
        text = f"error {last.error:.1e} at n = {last.n:g}, {'within' if good else 'above'} {bound:.1e}"
        if len(rows) > 1 and self.order is not None:
            right = abs(last.order - self.order) <= self.slack
            expected = f"{'as' if right else 'not the'} expected {self.order:g} ± {self.slack:g}"
            text += f"; order {last.order:.2f}, {expected}"
            good &= right
        return Verdict(good, text)


def observed_order(before: ErrorRow, row: ErrorRow) -> float:
    """Order of convergence between two rows; NaN if an error is zero or missing."""
    if not (before.error > 0.0 and row.error > 0.0 and before.h != row.h):
        return math.nan
    return math.log(before.error / row.error) / math.log(before.h / row.h)


@dataclass(frozen=True)
class Measured:
    """One quantity at one resolution.

    Attributes
    ----------
    quantity : str
    value, exact : float
        Measured and exact value, in ``unit``.
    unit : str
        ``1`` for a pure number.
    scale : float or None
        Reference size for the error, in ``unit``; None: the size of ``exact``.
    """

    quantity: str
    value: float
    exact: float
    unit: str = "1"
    scale: float | None = None

    @property
    def error(self) -> float:
        """|value − exact| over the scale."""
        scale = abs(self.exact) if self.scale is None else self.scale
        return abs(self.value - self.exact) / scale


def vector_error(quantity: str, vector: Array, exact: Array, unit: str = "1") -> Measured:
    """The norm of the error of a vector, relative to the norm of the exact one."""
    size = float(np.linalg.norm(exact))
    return Measured(quantity, size + float(np.linalg.norm(vector - exact)), size, unit)


def worst(samples: Iterable[Sequence[Measured]]) -> list[Measured]:
    """For each quantity the measurement with the largest error; every sample has all of them."""
    return [max(values, key=lambda one: one.error) for values in zip(*samples, strict=True)]


Measure = Callable[[Bench, float], Iterable[Measured]]


@dataclass(frozen=True)
class VerificationCase(Case):
    """A problem with a known solution, an entry of ``cases.yaml``.

    Attributes
    ----------
    measure : callable (bench, n) → Measured, one by one
        Collective; the same result on every rank.
    source : str
        Source of the solution.
    resolutions : sequence of float
        Resolutions n, coarsest first; orders of convergence are with respect to h = 1/n.
    claims : mapping of pattern → Claim
        Claims about quantities; the first pattern that fits counts.
    quick : int
        Number of resolutions of ``--quick``, from the coarsest.
    counts : str
        What n counts.
    """

    measure: Measure
    source: str
    resolutions: Sequence[float]
    claims: Mapping[str, Claim]
    quick: int = 2
    counts: str = "cells along the side"

    def claim_of(self, quantity: str) -> Claim:
        """The claim about a quantity."""
        return next(claim for pattern, claim in self.claims.items() if fnmatchcase(quantity, pattern))


def load_data(name: str) -> dict[str, Any]:
    """Read a JSON file of ``verification/data``; ``name`` is without suffix."""
    path = files("lyra_petsc.experiments.verification").joinpath("data", f"{name}.json")
    return json.loads(path.read_text(encoding="utf-8"))


STATIC: dict[str, Any] = {"analysis": "static"}
FLOOR: dict[str, Any] = {"plane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}}
G = 9.81
"""Gravity [m/s²]"""

ASSEMBLED = {"end": 1.0, "step": 1.0}
"""Time block of a scene that is set up but not stepped."""


def scene(
    mesh: dict[str, Any], material: dict[str, Any], time: dict[str, Any] = STATIC, **more: Any
) -> dict[str, Any]:
    """The content of a scene file; ``more`` are further keys."""
    return {"mesh": mesh, "material": material, "time": dict(time), **more}


def grid(width: float, height: float, nx: int, ny: int, pattern: str = "diagonal") -> dict[str, Any]:
    """The mesh block of a rectangle [m] of nx × ny cells."""
    return {"grid": {"width": width, "height": height, "nx": nx, "ny": ny, "pattern": pattern}}


def isotropic(stiffness: float, poisson: float = 0.0) -> dict[str, float]:
    """The membrane block [N/m] of an isotropic material with c11 = ``stiffness``."""
    shear = 0.5 * (1.0 - poisson) * stiffness
    return {"c11": stiffness, "c22": stiffness, "c12": poisson * stiffness, "c33": shear}


def worst_value(values: Array, exact: float) -> float:
    """The value that differs most from the exact one."""
    return float(values[np.argmax(np.abs(values - exact))])


@dataclass
class VerificationOutcome(Outcome[VerificationCase]):
    """The result of a case; its verdicts are by quantity.

    Attributes
    ----------
    rows : list of ErrorRow
        Sorted by quantity, coarsest first.
    """

    rows: list[ErrorRow] = field(default_factory=list)

    def tables(self) -> dict[str, list[ErrorRow]]:
        """The rows of each quantity, in the order of measurement."""
        tables: dict[str, list[ErrorRow]] = {}
        for row in self.rows:
            tables.setdefault(row.quantity, []).append(row)
        return tables


def run_case(
    comm: MPI.Comm, case: VerificationCase, *, quick: bool = False, watch: Callable[[], None] | None = None
) -> VerificationOutcome:
    """Measure a case at its resolutions and judge it; collective, the same outcome on all ranks.

    Parameters
    ----------
    comm : MPI.Comm
    case : VerificationCase
    quick : bool
        Only the coarsest resolutions.
    watch : callable, optional
        Called before every step on all ranks; may raise to end the work.
    """
    began = time.perf_counter()
    outcome = VerificationOutcome(case)
    tables: dict[str, list[ErrorRow]] = {}
    problems: list[ErrorRow] = []
    for n in case.resolutions[: case.quick] if quick else case.resolutions:
        for row in _measure_rows(comm, watch, case, n):
            if row.problem:
                problems.append(row)
                continue
            table = tables.setdefault(row.quantity, [])
            if table and case.claim_of(row.quantity).exact is None:
                row.order = observed_order(table[-1], row)
            table.append(row)
    for quantity, table in tables.items():
        outcome.rows += table
        outcome.verdicts[quantity] = case.claim_of(quantity).judge(table, 1.0 / case.resolutions[-1])
    if problems:
        outcome.rows += problems
        outcome.verdicts[problems[0].quantity] = Verdict(
            False, "; ".join(f"n = {row.n:g} could not run: {row.problem}" for row in problems)
        )
    outcome.seconds = time.perf_counter() - began
    return outcome


def _measure_rows(
    comm: MPI.Comm, watch: Callable[[], None] | None, case: VerificationCase, n: float
) -> list[ErrorRow]:
    """The rows of one resolution; if it cannot run to its end, also a row with the reason."""
    rows: list[ErrorRow] = []
    problem, h = "", 1.0 / n
    with Bench(comm, watch) as bench:
        bench.watch()
        try:
            for one in case.measure(bench, n):
                rows.append(ErrorRow(one.quantity, one.unit, n, h, one.value, one.exact, one.error))
        except (InputError, SolverError) as error:
            problem = failure_message(comm, error)
        except ModuleNotFoundError as error:  # on all ranks
            problem = install_hint([str(error.name)])
    if problem:
        rows.append(ErrorRow("could not run", "", n, h, problem=problem))
    return rows


CELLS = {
    "n": "{:g}", "h": "{:.4g}", "value": "{:.9g}", "exact": "{:.9g}", "error": "{:.2e}", "order": "{:.2f}",
}  # fmt: skip
"""Columns of the table of a quantity, and the formats of their cells."""


def cells(rows: Sequence[ErrorRow]) -> list[list[str]]:
    """The table of a quantity, headings first."""
    unit = "" if rows[0].unit == "1" else f" [{rows[0].unit}]"
    table = [[name + unit if name in ("value", "exact") else name for name in CELLS]]
    for row in rows:
        values = [(getattr(row, name), text) for name, text in CELLS.items()]
        table.append(["" if math.isnan(value) else text.format(value) for value, text in values])
    return table


class VerificationView(View[VerificationOutcome]):
    """Rows by case, quantity and resolution."""

    verb = "verify"
    title = "Verification: exact and published answers"
    columns = (
        "case", "quantity", "unit", "n", "h", "value", "exact", "error", "order", "passed", "problem",
    )  # fmt: skip

    def terminal_lines(self, outcome: VerificationOutcome) -> Iterable[Line]:
        case = outcome.case
        yield f"{case.name}: {case.title}", "bold"
        yield f"source: {case.source}; n: {case.counts}", ""
        for quantity, rows in outcome.tables().items():
            if not rows[0].problem:
                yield f"  {quantity}", ""
                yield from ((line, "") for line in align_columns(cells(rows), text_columns=0))
            yield verdict_line(outcome.verdicts[quantity])
        yield "", ""

    def csv_rows(self, outcome: VerificationOutcome) -> Iterable[Mapping[str, Any]]:
        for row in outcome.rows:
            passed = outcome.verdicts[row.quantity].passed
            yield asdict(row) | {"case": outcome.case.name, "passed": passed}

    def case_content(self, outcome: VerificationOutcome) -> dict[str, Any]:
        return {
            "source": outcome.case.source,
            "counts": outcome.case.counts,
            "passed": outcome.passed,
            "wall_seconds": outcome.seconds,
            "rows": [asdict(row) for row in outcome.rows],
        }

    def fill(
        self, report: Report, outcomes: Sequence[VerificationOutcome], summary: str, *, plots: bool
    ) -> None:
        report.paragraph(
            f"{summary} The error is |value − exact| over the size of the exact value, or over a natural "
            "scale where that is zero; the order is that between a row and the one before."
        )
        heads = ["case", "what is compared", "verdict", "run time"]
        table = [[o.case.name, o.case.title, o.status, seconds(o.seconds)] for o in outcomes]
        report.table(heads, table, marked=[not o.passed for o in outcomes])
        for outcome in outcomes:
            case = outcome.case
            report.heading(case.name)
            report.paragraph(f"{case.title}. Source: {case.source}. n: {case.counts}.")
            for quantity, rows in outcome.tables().items():
                if not rows[0].problem:
                    heads, *table = cells(rows)
                    report.table(heads, table, caption=quantity)
                report.paragraph(f"{outcome.verdicts[quantity].line}.")
            lines = [
                Series(quantity, [row.h for row in rows], [row.error for row in rows])
                for quantity, rows in outcome.tables().items()
                if case.claim_of(quantity).exact is None
                and len(rows) > 1
                and not any(r.problem for r in rows)
            ]
            if plots and lines:
                caption, name = f"{case.name}: error against h", f"{PLOTS}/{case.name}-convergence"
                report.figure(
                    convergence(lines, name=name, caption=caption, x_label="h", y_label="relative error")
                )
