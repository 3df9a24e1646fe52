"""Results of a study: errors, observed orders, Pareto front and recommendation, as CSV, JSON and a page."""

from __future__ import annotations

import itertools
import math
import os
import platform
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from lyra_petsc.experiments.case import Outcome
from lyra_petsc.experiments.results import View
from lyra_petsc.experiments.study.jobs import COUNTS, PHASES
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
from lyra_petsc.show.report.plots import Series, convergence, work_precision


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
    groups: dict[str, list[StudyRow]] = {}
    for row in rows:
        if row.passed:
            groups.setdefault(shared_label(row, axis), []).append(row)
    if axis is not None:
        for group in groups.values():
            group.sort(key=lambda row: -spacing(row, axis))
    return groups


def shared_label(row: StudyRow, axis: Axis | None) -> str:
    """Text of the settings of a row except for one axis, with the integrator first."""
    rest = ((a.key, v) for a, v in row.case.chosen if a is not axis and a.path != "time.integrator")
    return ", ".join(filter(None, [row.integrator, describe_settings(rest)]))


def mark_orders(rows: Sequence[StudyRow], axes: Sequence[Axis], quantities: Sequence[str]) -> None:
    """Store in each row the observed orders from the next coarser row along every numeric axis."""
    for axis, name in itertools.product((axis for axis in axes if axis.refines), quantities):
        for group in families(rows, axis).values():
            known = [
                (spacing(row, axis), row.resolved(name), row) for row in group if row.resolved(name) > 0.0
            ]
            for (h, error, _), (finer, smaller, row) in itertools.pairwise(known):
                if h > finer > 0.0:
                    row.orders[axis.key, name] = math.log(error / smaller) / math.log(h / finer)


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


def csv_row(plan: Plan, row: StudyRow) -> dict[str, Any]:
    """A row of ``study.csv`` by its columns; None or NaN where a value is missing."""
    result, settings = row.result, row.case.settings
    names = [quantity.name for quantity in plan.quantities]
    keys = {axis.path: axis.key for axis in plan.axes}
    varied = [axis.key for axis in plan.axes if axis.path not in ("time.integrator", "time.step", "mesh")]
    refined = [axis.key for axis in plan.axes if axis.refines]
    tolerances = {
        name: settings.get(keys.get(f"solver.{name}", ""), getattr(plan.base.solver, name))
        for name in ("force_tolerance", "step_tolerance")
    }
    step = "auto" if "time.tolerance" in keys else plan.base.time.step
    return {
        "combination": row.case.name,
        "status": "done" if row.passed else "failed",
        "reason": result.problem,
        "integrator": row.integrator,
        "dt": settings.get(keys.get("time.step", ""), step),
        "dt_mean": result.mean_step or None,
        "dt_min": result.shortest or None,
        "dt_max": result.longest or None,
        "mesh": settings.get(keys.get("mesh", "")),
        "h": result.spacing or None,
        "vertices": result.vertices or None,
        "triangles": result.triangles or None,
        **{key: settings[key] for key in varied},
        **tolerances,
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
        **{name: getattr(result, name) if row.passed else None for name in ("steps", *COUNTS)},
        "pareto": row.on_front,
        "recommended": row.recommended,
    }


BELOW = "below what the reference can tell"


def _write_advice(
    report: Report, plan: Plan, physics: Physics, reference: Reference, advice: Sequence[Advice]
) -> None:
    report.heading("Recommendation" + (f" for {describe_settings(physics)}" if physics else ""))
    if not advice:
        report.paragraph(f"None can be given: {reference.description or 'no errors are known'}.")
        return
    main, over = plan.quantities[0], "the largest at any sample time"
    if main.name == MEAN_SQUARE:
        over = "root mean square over the area and the sample times"
    report.paragraph(
        f"Errors are meant as: {main.title}, {over}. Run times are medians of the steps alone, "
        "without set-up and output. Nothing is extrapolated: only what ran is recommended. "
        + _excluded_error(plan, reference)
    )
    report.bullets([one.text for one in advice])


def _excluded_error(plan: Plan, reference: Reference) -> str:
    """Sentence on the error that all runs share with their reference and that is not measured therefore."""
    if reference.kind == "exact":
        return "The errors are whole: the reference is exact on any mesh."
    if plan.axis("mesh") is None:
        return "All runs and the reference share one mesh: its own error is not in these numbers."
    if reference.kind == "finer" and not plan.base.time.static and not refines_time(plan):
        return "All runs and the reference share the time integration: the numbers are errors of the mesh."
    return "The errors are those of the mesh and of all else that is solved."


