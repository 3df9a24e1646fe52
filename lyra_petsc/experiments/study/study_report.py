"""Results of a study: errors, observed orders, Pareto front and recommendation, as CSV, JSON and a page."""

from __future__ import annotations

import itertools
import math
import os
import platform
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from lyra_petsc.experiments.case import Outcome
from lyra_petsc.experiments.results import View
from lyra_petsc.experiments.study.jobs import PHASES
from lyra_petsc.experiments.study.plan import (
    MEAN_SQUARE,
    Axis,
    Physics,
    Plan,
    StudyCase,
    StudyQuantity,
    describe_setting,
    describe_settings,
)
from lyra_petsc.experiments.study.study_runner import SAFETY, Reference, StudyRow, StudyRunner, refines_time
from lyra_petsc.extras import PACKAGES
from lyra_petsc.output.summary import library_versions
from lyra_petsc.show.report.document import Drawing, Report, percent, seconds, short
from lyra_petsc.show.report.plots import Series, convergence, fitted_slope, work_precision


def spacing(row: StudyRow, axis: Axis) -> float:
    """Actual mean edge length [m], mean Δt [s] or value of a row along a numeric axis."""
    if axis.path == "mesh":
        return row.result.spacing
    if axis.path == "time.step" and row.result.mean_step > 0.0:
        return row.result.mean_step
    value = row.case.settings[axis.key]
    return value if isinstance(value, float) else math.nan


def families(rows: Sequence[StudyRow], axis: Axis | None) -> dict[str, list[StudyRow]]:
    """Rows that ran, grouped so that rows of a group differ in one axis only; coarsest first, by label."""
    found: dict[str, list[StudyRow]] = {}
    for row in rows:
        if row.passed:
            found.setdefault(shared_label(row, axis), []).append(row)
    if axis is not None:
        for group in found.values():
            group.sort(key=lambda row: -spacing(row, axis))
    return found


def shared_label(row: StudyRow, axis: Axis | None) -> str:
    """Text of the settings of a row except for one axis, with the integrator first."""
    rest = ((a.key, v) for a, v in row.case.chosen if a is not axis and a.path != "time.integrator")
    return ", ".join(filter(None, [row.integrator, describe_settings(rest)]))


@dataclass(frozen=True)
class Order:
    """Observed order of convergence of one family of rows.

    Attributes
    ----------
    axis, quantity, family : str
    fitted : float
        Least-squares slope over all resolved rows.
    neighbours : tuple of float
        Between neighbours, coarsest first.
    """

    axis: str
    quantity: str
    family: str
    fitted: float
    neighbours: tuple[float, ...]


def observed_orders(rows: Sequence[StudyRow], axes: Sequence[Axis], quantities: Sequence[str]) -> list[Order]:
    """Observed orders along every numeric axis; orders between neighbours are also stored in the rows."""
    found = []
    for axis in (axis for axis in axes if axis.refines):
        for label, group in families(rows, axis).items():
            for name in quantities:
                known = [row for row in group if row.resolved(name) > 0.0]
                for coarse, fine in itertools.pairwise(known):
                    a, b = spacing(coarse, axis), spacing(fine, axis)
                    if a > b > 0.0:
                        order = math.log(coarse.resolved(name) / fine.resolved(name)) / math.log(a / b)
                        fine.orders[axis.key, name] = order
                if len(known) >= 2:
                    slope = fitted_slope([spacing(r, axis) for r in known], [r.resolved(name) for r in known])
                    between = tuple(r.orders.get((axis.key, name), math.nan) for r in known[1:])
                    found.append(Order(axis.key, name, label, slope, between))
    return found


def mark_front(rows: Sequence[StudyRow], quantity: str) -> None:
    """Mark the Pareto front: rows for which no other row has both less run time and less error."""
    able = _rows_with_error(rows, quantity)
    costs = [(row.run_time, row.error_bound(quantity)) for row in able]
    for row, mine in zip(able, costs, strict=True):
        row.on_front = not any(one[0] <= mine[0] and one[1] <= mine[1] and one != mine for one in costs)


def _rows_with_error(rows: Sequence[StudyRow], quantity: str) -> list[StudyRow]:
    """The rows whose error is known."""
    return [row for row in rows if row.passed and not math.isnan(row.error_bound(quantity))]


