"""report.html and report.md of a study, with its diagrams."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from lyra_petsc.experiments.study.advice import DEFAULT_TARGET, Advice, setting
from lyra_petsc.experiments.study.analysis import Order, Row, extent, families
from lyra_petsc.experiments.study.axes import Axis
from lyra_petsc.experiments.study.combination import described
from lyra_petsc.experiments.study.plan import Plan
from lyra_petsc.experiments.study.quantities import Quantity
from lyra_petsc.experiments.study.reference import Physics, physics_of
from lyra_petsc.experiments.study.refine import SAFETY, refines_time
from lyra_petsc.experiments.study.tables import PHASES
from lyra_petsc.experiments.study.work import Known
from lyra_petsc.show.report.document import Drawing, Report
from lyra_petsc.show.report.numbers import percent, seconds, short
from lyra_petsc.show.report.plots import Series, convergence, work_precision

BELOW = "below what the reference can tell"


def make_report(
    plan: Plan,
    rows: Sequence[Row],
    known: Mapping[Physics, Known],
    orders: Sequence[Order],
    advice: Mapping[Physics, Sequence[Advice]],
    facts: Mapping[str, Any],
) -> Report:
    """The whole report."""
    report = Report(f"Error against run time: {plan.base.title or facts['scene']}")
    failed = [row for row in rows if not row.result.done]
    for physics, one in known.items():
        _advise(report, plan, physics, one, advice.get(physics, ()))
    report.heading("What was run")
    report.bullets(_what(plan, rows, facts))
    report.bullets([*plan.notes, *(note for one in known.values() for note in one.notes)])
    for number, (physics, one) in enumerate(known.items(), start=1):
        mark = "" if len(known) == 1 else f"-{number}"
        mine = [row for row in rows if physics_of(row.combination) == physics]
        report.heading("Diagrams" + (f" for {_scene_words(physics)}" if physics else ""))
        for drawing in drawings(plan, mine, one, mark):
            report.figure(drawing)
    report.heading("Errors and run times")
    _tables(report, plan, rows)
    _orders(report, orders)
    _references(report, plan, known)
    if failed:
        report.heading("What failed")
        report.table(["combination", "why"], [[row.combination.label, row.result.problem] for row in failed])
    report.heading("To repeat it")
    report.code(str(facts["command"]))
    report.table(["", "version"], [[name, text] for name, text in facts["versions"].items()])
    return report


def _scene_words(physics: Physics) -> str:
    return ", ".join(described(key, value) for key, value in physics)


def _advise(report: Report, plan: Plan, physics: Physics, known: Known, advice: Sequence[Advice]) -> None:
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


def _left_out(plan: Plan, known: Known) -> str:
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


def _what(plan: Plan, rows: Sequence[Row], facts: Mapping[str, Any]) -> list[str]:
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


def _tables(report: Report, plan: Plan, rows: Sequence[Row]) -> None:
    names = [quantity.name for quantity in plan.quantities]
    head = ["setting", *(_short_title(quantity) for quantity in plan.quantities)]
    head += ["run time", "fastest – slowest", "with set-up", "steps", "rejected", "Newton", "linear"]
    done = [row for row in rows if row.result.done]
    body = []
    for row in done:
        result, times = row.result, row.result.run_seconds()
        body.append(
            [setting(row) + (" ★" if row.recommended else ""), *(_error(row, name) for name in names),
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


def _error(row: Row, name: str) -> str:
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


def _references(report: Report, plan: Plan, known: Mapping[Physics, Known]) -> None:
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


def drawings(plan: Plan, rows: Sequence[Row], known: Known, mark: str) -> list[Drawing]:
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


def _floor(known: Known, quantity: Quantity) -> float | None:
    own = known.own.get(quantity.name)
    return None if own is None or not own.error > 0.0 else SAFETY * own.error


def _work(
    plan: Plan, rows: Sequence[Row], known: Known, quantity: Quantity, axis: Axis | None, mark: str
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


def _point(row: Row, axis: Axis | None) -> str:
    if axis is None:
        return ""
    return described(axis.key, row.combination.settings[axis.key]).removeprefix(axis.key).strip()


def _convergence(
    rows: Sequence[Row], known: Known, quantity: Quantity, axis: Axis, mark: str
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