def _describe_runs(plan: Plan, rows: Sequence[StudyRow], ranks: int) -> list[str]:
    done = [row for row in rows if row.passed]
    varied = "; ".join(
        f"{axis.key} = " + ", ".join(f"{v:g}" if isinstance(v, float) else v for v in axis.values)
        for axis in plan.axes
    )
    meshes = dict.fromkeys(
        f"{row.result.vertices} vertices, {row.result.triangles} triangles" for row in done
    )
    times = f"Compared at {len(plan.sample_times()) - 1} times, every {seconds(plan.interval)} to "
    return [
        f"Scene: {plan.request.scene}" + (f" ({plan.base.title})" if plan.base.title else ""),
        f"{len(rows)} combinations of {varied}; {len(rows) - len(done)} failed",
        f"Repeats of each: {plan.request.repeats}, one at a time, on {ranks} MPI rank(s) of {machine()}; "
        "after a warm-up step; median and range",
        "Mesh: " + "; ".join(meshes),
        "Compared at the full load" if plan.base.time.static else times + seconds(plan.end),
    ]


# -- tables --------------------------------------------------------------------------------------------


def _write_tables(report: Report, plan: Plan, rows: Sequence[StudyRow]) -> None:
    done = [row for row in rows if row.passed]
    columns: dict[str, Callable[[StudyRow], Any]] = {
        "setting": lambda row: setting(row) + (" ★" if row.recommended else ""),
        **{_short_title(q): partial(_error_cell, name=q.name) for q in plan.quantities},
        "run time": lambda row: seconds(row.run_time),
        "fastest – slowest": lambda row: " – ".join(
            seconds(end(row.result.run_seconds)) for end in (min, max)
        ),
        "with set-up": lambda row: seconds(row.total_time),
        "steps": lambda row: row.result.steps,
        "rejected": lambda row: row.result.rejected,
        "Newton": lambda row: row.result.newton_iterations,
        "linear": lambda row: row.result.linear_iterations,
    }
    starred = any(row.recommended for row in done)
    report.table(
        list(columns),
        [[cell(row) for cell in columns.values()] for row in done],
        caption="Bold: on the Pareto front."
        + (f" ★: recommended for {percent(DEFAULT_TARGET)}." if starred else ""),
        marked=[row.on_front for row in done],
    )
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


def _write_references(report: Report, references: Mapping[Physics, Reference]) -> None:
    report.heading("Reference")
    for physics, reference in references.items():
        where = f"{describe_settings(physics)}: " if physics else ""
        took = f"; its steps took {seconds(reference.seconds)}" if math.isfinite(reference.seconds) else ""
        report.paragraph(f"{where}{reference.description}{took}.")
        if reference.kind == "finer" and reference.own_errors:
            rows = [
                [name, own.error, f"{own.order:.2f}" if math.isfinite(own.order) else "", own.trusted]
                for name, own in reference.own_errors.items()
            ]
            report.table(
                ["quantity", "own error", "observed order", "converges"],
                rows,
                caption="The reference's own error, estimated from coarser runs (Richardson)",
            )


# -- diagrams ------------------------------------------------------------------------------------------


def main_axis(axes: Sequence[Axis]) -> Axis | None:
    """The axis along which the lines of a diagram run: steps, else tolerances, else meshes, else any."""
    order = ("time.step", "time.tolerance", "mesh")
    able = [axis for axis in axes if axis.refines]
    return min(able, key=lambda axis: order.index(axis.path) if axis.path in order else 3, default=None)


def drawings(plan: Plan, rows: Sequence[StudyRow], reference: Reference, mark: str) -> list[Drawing]:
    """Work-precision diagrams of every quantity, then convergence along every numeric axis."""
    axis = main_axis(plan.axes)
    figures = [
        _work_precision(plan, rows, reference, quantity, axis, mark)
        for quantity in plan.quantities
        if any(0.0 < row.resolved(quantity.name) < math.inf for row in rows)
    ]
    refined = [axis for axis in plan.axes if axis.refines]
    for axis, quantity in itertools.product(refined, plan.quantities):
        figures += _convergence(rows, reference, quantity, axis, mark)
    return figures


def _error_floor(reference: Reference, quantity: StudyQuantity) -> float | None:
    own = reference.own_errors.get(quantity.name)
    return None if own is None or not own.error > 0.0 else SAFETY * own.error


