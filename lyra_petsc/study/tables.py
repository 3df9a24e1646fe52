"""study.csv and study.json."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lyra_petsc.output.atomic import replace_text
from lyra_petsc.study.advice import Advice
from lyra_petsc.study.analysis import Order, Row
from lyra_petsc.study.plan import Plan
from lyra_petsc.study.reference import Physics
from lyra_petsc.study.work import Known

PHASES = ("mesh", "partition", "assembly", "solve", "balance", "output", "other")
"""Phases of a run; ``balance`` is the bookkeeping of energies, the writing of files is not timed."""


def columns(plan: Plan) -> list[str]:
    """The header of ``study.csv``."""
    names = [quantity.name for quantity in plan.quantities]
    varied = [axis.key for axis in plan.axes if axis.path not in ("time.integrator", "time.step", "mesh")]
    return [
        "combination", "status", "reason", "integrator", "dt", "dt_mean", "dt_min", "dt_max", "mesh", "h",
        "vertices", "triangles", *varied, "force_tolerance", "step_tolerance", "linear_solver",
        *(f"error_{name}" for name in names),
        *(f"reference_error_{name}" for name in names),
        "not_resolved",
        *(f"order_{axis}_{name}" for axis in order_axes(plan) for name in names),
        "repeats", "ranks",
        "run_seconds", "run_seconds_min", "run_seconds_max",
        "total_seconds", "total_seconds_min", "total_seconds_max",
        *(f"seconds_{phase}" for phase in PHASES),
        "steps", "rejected", "newton_iterations", "linear_iterations", "pareto", "recommended",
    ]  # fmt: skip


def order_axes(plan: Plan) -> list[str]:
    """Keys of the axes along which orders are told."""
    return [axis.key for axis in plan.axes if axis.numeric and not axis.physical and len(axis.values) > 1]


def record(plan: Plan, row: Row) -> dict[str, Any]:
    """A row of ``study.csv`` by its columns; None where there is nothing to tell."""
    result, settings = row.result, row.combination.settings
    paths = {axis.path: axis.key for axis in plan.axes}
    found: dict[str, Any] = {
        "combination": row.combination.name,
        "status": "done" if result.done else "failed",
        "reason": result.problem,
        "integrator": row.line,
        "dt": _nominal_step(plan, row),
        "mesh": settings.get(paths.get("mesh", "")),
        "linear_solver": result.linear_solver,
        "repeats": len(result.timings),
        "ranks": result.ranks,
        "pareto": row.on_front,
        "recommended": row.recommended,
        "not_resolved": " ".join(sorted(row.unresolved)),
    }
    for name in ("force_tolerance", "step_tolerance"):
        key = paths.get(f"solver.{name}")
        found[name] = settings[key] if key else getattr(plan.base.solver, name)
    found |= {key: value for key, value in settings.items() if key not in ("dt", "mesh", "integrator")}
    if result.vertices:
        found |= {"h": result.spacing, "vertices": result.vertices, "triangles": result.triangles}
    if not result.done:
        return found
    found |= {
        "dt_mean": result.mean_step,
        "dt_min": result.shortest,
        "dt_max": result.longest,
        "steps": result.steps,
        "rejected": result.rejected,
        "newton_iterations": result.newton_iterations,
        "linear_iterations": result.linear_iterations,
        "run_seconds": row.run,
        "run_seconds_min": min(result.run_seconds()),
        "run_seconds_max": max(result.run_seconds()),
        "total_seconds": row.total,
        "total_seconds_min": min(result.total_seconds()),
        "total_seconds_max": max(result.total_seconds()),
    }
    found |= {f"seconds_{phase}": result.phase_seconds().get(phase, 0.0) for phase in PHASES}
    for name in row.errors:
        found[f"error_{name}"] = _told(row.shown(name))
        found[f"reference_error_{name}"] = _told(row.own.get(name, math.nan))
    found |= {f"order_{axis}_{name}": value for (axis, name), value in row.orders.items()}
    return found


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
    text = io.StringIO()
    names = columns(plan)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        values = record(plan, row)
        writer.writerow([_cell(values.get(name)) for name in names])
    replace_text(folder / "study.csv", text.getvalue())


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