DEFAULT_TARGET = 0.01
"""The accuracy for which the diagram marks the recommended setting."""


@dataclass(frozen=True)
class Advice:
    """Recommended setting for an accuracy.

    Attributes
    ----------
    target : float
        Relative error.
    row : StudyRow or None
        The fastest row that reaches it; None if there is none.
    text : str
    """

    target: float
    row: StudyRow | None
    text: str


def advise(rows: Sequence[StudyRow], quantities: Sequence[str]) -> list[Advice]:
    """The fastest setting for each accuracy among those that ran; nothing is extrapolated.

    The first quantity decides; the text names others in which the recommended row is less accurate.
    """
    able = _rows_with_error(rows, quantities[0])
    return [_advice(able, quantities, target) for target in (0.1, 0.01, 0.001)] if able else []


def _advice(rows: Sequence[StudyRow], quantities: Sequence[str], target: float) -> Advice:
    quantity = quantities[0]
    good = [row for row in rows if row.error_bound(quantity) <= target]
    if not good:
        best = min(rows, key=lambda row: row.error_bound(quantity))
        text = f"{setting(best)}, {_error(best, quantity)}, in {seconds(best.run_time)}"
        nothing = "nothing that ran is accurate enough; the most accurate is"
        return Advice(target, None, f"For {percent(target)} {nothing} {text}.")
    winner = min(good, key=lambda row: row.run_time)
    text = f"For {percent(target)} choose {setting(winner)}: {seconds(winner.run_time)}"
    text += f" ({_error(winner, quantity)})."
    return Advice(target, winner, text + _disagreement(good, winner, quantities, target))


def _disagreement(
    good: Sequence[StudyRow], winner: StudyRow, quantities: Sequence[str], target: float
) -> str:
    """Sentence on the quantities in which the winner misses the accuracy; empty if there are none."""

    def missed(row: StudyRow) -> list[str]:
        return [name for name in quantities if name != "position_max" and row.error_bound(name) > target]

    if not (names := missed(winner)):
        return ""
    text = " Its error is " + " and ".join(
        f"{_error_text(winner, one)} in {_plain_name(one)}" for one in names
    )
    if able := [row for row in good if not missed(row)]:
        row = min(able, key=lambda row: row.run_time)
        return f"{text}; for {percent(target)} in all choose {setting(row)}: {seconds(row.run_time)}."
    return f"{text}; nothing that ran reaches {percent(target)} in all."


def _plain_name(quantity: str) -> str:
    """Name of a quantity within a sentence."""
    return {MEAN_SQUARE: "position"}.get(quantity, quantity.replace("_", " ", 1))


def setting(row: StudyRow) -> str:
    """Text of all settings of a row, with the integrator first."""
    return shared_label(row, None) or row.case.title


def _error(row: StudyRow, quantity: str) -> str:
    text = f"error {_error_text(row, quantity)}"
    largest = row.error_bound("position_max")
    if quantity == "position_l2" and math.isfinite(largest):
        text += f", at most {percent(largest)} anywhere"
    return text


def _error_text(row: StudyRow, quantity: str) -> str:
    if quantity in row.unresolved:
        return f"below {percent(row.error_bound(quantity))}"
    return percent(row.errors[quantity])


def choose_recommended(advice: Sequence[Advice]) -> StudyRow | None:
    """Mark the fastest row for 1 %, which the diagram shows by a star; None if no row reaches 1 %."""
    row = next((one.row for one in advice if one.target == DEFAULT_TARGET), None)
    if row is not None:
        row.recommended = True
    return row


COUNTS = ("steps", "rejected", "newton_iterations", "linear_iterations")


