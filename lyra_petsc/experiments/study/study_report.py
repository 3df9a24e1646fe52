"""What a study tells: errors, observed orders, Pareto front and recommendation, as CSV, JSON and pages."""

from __future__ import annotations

import itertools
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from mpi4py import MPI

from lyra_petsc.experiments.results import csv_text
from lyra_petsc.experiments.study.plan import Axis, Plan, Quantity, described
from lyra_petsc.experiments.study.work import (
    SAFETY,
    Physics,
    Reference,
    StudyRow,
    Work,
    physics_of,
    refines_time,
)
from lyra_petsc.extras import PACKAGES
from lyra_petsc.output.atomic import replace_text
from lyra_petsc.output.summary import versions, write_summary
from lyra_petsc.parallel import on_root
from lyra_petsc.show.report.document import Drawing, Report, percent, seconds, short
from lyra_petsc.show.report.plots import Series, convergence, fitted_slope, work_precision


def extent(row: StudyRow, axis: Axis) -> float:
    """The length, time or tolerance that shrinks along a numeric axis: as it really was."""
    if axis.path == "mesh":
        return row.result.spacing
    if axis.path == "time.step" and row.result.mean_step > 0.0:
        return row.result.mean_step
    value = row.combination.settings[axis.key]
    return float(value) if isinstance(value, float) else math.nan


def families(rows: Sequence[StudyRow], axis: Axis | None) -> dict[str, list[StudyRow]]:
    """Rows that ran and differ in one axis alone, coarsest first; by what they share, in words."""
    found: dict[str, list[StudyRow]] = {}
    for row in rows:
        if row.result.done:
            found.setdefault(shared_label(row, axis), []).append(row)
    if axis is not None:
        for group in found.values():
            group.sort(key=lambda row: -extent(row, axis))
    return found


def shared_label(row: StudyRow, axis: Axis | None) -> str:
    """The settings of a row but for one axis, in words, with the integrator first."""
    words = [row.line] if row.line else []
    for other, value in zip(row.combination.axes, row.combination.values, strict=True):
        if other is not axis and other.path != "time.integrator":
            words.append(described(other.key, value))
    return ", ".join(words)


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
    """Orders along every numeric axis; also noted in the rows."""
    found = []
    for axis in (axis for axis in axes if axis.refines):
        for label, group in families(rows, axis).items():
            for name in quantities:
                told = [row for row in group if row.shown(name) > 0.0]
                for coarse, fine in itertools.pairwise(told):
                    a, b = extent(coarse, axis), extent(fine, axis)
                    if a > b > 0.0:
                        order = math.log(coarse.shown(name) / fine.shown(name)) / math.log(a / b)
                        fine.orders[axis.key, name] = order
                if len(told) >= 2:
                    slope = fitted_slope([extent(r, axis) for r in told], [r.shown(name) for r in told])
                    between = tuple(r.orders.get((axis.key, name), math.nan) for r in told[1:])
                    found.append(Order(axis.key, name, label, slope, between))
    return found


def mark_front(rows: Sequence[StudyRow], quantity: str) -> None:
    """Mark the rows that no other beats in both run time and error."""
    able = [row for row in rows if row.result.done and not math.isnan(row.at_most(quantity))]
    for row in able:
        error = row.at_most(quantity)
        row.on_front = not any(
            other is not row
            and other.run <= row.run
            and other.at_most(quantity) <= error
            and (other.run < row.run or other.at_most(quantity) < error)
            for other in able
        )


TARGETS = (0.1, 0.01, 0.001)
DEFAULT_TARGET = 0.01
"""The accuracy that the diagram's recommended setting is for."""

FINEST_TARGET = 1e-6


@dataclass(frozen=True)
class Advice:
    """What to choose for an accuracy.

    Attributes
    ----------
    target : float
    row : StudyRow or None
        The fastest that keeps it; None if none does.
    words : str
    """

    target: float
    row: StudyRow | None
    words: str


