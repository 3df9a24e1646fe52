"""study.csv and study.json."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lyra_petsc.experiments.results import csv_text
from lyra_petsc.experiments.study.advice import Advice
from lyra_petsc.experiments.study.analysis import Order, Row
from lyra_petsc.experiments.study.plan import Plan
from lyra_petsc.experiments.study.reference import Physics
from lyra_petsc.experiments.study.work import Known
from lyra_petsc.output.atomic import replace_text

PHASES = ("mesh", "partition", "assembly", "solve", "balance", "output", "other")
"""Phases of a run; ``balance`` is the bookkeeping of energies, the writing of files is not timed."""


def order_axes(plan: Plan) -> list[str]:
    """Keys of the axes along which orders are reported."""
    return [axis.key for axis in plan.axes if axis.refines]


def record(plan: Plan, row: Row) -> dict[str, Any]:
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


def _nominal_step(plan: Plan, row: Row) -> float | str | None:
    for axis, value in zip(row.combination.axes, row.combination.values, strict=True):
        if axis.path == "time.step":
            return value
        if axis.path == "time.tolerance":
            return "auto"
    return plan.base.time.step


def _told(value: float) -> float | None:
    return value if math.isfinite(value) else None


def write_csv(folder: Path, plan: Plan, rows: Sequence[Row]) -> None:
    """Write ``study.csv``. Call on one rank."""
    rows_told = [record(plan, row) for row in rows]
    replace_text(folder / "study.csv", csv_text(list(rows_told[0]), rows_told, _cell))


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return repr(float(value)) if isinstance(value, float) else str(value)


def content(
    plan: Plan,
    rows: Sequence[Row],
    known: Mapping[Physics, Known],
    orders: Sequence[Order],
    advice: Mapping[Physics, Sequence[Advice]],
    facts: Mapping[str, Any],
) -> dict[str, Any]:
    """What ``study.json`` holds: all of the table, the repeats, the references, orders and advice."""
    return {
        **facts,
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
            for physics, one in known.items()
        ],
        "combinations": [
            {
                **{key: value for key, value in record(plan, row).items() if value not in ("", None)},
                "errors": {name: row.shown(name) for name in row.errors},
                "not_resolved": sorted(row.unresolved),
                "timings": [asdict(timing) for timing in row.result.timings],
                "notes": row.result.notes,
            }
            for row in rows
        ],
        "orders": [asdict(order) for order in orders],
        "advice": [
            {
                "scene": dict(physics),
                "accuracy": one.target,
                "combination": one.row.combination.name if one.row is not None else None,
                "words": one.words,
            }
            for physics, list_ in advice.items()
            for one in list_
        ],
    }