def csv_row(plan: Plan, row: StudyRow) -> dict[str, Any]:
    """A row of ``study.csv`` by its columns; None where a value is missing."""
    result, settings = row.result, row.case.settings
    names = [quantity.name for quantity in plan.quantities]
    keys = {axis.path: axis.key for axis in plan.axes}
    varied = [axis.key for axis in plan.axes if axis.path not in ("time.integrator", "time.step", "mesh")]
    refined = [axis.key for axis in plan.axes if axis.refines]

    def tolerance(name: str) -> Any:
        key = keys.get(f"solver.{name}")
        return settings[key] if key else getattr(plan.base.solver, name)

    step = "auto" if "time.tolerance" in keys else plan.base.time.step
    columns = {
        "combination": row.case.name,
        "status": "done" if row.passed else "failed",
        "reason": result.problem,
        "integrator": row.integrator,
        "dt": settings.get(keys.get("time.step", ""), step),
        "dt_mean": result.mean_step,
        "dt_min": result.shortest,
        "dt_max": result.longest,
        "mesh": settings.get(keys.get("mesh", "")),
        "h": result.spacing,
        "vertices": result.vertices,
        "triangles": result.triangles,
        **{key: settings[key] for key in varied},
        "force_tolerance": tolerance("force_tolerance"),
        "step_tolerance": tolerance("step_tolerance"),
        "linear_solver": result.linear_solver,
        **{f"error_{name}": row.resolved(name) for name in names},
        **{f"reference_error_{name}": row.own_errors.get(name) for name in names},
        "not_resolved": " ".join(sorted(row.unresolved)),
        **{f"order_{axis}_{name}": row.orders.get((axis, name)) for axis in refined for name in names},
        "repeats": len(result.timings),
        "ranks": result.ranks,
        "run_seconds": row.run_time,
        "run_seconds_min": min(result.run_seconds, default=None),
        "run_seconds_max": max(result.run_seconds, default=None),
        "total_seconds": row.total_time,
        **{f"seconds_{phase}": result.phase_seconds.get(phase) for phase in PHASES},
        **{name: getattr(result, name) for name in COUNTS},
        "pareto": row.on_front,
        "recommended": row.recommended,
    }
    missing = set() if row.passed else {"dt_mean", "dt_min", "dt_max", *COUNTS}
    missing |= set() if result.vertices else {"h", "vertices", "triangles"}
    missing |= {key for key, value in columns.items() if value in (math.inf, -math.inf) or value != value}
    return columns | dict.fromkeys(missing)


BELOW = "below what the reference can tell"


def _write_advice(
    report: Report, plan: Plan, physics: Physics, known: Reference, advice: Sequence[Advice]
) -> None:
    report.heading("Recommendation" + (f" for {describe_settings(physics)}" if physics else ""))
    if not advice:
        report.paragraph(f"None can be given: {known.description or 'no errors are known'}.")
        return
    main, over = plan.quantities[0], "the largest at any sample time"
    if main.name == MEAN_SQUARE:
        over = "root mean square over the area and the sample times"
    report.paragraph(
        f"Errors are meant as: {main.title}, {over}. Run times are medians of the steps alone, "
        "without set-up and output. Nothing is extrapolated: only what ran is recommended. "
        + _excluded_error(plan, known)
    )
    report.bullets([one.text for one in advice])


def _excluded_error(plan: Plan, known: Reference) -> str:
    """Sentence on the error that all runs share with their reference and that is not measured therefore."""
    if known.kind == "exact":
        return "The errors are whole: the reference is exact on any mesh."
    if plan.axis("mesh") is None:
        return "All runs and the reference share one mesh: its own error is not in these numbers."
    if known.kind == "finer" and not plan.base.time.static and not refines_time(plan):
        return (
            "All runs and the reference share the time integration: its error is not in these numbers, "
            "which are those of the mesh."
        )
    return "The errors are those of the mesh and of all else that is solved."


def _describe_runs(plan: Plan, rows: Sequence[StudyRow], ranks: int) -> list[str]:
    done = [row for row in rows if row.passed]
    values = {axis.key: [f"{v:g}" if isinstance(v, float) else v for v in axis.values] for axis in plan.axes}
    varied = "; ".join(f"{key} = {', '.join(texts)}" for key, texts in values.items())
    end = f"every {seconds(plan.interval)} to {seconds(plan.end)}"
    meshes = dict.fromkeys((row.result.vertices, row.result.triangles) for row in done)
    count = len(plan.sample_times()) - 1
    static = plan.base.time.static
    return [
        f"Scene: {plan.request.scene}" + (f" ({plan.base.title})" if plan.base.title else ""),
        f"{len(rows)} combinations of {varied}; {len(rows) - len(done)} failed",
        f"Repeats of each: {plan.request.repeats}, one at a time, on {ranks} MPI rank(s) of {machine()}; "
        "after a warm-up step; median and range",
        "Mesh: " + "; ".join(f"{v} vertices, {t} triangles" for v, t in meshes),
        "Compared at the full load" if static else f"Compared at {count} times, {end}",
    ]