def advise(rows: Sequence[StudyRow], quantity: str, axis: Axis | None = None) -> list[Advice]:
    """The fastest setting for each accuracy, among what ran; nothing is extrapolated.

    Parameters
    ----------
    rows : sequence of StudyRow
    quantity : str
    axis : Axis, optional
        Along it a winner may be the coarsest that ran, which the words then say.
    """
    able = [row for row in rows if row.result.done and not math.isnan(row.at_most(quantity))]
    if not able:
        return []
    best = min(row.at_most(quantity) for row in able)
    targets = list(TARGETS)
    while targets[-1] > FINEST_TARGET and best <= targets[-1] / 10.0:
        targets.append(targets[-1] / 10.0)
    coarsest: list[StudyRow] = []
    if axis is not None:
        coarsest = [group[0] for group in families(able, axis).values()]
    return [_advice(able, quantity, float(f"{target:.3g}"), coarsest) for target in targets]


def _advice(rows: Sequence[StudyRow], quantity: str, target: float, coarsest: Sequence[StudyRow]) -> Advice:
    good = [row for row in rows if row.at_most(quantity) <= target]
    if not good:
        best = min(rows, key=lambda row: row.at_most(quantity))
        return Advice(
            target,
            None,
            f"For {percent(target)} nothing that ran is accurate enough; the most accurate is "
            f"{setting(best)}, {_error(best, quantity)}, in {seconds(best.run)}.",
        )
    winner = min(good, key=lambda row: row.run)
    tried = ", the coarsest that ran" if any(row is winner for row in coarsest) else ""
    words = f"For {percent(target)} choose {setting(winner)}: {seconds(winner.run)}"
    words += f" ({_error(winner, quantity)}{tried})"
    high = max(winner.result.run_seconds())
    ties = [
        row
        for row in good
        if row is not winner and row.line == winner.line and min(row.result.run_seconds()) <= high
    ]
    if ties:
        words += (
            f", or as fast within the spread, {setting(min(ties, key=lambda row: row.at_most(quantity)))}"
        )
    for line in dict.fromkeys(row.line for row in rows):
        if line != winner.line:
            words += "; " + _beside(line, [row for row in rows if row.line == line], quantity, target)
    return Advice(target, winner, words + ".")


def _beside(line: str, rows: Sequence[StudyRow], quantity: str, target: float) -> str:
    good = [row for row in rows if row.at_most(quantity) <= target]
    if good:
        row = min(good, key=lambda row: row.run)
        return f"{line} needs {seconds(row.run)} ({_without_line(row)})"
    best = min(rows, key=lambda row: row.at_most(quantity))
    return f"{line} did not reach it ({_without_line(best)}: {_error(best, quantity)}, {seconds(best.run)})"


def setting(row: StudyRow) -> str:
    """All settings of a row, in words, with the integrator first."""
    return shared_label(row, None) or row.combination.label


def _without_line(row: StudyRow) -> str:
    return setting(row).removeprefix(row.line).removeprefix(", ") or row.line


def _error(row: StudyRow, quantity: str) -> str:
    if quantity in row.unresolved:
        words = f"error below {percent(row.at_most(quantity))}"
    else:
        words = f"error {percent(row.errors[quantity])}"
    largest = row.at_most("position_max")
    if quantity == "position_l2" and math.isfinite(largest):
        words += f", at most {percent(largest)} anywhere"
    return words


def choose_recommended(advice: Sequence[Advice]) -> StudyRow | None:
    """Mark the setting that the diagram's star names: the fastest for 1 %; none if no setting keeps that."""
    for one in advice:
        if one.row is not None and math.isclose(one.target, DEFAULT_TARGET):
            one.row.recommended = True
            return one.row
    return None


PHASES = ("mesh", "partition", "assembly", "solve", "balance", "output", "other")
"""Phases of a run; ``balance`` is the bookkeeping of energies, the writing of files is not timed."""


@dataclass
class StudyOutcome:
    """What came of a study.

    Attributes
    ----------
    plan : Plan
    rows : list of StudyRow
    known : dict of physics → Reference
        References as they came out.
    orders : list of Order
    advice : dict of physics → list of Advice
    facts : dict
        What the files say of scene, command, ranks, machine and versions.
    """

    plan: Plan
    rows: list[StudyRow]
    known: dict[Physics, Reference]
    orders: list[Order]
    advice: dict[Physics, list[Advice]]
    facts: dict[str, Any]

    @property
    def failed(self) -> list[StudyRow]:
        """Rows without a result."""
        return [row for row in self.rows if not row.result.done]

    def of(self, physics: Physics) -> list[StudyRow]:
        """The rows of one physical scene."""
        return [row for row in self.rows if physics_of(row.combination) == physics]