def _work_precision(
    plan: Plan,
    rows: Sequence[StudyRow],
    reference: Reference,
    quantity: StudyQuantity,
    axis: Axis | None,
    mark: str,
) -> Drawing:
    name, main = quantity.name, quantity == plan.quantities[0]
    lines = []
    for label, group in families(rows, axis).items():
        times = [row.result.run_seconds for row in group]
        points = [row.run_time for row in group], [row.resolved(name) for row in group]
        labels = [_point_label(row, axis) for row in group]
        lines.append(Series(label, *points, [*map(min, times)], [*map(max, times)], labels))
    hidden = {
        row.case.name: SAFETY * row.own_errors[name] for row in rows if row.passed and name in row.unresolved
    }
    star = next((row for row in rows if row.recommended and main), None)
    return work_precision(
        lines,
        name=("work-precision" if main else f"work-precision-{_file_name(name)}") + mark,
        caption=f"{quantity.title} against run time of the steps: median, bars from fastest to slowest of "
        f"{plan.request.repeats}",
        y_label=quantity.title,
        front=[(row.run_time, row.resolved(name)) for row in rows if row.on_front] if main else (),
        bounds=[(row.run_time, hidden[row.case.name]) for row in rows if row.case.name in hidden],
        recommended=(star.run_time, hidden.get(star.case.name, star.errors[name])) if star else None,
        recommendation=f"{setting(star)} (fastest within {percent(DEFAULT_TARGET)})" if star else "",
        floor=_error_floor(reference, quantity),
        floor_label=BELOW,
    )


def _point_label(row: StudyRow, axis: Axis | None) -> str:
    if axis is None:
        return ""
    return describe_setting(axis.key, row.case.settings[axis.key]).removeprefix(axis.key).strip()


def _convergence(
    rows: Sequence[StudyRow], reference: Reference, quantity: StudyQuantity, axis: Axis, mark: str
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
        floor=_error_floor(reference, quantity), floor_label=BELOW,
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
    advice : dict of physics → list of Advice
    """

    verb = "study"
    ready = False

    def __init__(self, runner: StudyRunner) -> None:
        self.runner, self.plan = runner, runner.plan
        self.title = f"Error against run time: {self.plan.base.title or self.plan.request.scene}"
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
        mark_orders(runner.rows, plan.axes, names)
        for physics in runner.references:
            mark_front(runner.rows_of(physics), names[0])
            self.advice[physics] = advise(runner.rows_of(physics), names)
            choose_recommended(self.advice[physics])
        self.columns, self.ready = list(csv_row(plan, runner.rows[0])), True

    def csv_rows(self, outcome: Outcome[Any]) -> Iterator[dict[str, Any]]:
        if isinstance(outcome, StudyRow):
            yield csv_row(self.plan, outcome)

    def csv_cell(self, value: Any) -> str:
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, float):
            return repr(value) if math.isfinite(value) else ""
        return "" if value is None else str(value)

    def content(self, outcomes: Sequence[Outcome[Any]], ranks: int, command: Sequence[str]) -> dict[str, Any]:
        """Content of the JSON file: the table with all repeats, references and advice."""
        plan = self.plan
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
                    "kind": reference.kind,
                    "reference": reference.description,
                    "run_seconds": reference.seconds,
                    "own_error": {name: asdict(own) for name, own in reference.own_errors.items()},
                    "notes": reference.notes,
                }
                for physics, reference in self.runner.references.items()
            ],
            "combinations": [
                csv_row(plan, row) | {"timings": [asdict(timing) for timing in row.result.timings]}
                for row in self.runner.rows
            ],
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
        plan, rows, references = self.plan, self.runner.rows, self.runner.references
        for physics, reference in references.items():
            _write_advice(report, plan, physics, reference, self.advice[physics])
        report.heading("What was run")
        report.bullets(_describe_runs(plan, rows, self.ranks))
        report.bullets(
            [*plan.notes, *(note for reference in references.values() for note in reference.notes)]
        )
        for number, (physics, reference) in enumerate(references.items(), start=1):
            report.heading("Diagrams" + (f" for {describe_settings(physics)}" if physics else ""))
            mark = "" if len(references) == 1 else f"-{number}"
            for drawing in drawings(plan, self.runner.rows_of(physics), reference, mark):
                report.figure(drawing)
        report.heading("Errors and run times")
        _write_tables(report, plan, rows)
        _write_references(report, references)
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
    versions = library_versions()
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


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