# -- tables --------------------------------------------------------------------------------------------


def _write_tables(report: Report, plan: Plan, rows: Sequence[StudyRow]) -> None:
    names = [quantity.name for quantity in plan.quantities]
    head = ["setting", *(_short_title(quantity) for quantity in plan.quantities)]
    head += ["run time", "fastest – slowest", "with set-up", "steps", "rejected", "Newton", "linear"]
    done = [row for row in rows if row.passed]
    body = []
    for row in done:
        result, times = row.result, row.result.run_seconds
        body.append(
            [setting(row) + (" ★" if row.recommended else ""), *(_error_cell(row, name) for name in names),
             seconds(row.run_time), f"{seconds(min(times))} – {seconds(max(times))}", seconds(row.total_time),
             result.steps, result.rejected, result.newton_iterations, result.linear_iterations]
        )  # fmt: skip
    starred = any(row.recommended for row in done)
    star = f" ★: recommended for {percent(DEFAULT_TARGET)}." if starred else ""
    front = [row.on_front for row in done]
    report.table(head, body, caption="Bold: on the Pareto front." + star, marked=front)
    if any(row.unresolved for row in rows):
        report.paragraph(
            f"“< x” stands where an error is below {SAFETY:g} times the reference's own and not resolved."
        )
    report.table(
        ["setting", *PHASES],
        [[setting(row), *row.result.phase_seconds.values()] for row in done],
        caption="Wall time by phase [s], median; mesh, partition and assembly are set-up, output is the "
        "bookkeeping of energies, writing of files is not counted",
    )


def _short_title(quantity: StudyQuantity) -> str:
    text = {"position_max": "position, max", "position_l2": "position, L2"}
    return "error in " + text.get(quantity.name, quantity.name.replace("_", " ", 1))


def _error_cell(row: StudyRow, name: str) -> str:
    if name in row.unresolved:
        return f"< {short(SAFETY * row.own_errors[name])}"
    error = row.errors.get(name, math.nan)
    return short(error) if math.isfinite(error) else ""


def _write_orders(report: Report, orders: Sequence[Order]) -> None:
    if not orders:
        return
    report.heading("Observed orders")
    report.table(
        ["along", "quantity", "line", "fitted", "between neighbours"],
        [
            [one.axis, one.quantity, one.family, f"{one.fitted:.2f}",
             ", ".join(f"{value:.2f}" for value in one.neighbours)]
            for one in orders
        ],
    )  # fmt: skip


def _write_references(report: Report, known: Mapping[Physics, Reference]) -> None:
    report.heading("Reference")
    for physics, one in known.items():
        where = f"{describe_settings(physics)}: " if physics else ""
        took = f"; its steps took {seconds(one.seconds)}" if math.isfinite(one.seconds) else ""
        report.paragraph(f"{where}{one.description}{took}.")
        if one.kind == "finer" and one.own_errors:
            report.table(
                ["quantity", "own error", "observed order", "converges"],
                [
                    [
                        name,
                        short(own.error),
                        f"{own.order:.2f}" if math.isfinite(own.order) else "",
                        own.trusted,
                    ]
                    for name, own in one.own_errors.items()
                ],
                caption="The reference's own error, estimated from coarser runs (Richardson)",
            )


# -- diagrams ------------------------------------------------------------------------------------------


def main_axis(axes: Sequence[Axis]) -> Axis | None:
    """The axis along which the lines of a diagram run: steps, else tolerances, else meshes, else any."""
    order = ("time.step", "time.tolerance", "mesh")
    able = [axis for axis in axes if axis.refines]
    return min(able, key=lambda axis: order.index(axis.path) if axis.path in order else 3, default=None)


def drawings(plan: Plan, rows: Sequence[StudyRow], known: Reference, mark: str) -> list[Drawing]:
    """Work-precision diagrams of every quantity, then convergence along every numeric axis."""
    found = []
    axis = main_axis(plan.axes)
    for quantity in plan.quantities:
        if any(0.0 < row.resolved(quantity.name) < math.inf for row in rows):
            found.append(_work_precision(plan, rows, known, quantity, axis, mark))
    for one in (axis for axis in plan.axes if axis.refines):
        for quantity in plan.quantities:
            found += _convergence(rows, known, quantity, one, mark)
    return found