def order_axes(plan: Plan) -> list[str]:
    """Keys of the axes along which orders are reported."""
    return [axis.key for axis in plan.axes if axis.refines]


def record(plan: Plan, row: StudyRow) -> dict[str, Any]:
    """A row of ``study.csv`` by its columns; None where there is nothing to tell."""
    result, settings = row.result, row.combination.settings
    names = [quantity.name for quantity in plan.quantities]
    keys = {axis.path: axis.key for axis in plan.axes}
    varied = [axis.key for axis in plan.axes if axis.path not in ("time.integrator", "time.step", "mesh")]

    def spread(name: str, median: float, times: list[float]) -> dict[str, Any]:
        fastest, slowest = min(times, default=None), max(times, default=None)
        return _if(
            result.done,
            {f"{name}_seconds": median, f"{name}_seconds_min": fastest, f"{name}_seconds_max": slowest},
        )

    def tolerance(name: str) -> Any:
        key = keys.get(f"solver.{name}")
        return settings[key] if key else getattr(plan.base.solver, name)

    phases = result.phase_seconds()
    steps = {
        "steps": result.steps,
        "rejected": result.rejected,
        "newton_iterations": result.newton_iterations,
        "linear_iterations": result.linear_iterations,
    }
    lengths = {"dt_mean": result.mean_step, "dt_min": result.shortest, "dt_max": result.longest}
    mesh = {"h": result.spacing, "vertices": result.vertices, "triangles": result.triangles}
    axes = order_axes(plan)
    return {
        "combination": row.combination.name,
        "status": "done" if result.done else "failed",
        "reason": result.problem,
        "integrator": row.line,
        "dt": _nominal_step(plan, row),
        **_if(result.done, lengths),
        "mesh": settings.get(keys.get("mesh", "")),
        **_if(result.vertices > 0, mesh),
        **{key: settings[key] for key in varied},
        "force_tolerance": tolerance("force_tolerance"),
        "step_tolerance": tolerance("step_tolerance"),
        "linear_solver": result.linear_solver,
        **{f"error_{name}": _told(row.shown(name)) for name in names},
        **{f"reference_error_{name}": _told(row.own.get(name, math.nan)) for name in names},
        "not_resolved": " ".join(sorted(row.unresolved)),
        **{f"order_{axis}_{name}": row.orders.get((axis, name)) for axis in axes for name in names},
        "repeats": len(result.timings),
        "ranks": result.ranks,
        **spread("run", row.run, result.run_seconds()),
        **spread("total", row.total, result.total_seconds()),
        **_if(result.done, {f"seconds_{phase}": phases.get(phase, 0.0) for phase in PHASES}),
        **_if(result.done, steps),
        "pareto": row.on_front,
        "recommended": row.recommended,
    }


def _if(there: bool, values: dict[str, Any]) -> dict[str, Any]:
    """The values, or None for each."""
    return values if there else dict.fromkeys(values)


def _nominal_step(plan: Plan, row: StudyRow) -> float | str | None:
    for axis, value in zip(row.combination.axes, row.combination.values, strict=True):
        if axis.path == "time.step":
            return value
        if axis.path == "time.tolerance":
            return "auto"
    return plan.base.time.step


def _told(value: float) -> float | None:
    return value if math.isfinite(value) else None


def write_csv(folder: Path, study: StudyOutcome) -> None:
    """Write ``study.csv``. Call on one rank."""
    rows_told = [record(study.plan, row) for row in study.rows]
    replace_text(folder / "study.csv", csv_text(list(rows_told[0]), rows_told, _cell))


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return repr(float(value)) if isinstance(value, float) else str(value)