def _error_floor(known: Reference, quantity: StudyQuantity) -> float | None:
    own = known.own_errors.get(quantity.name)
    return None if own is None or not own.error > 0.0 else SAFETY * own.error


def _work_precision(
    plan: Plan,
    rows: Sequence[StudyRow],
    known: Reference,
    quantity: StudyQuantity,
    axis: Axis | None,
    mark: str,
) -> Drawing:
    name = quantity.name
    lines = []
    for label, group in families(rows, axis).items():
        times = [row.result.run_seconds for row in group]
        points = [row.run_time for row in group], [row.resolved(name) for row in group]
        labels = [_point_label(row, axis) for row in group]
        lines.append(Series(label, *points, [*map(min, times)], [*map(max, times)], labels))
    hidden = [row for row in rows if row.passed and name in row.unresolved]
    main, place, stars = quantity == plan.quantities[0], None, ""
    for star in (row for row in rows if row.recommended and main):
        stars = f"{setting(star)} (fastest within {percent(DEFAULT_TARGET)})"
        place = (
            star.run_time,
            SAFETY * star.own_errors[name] if name in star.unresolved else star.errors[name],
        )
    return work_precision(
        lines,
        name=("work-precision" if main else f"work-precision-{_file_name(name)}") + mark,
        caption=f"{quantity.title} against run time of the steps: median, bars from fastest to slowest of "
        f"{plan.request.repeats}",
        y_label=quantity.title,
        front=[(row.run_time, row.resolved(name)) for row in rows if row.on_front] if main else (),
        bounds=[(row.run_time, SAFETY * row.own_errors[name]) for row in hidden],
        recommended=place,
        recommendation=stars,
        floor=_error_floor(known, quantity),
        floor_label=BELOW,
    )


def _point_label(row: StudyRow, axis: Axis | None) -> str:
    if axis is None:
        return ""
    return describe_setting(axis.key, row.case.settings[axis.key]).removeprefix(axis.key).strip()


def _convergence(
    rows: Sequence[StudyRow], known: Reference, quantity: StudyQuantity, axis: Axis, mark: str
) -> list[Drawing]:
    lines = [
        Series(label, [spacing(row, axis) for row in group], [row.resolved(quantity.name) for row in group])
        for label, group in families(rows, axis).items()
    ]
    if not any(len(line.shown.x) > 1 for line in lines):
        return []
    label = {"time.step": "Δt [s] (mean)", "mesh": "h [m] (mean edge)"}.get(axis.path, axis.key)
    drawing = convergence(
        lines, name=f"convergence-{_file_name(axis.key)}-{_file_name(quantity.name)}{mark}",
        caption=f"{quantity.title} along {axis.key}", x_label=label, y_label=quantity.title,
        floor=_error_floor(known, quantity), floor_label=BELOW,
    )  # fmt: skip
    return [drawing]


def _file_name(name: str) -> str:
    return "".join(sign if sign.isalnum() or sign in "-." else "-" for sign in name).strip("-")


# -- the whole study -----------------------------------------------------------------------------------