def content(study: StudyOutcome) -> dict[str, Any]:
    """What ``study.json`` holds: all of the table, the repeats, the references, orders and advice."""
    plan = study.plan
    return {
        **study.facts,
        "request": asdict(plan.request),
        "axes": {axis.key: list(axis.values) for axis in plan.axes},
        "quantities": {quantity.name: quantity.title for quantity in plan.quantities},
        "sample_times": plan.sample_times(),
        "notes": plan.notes,
        "references": [
            {
                "scene": dict(physics),
                "kind": one.kind,
                "reference": one.words,
                "run_seconds": one.seconds,
                "own_error": {
                    name: {"error": own.error, "observed_order": own.order, "trusted": own.trusted}
                    for name, own in one.own.items()
                },
                "notes": one.notes,
            }
            for physics, one in study.known.items()
        ],
        "combinations": [
            {
                **{key: value for key, value in record(plan, row).items() if value not in ("", None)},
                "errors": {name: row.shown(name) for name in row.errors},
                "not_resolved": sorted(row.unresolved),
                "timings": [asdict(timing) for timing in row.result.timings],
                "notes": row.result.notes,
            }
            for row in study.rows
        ],
        "orders": [asdict(order) for order in study.orders],
        "advice": [
            {
                "scene": dict(physics),
                "accuracy": one.target,
                "combination": one.row.combination.name if one.row is not None else None,
                "words": one.words,
            }
            for physics, advice in study.advice.items()
            for one in advice
        ],
    }


BELOW = "below what the reference can tell"


def make_report(study: StudyOutcome) -> Report:
    """The whole report."""
    plan, known, facts = study.plan, study.known, study.facts
    report = Report(f"Error against run time: {plan.base.title or facts['scene']}")
    for physics, one in known.items():
        _advise(report, plan, physics, one, study.advice[physics])
    report.heading("What was run")
    report.bullets(_what(study))
    report.bullets([*plan.notes, *(note for one in known.values() for note in one.notes)])
    for number, (physics, one) in enumerate(known.items(), start=1):
        report.heading("Diagrams" + (f" for {_scene_words(physics)}" if physics else ""))
        for drawing in drawings(plan, study.of(physics), one, "" if len(known) == 1 else f"-{number}"):
            report.figure(drawing)
    report.heading("Errors and run times")
    _tables(report, plan, study.rows)
    _orders(report, study.orders)
    _references(report, known)
    if study.failed:
        report.heading("What failed")
        why = [[row.combination.label, row.result.problem] for row in study.failed]
        report.table(["combination", "why"], why)
    report.heading("To repeat it")
    report.code(str(facts["command"]))
    report.table(["", "version"], [[name, text] for name, text in facts["versions"].items()])
    return report


def _scene_words(physics: Physics) -> str:
    return ", ".join(described(key, value) for key, value in physics)


def _advise(report: Report, plan: Plan, physics: Physics, known: Reference, advice: Sequence[Advice]) -> None:
    report.heading("Recommendation" + (f" for {_scene_words(physics)}" if physics else ""))
    if not advice:
        report.paragraph(f"None can be given: {known.words or 'no errors are known'}.")
        return
    main = plan.quantities[0]
    over = "the largest at any sample time"
    if main.name == "position_l2":
        over = "root mean square over the area and the sample times"
    report.paragraph(
        f"Errors are meant as: {main.title}, {over}. Run times are medians of the steps alone, "
        "without set-up and output. Nothing is extrapolated: only what ran is recommended. "
        + _left_out(plan, known)
    )
    report.bullets([one.words for one in advice])


def _left_out(plan: Plan, known: Reference) -> str:
    """Which error is common to all runs and their reference, and hence not in the numbers."""
    if known.kind == "exact":
        return "The errors are whole: the reference is exact on any mesh."
    if plan.axis("mesh") is None:
        return "All runs and the reference share one mesh: its own error is not in these numbers."
    if known.kind == "finer" and not plan.static and not refines_time(plan):
        return (
            "All runs and the reference share the time integration: its error is not in these numbers, "
            "which are those of the mesh."
        )
    return "The errors are those of the mesh and of all else that is solved."


def _what(study: StudyOutcome) -> list[str]:
    plan, rows, facts = study.plan, study.rows, study.facts
    done = [row for row in rows if row.result.done]
    values = {axis.key: [f"{v:g}" if isinstance(v, float) else v for v in axis.values] for axis in plan.axes}
    varied = "; ".join(f"{key} = {', '.join(told)}" for key, told in values.items())
    repeats = plan.request.repeats
    times = {1: "once", 2: "twice"}.get(repeats, f"{repeats} times")
    found = [
        f"Scene: {facts['scene']}" + (f" ({plan.base.title})" if plan.base.title else ""),
        f"{len(rows)} combinations of {varied}; {len(rows) - len(done)} failed",
        f"Each was timed {times}, one at a time, on {facts['ranks']} MPI rank(s) of "
        f"{facts['machine']}; after a warm-up step; median and range",
    ]
    meshes = dict.fromkeys((row.result.vertices, row.result.triangles) for row in done)
    found.append("Mesh: " + "; ".join(f"{v} vertices, {t} triangles" for v, t in meshes))
    count = len(plan.sample_times()) - 1
    dynamic = f"Compared at {count} times, every {seconds(plan.every)} to {seconds(plan.end)}"
    return [*found, "Compared at the full load" if plan.static else dynamic]


# -- tables --------------------------------------------------------------------------------------------


def _tables(report: Report, plan: Plan, rows: Sequence[StudyRow]) -> None:
    names = [quantity.name for quantity in plan.quantities]
    head = ["setting", *(_short_title(quantity) for quantity in plan.quantities)]
    head += ["run time", "fastest – slowest", "with set-up", "steps", "rejected", "Newton", "linear"]
    done = [row for row in rows if row.result.done]
    body = []
    for row in done:
        result, times = row.result, row.result.run_seconds()
        body.append(
            [setting(row) + (" ★" if row.recommended else ""), *(_error_cell(row, name) for name in names),
             seconds(row.run), f"{seconds(min(times))} – {seconds(max(times))}", seconds(row.total),
             result.steps, result.rejected, result.newton_iterations, result.linear_iterations]
        )  # fmt: skip
    front = [row.on_front for row in done]
    report.table(
        head,
        body,
        caption="Bold: on the Pareto front."
        + (f" ★: recommended for {percent(DEFAULT_TARGET)}." if any(row.recommended for row in done) else ""),
        marked=front,
    )
    if any(row.unresolved for row in rows):
        report.paragraph(
            f"“< x” stands where an error is below {SAFETY:g} times the reference's own and not resolved."
        )
    report.table(
        ["setting", *PHASES],
        [[setting(row), *(row.result.phase_seconds().get(name, 0.0) for name in PHASES)] for row in done],
        caption="Wall time by phase [s], median; mesh, partition and assembly are set-up, output is the "
        "bookkeeping of energies, writing of files is not counted",
    )


def _short_title(quantity: Quantity) -> str:
    words = {"position_max": "position, max", "position_l2": "position, L2"}
    return "error in " + words.get(quantity.name, quantity.name.replace("_", " ", 1))


def _error_cell(row: StudyRow, name: str) -> str:
    if name in row.unresolved:
        return f"< {short(SAFETY * row.own[name])}"
    value = row.errors.get(name, math.nan)
    return short(value) if math.isfinite(value) else ""


def _orders(report: Report, orders: Sequence[Order]) -> None:
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


def _references(report: Report, known: Mapping[Physics, Reference]) -> None:
    report.heading("Reference")
    for physics, one in known.items():
        where = f"{_scene_words(physics)}: " if physics else ""
        took = f"; its steps took {seconds(one.seconds)}" if math.isfinite(one.seconds) else ""
        report.paragraph(f"{where}{one.words}{took}.")
        if one.kind == "finer" and one.own:
            report.table(
                ["quantity", "own error", "observed order", "converges"],
                [[name, short(own.error), _order(own.order), own.trusted] for name, own in one.own.items()],
                caption="The reference's own error, estimated from coarser runs (Richardson)",
            )