class StudyView(View[Outcome[Any]]):
    """Errors against run times; written once all cases have been compared with their references.

    Parameters
    ----------
    runner : StudyRunner

    Attributes
    ----------
    runner : StudyRunner
    orders : list of Order
    advice : dict of physics → list of Advice
    """

    verb = "study"
    ready = False

    def __init__(self, runner: StudyRunner) -> None:
        self.runner, self.plan = runner, runner.plan
        self.title = f"Error against run time: {self.plan.base.title or self.plan.request.scene}"
        self.orders: list[Order] = []
        self.advice: dict[Physics, list[Advice]] = {}

    @property
    def ranks(self) -> int:
        """Number of ranks of each case."""
        return self.plan.request.ranks or self.runner.comm.size

    def cases(self) -> Iterator[StudyCase]:
        """All cases to run; afterwards computes orders, Pareto front and advice."""
        yield from self.runner.cases()
        plan, runner = self.plan, self.runner
        names = [quantity.name for quantity in plan.quantities]
        self.orders = observed_orders(runner.rows, plan.axes, names)
        for physics in runner.references:
            mark_front(runner.rows_of(physics), names[0])
            self.advice[physics] = advise(runner.rows_of(physics), names)
            choose_recommended(self.advice[physics])
        self.columns, self.ready = list(csv_row(plan, runner.rows[0])), True

    def csv_rows(self, outcome: Outcome[Any]) -> Iterator[dict[str, Any]]:
        if isinstance(outcome, StudyRow):
            yield csv_row(self.plan, outcome)

    def csv_cell(self, value: Any) -> str:
        if value is None:
            return ""
        if isinstance(value, bool):
            return "yes" if value else "no"
        return repr(float(value)) if isinstance(value, float) else str(value)

    def content(self, outcomes: Sequence[Outcome[Any]], ranks: int, command: Sequence[str]) -> dict[str, Any]:
        """Content of the JSON file: the table with all repeats, references, orders and advice."""
        plan, known = self.plan, self.runner.references
        return {
            "scene": plan.request.scene,
            "title": plan.base.title,
            "command": shlex.join(command),
            "ranks": ranks,
            "machine": machine(),
            "versions": all_versions(),
            "request": asdict(plan.request),
            "axes": {axis.key: list(axis.values) for axis in plan.axes},
            "quantities": {quantity.name: quantity.title for quantity in plan.quantities},
            "sample_times": plan.sample_times(),
            "notes": plan.notes,
            "references": [
                {
                    "scene": dict(physics),
                    "kind": one.kind,
                    "reference": one.description,
                    "run_seconds": one.seconds,
                    "own_error": {name: asdict(own) for name, own in one.own_errors.items()},
                    "notes": one.notes,
                }
                for physics, one in known.items()
            ],
            "combinations": [
                {
                    **{key: value for key, value in csv_row(plan, row).items() if value not in ("", None)},
                    "errors": {name: row.resolved(name) for name in row.errors},
                    "not_resolved": sorted(row.unresolved),
                    "timings": [asdict(timing) for timing in row.result.timings],
                    "notes": row.result.notes,
                }
                for row in self.runner.rows
            ],
            "orders": [asdict(order) for order in self.orders],
            "advice": [
                {
                    "scene": dict(physics),
                    "accuracy": one.target,
                    "combination": one.row.case.name if one.row is not None else None,
                    "words": one.text,
                }
                for physics, advice in self.advice.items()
                for one in advice
            ],
        }

    def fill(self, report: Report, outcomes: Sequence[Outcome[Any]], summary: str, *, plots: bool) -> None:
        plan, rows, known = self.plan, self.runner.rows, self.runner.references
        for physics, one in known.items():
            _write_advice(report, plan, physics, one, self.advice[physics])
        report.heading("What was run")
        report.bullets(_describe_runs(plan, rows, self.ranks))
        report.bullets([*plan.notes, *(note for one in known.values() for note in one.notes)])
        for number, (physics, one) in enumerate(known.items(), start=1):
            report.heading("Diagrams" + (f" for {describe_settings(physics)}" if physics else ""))
            mark = "" if len(known) == 1 else f"-{number}"
            for drawing in drawings(plan, self.runner.rows_of(physics), one, mark):
                report.figure(drawing)
        report.heading("Errors and run times")
        _write_tables(report, plan, rows)
        _write_orders(report, self.orders)
        _write_references(report, known)
        failed = [[row.case.title, row.result.problem] for row in rows if not row.passed]
        if failed:
            report.heading("What failed")
            report.table(["combination", "why"], failed)

    def close_page(self, report: Report, folder: Path, command: Sequence[str]) -> str:
        report.heading("To repeat it")
        report.code(shlex.join(command))
        report.table(["", "version"], list(all_versions().items()))
        report.write(folder)
        return ""


def all_versions() -> dict[str, str]:
    """Versions of the program and of the packages that it uses."""
    found = library_versions()
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def processor() -> str:
    """Model of this machine's processor."""
    with suppress(OSError):
        named = re.search(r"^model name[^:]*:(.*)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.M)
        if named:
            return named[1].strip()
    return platform.processor() or platform.machine()


def machine() -> str:
    """Processor and number of cores."""
    return f"{processor()}, {os.cpu_count() or 1} cores"