def _order(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else ""


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
        if any(0.0 < row.shown(quantity.name) < math.inf for row in rows):
            found.append(_work(plan, rows, known, quantity, axis, mark))
    for one in (axis for axis in plan.axes if axis.refines):
        for quantity in plan.quantities:
            found += _convergence(rows, known, quantity, one, mark)
    return found


def _floor(known: Reference, quantity: Quantity) -> float | None:
    own = known.own.get(quantity.name)
    return None if own is None or not own.error > 0.0 else SAFETY * own.error


def _work(
    plan: Plan, rows: Sequence[StudyRow], known: Reference, quantity: Quantity, axis: Axis | None, mark: str
) -> Drawing:
    name = quantity.name
    lines = [
        Series(
            label,
            [row.run for row in group],
            [row.shown(name) for row in group],
            [min(row.result.run_seconds()) for row in group],
            [max(row.result.run_seconds()) for row in group],
            [_point(row, axis) for row in group],
        )
        for label, group in families(rows, axis).items()
    ]
    hidden = [row for row in rows if row.result.done and name in row.unresolved]
    main = quantity == plan.quantities[0]
    star = next((row for row in rows if row.recommended), None)
    place = None
    if star is not None and main:
        at = SAFETY * star.own[name] if name in star.unresolved else star.errors[name]
        place = (star.run, at)
    return work_precision(
        lines,
        name=("work-precision" if main else f"work-precision-{_file(name)}") + mark,
        caption=f"{quantity.title} against run time of the steps: median, bars from fastest to slowest of "
        f"{plan.request.repeats}",
        y_label=quantity.title,
        front=[(row.run, row.shown(name)) for row in rows if row.on_front] if main else (),
        bounds=[(row.run, SAFETY * row.own[name]) for row in hidden],
        recommended=place,
        recommendation=f"{setting(star)} (fastest within {percent(DEFAULT_TARGET)})"
        if star is not None
        else "",
        floor=_floor(known, quantity),
        floor_label=BELOW,
    )


def _point(row: StudyRow, axis: Axis | None) -> str:
    if axis is None:
        return ""
    return described(axis.key, row.combination.settings[axis.key]).removeprefix(axis.key).strip()


def _convergence(
    rows: Sequence[StudyRow], known: Reference, quantity: Quantity, axis: Axis, mark: str
) -> list[Drawing]:
    lines = [
        Series(label, [extent(row, axis) for row in group], [row.shown(quantity.name) for row in group])
        for label, group in families(rows, axis).items()
    ]
    if not any(len(line.shown()) > 1 for line in lines):
        return []
    label = {"time.step": "Δt [s] (mean)", "mesh": "h [m] (mean edge)"}.get(axis.path, axis.key)
    drawing = convergence(
        lines, name=f"convergence-{_file(axis.key)}-{_file(quantity.name)}{mark}",
        caption=f"{quantity.title} along {axis.key}", x_label=label, y_label=quantity.title,
        floor=_floor(known, quantity), floor_label=BELOW,
    )  # fmt: skip
    return [drawing]


def _file(name: str) -> str:
    return "".join(sign if sign.isalnum() or sign in "-." else "-" for sign in name).strip("-")


# -- the whole study ---


def conduct(comm: MPI.Comm, work: Work, command: str) -> StudyOutcome:
    """Run what is not finished, compare, and write tables, diagrams and reports; collective.

    Parameters
    ----------
    comm : MPI.Comm
    work : Work
    command : str
        That repeats the study.

    Raises
    ------
    OutputError
        On every rank, if something cannot be written.
    """
    plan, folder = work.plan, work.folder
    plan.notes += busy(plan.request.ranks or comm.size)
    rows = work.rows()
    known = work.compare(rows)
    names = [quantity.name for quantity in plan.quantities]
    facts: dict[str, Any] = {
        "scene": plan.request.scene,
        "title": plan.base.title,
        "command": command,
        "ranks": plan.request.ranks or comm.size,
        "machine": machine(),
        "versions": all_versions(),
    }
    study = StudyOutcome(plan, rows, known, observed_orders(rows, plan.axes, names), {}, facts)
    for physics in known:
        mark_front(study.of(physics), names[0])
        study.advice[physics] = advise(study.of(physics), names[0], main_axis(plan.axes))
        choose_recommended(study.advice[physics])
    on_root(comm, lambda: write_csv(folder, study))
    write_summary(folder / "study.json", content(study), comm)
    on_root(comm, lambda: make_report(study).write(folder))
    return study


def all_versions() -> dict[str, str]:
    """Versions of the program and all that takes part."""
    found = versions()
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def busy(ranks: int) -> list[str]:
    """A note where other processes leave too few cores of this machine idle for so many ranks."""
    cores = os.cpu_count() or 1
    try:
        load = os.getloadavg()[0]
    except OSError:
        return []
    if load + ranks <= cores + 0.5:
        return []
    return [
        f"the machine was busy when this began (load {load:.1f} on {cores} cores): "
        "run times may be larger and spread more than on an idle one"
    ]


def machine() -> str:
    """Processor and cores, in words."""
    model = platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                model = line.split(":", 1)[1].strip()
                break
    except OSError:
        pass
    return f"{model}, {os.cpu_count() or 1} cores"
