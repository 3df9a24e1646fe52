"""A case in one line: for the CSV with all digits, for people with few."""

from __future__ import annotations

import math
from typing import Any

from lyra_petsc.report.numbers import seconds, short
from lyra_petsc.stress.runner import Outcome

COLUMNS = (
    "case",
    "family",
    "passed",
    "converged",
    "why",
    "steps",
    "steps_planned",
    "dt",
    "smallest_dt",
    "rejected",
    "newton_median",
    "newton_worst",
    "linear_iterations",
    "residual_over_promised",
    "energy_defect",
    "energy_tolerance",
    "energy_turned_over",
    "momentum_defect_over_tolerance",
    "smallest_stretch",
    "largest_stretch",
    "step_wall_seconds",
    "step_over_base",
    "step_over_base_cpu",
    "wall_seconds",
    "failures",
)


def row_of(outcome: Outcome) -> dict[str, Any]:
    """The line of a case in the CSV, by `COLUMNS`; energies in J, times in s."""
    record = outcome.record
    balances = record.balances
    worst = max(balances, key=lambda b: _ratio(abs(b.defect), b.tolerance), default=None)
    nan = math.nan
    return {
        "case": outcome.case.name,
        "family": outcome.family,
        "passed": outcome.passed,
        "converged": not record.stopped,
        "why": record.stopped,
        "steps": len(record.reports),
        "steps_planned": record.planned,
        "dt": record.nominal,
        "smallest_dt": record.smallest_step,
        "rejected": record.rejected,
        "newton_median": record.median_newton,
        "newton_worst": max(record.newton, default=0),
        "linear_iterations": record.linear,
        "residual_over_promised": max((_ratio(b.residual, b.promised) for b in balances), default=nan),
        "energy_defect": abs(worst.defect) if worst else nan,
        "energy_tolerance": worst.tolerance if worst else nan,
        "energy_turned_over": worst.moved if worst else nan,
        "momentum_defect_over_tolerance": max(
            (
                max(_ratio(b.momentum, b.momentum_tolerance), _ratio(b.spin, b.spin_tolerance))
                for b in balances
            ),
            default=nan,
        ),
        "smallest_stretch": record.stretches[0],
        "largest_stretch": record.stretches[1],
        "step_wall_seconds": record.median_seconds,
        "step_over_base": outcome.ratio,
        "step_over_base_cpu": outcome.busy_ratio,
        "wall_seconds": outcome.seconds,
        "failures": "; ".join(f"{name}: {verdict.words}" for name, verdict in outcome.failures.items()),
    }


def _ratio(amount: float, tolerance: float) -> float:
    return amount / tolerance if tolerance > 0.0 else 0.0 if amount == 0.0 else math.inf


def headings() -> list[tuple[str, int]]:
    """Heads of the table's columns, and how wide each is at least."""
    return [
        ("case", 28),
        ("verdict", 7),
        ("steps", 7),
        ("rejected", 0),
        ("least Δt", 8),
        ("Newton", 8),
        ("linear", 7),
        ("energy off [J]", 8),
        ("tolerance [J]", 8),
        ("stretch", 13),
        ("step", 8),
        ("over base", 0),
        ("CPU", 5),
    ]


def cells(outcome: Outcome) -> list[str]:
    """A case's line of the table."""
    row = row_of(outcome)
    median, worst = short(row["newton_median"]), row["newton_worst"]
    return [
        outcome.case.name,
        "passed" if outcome.passed else "FAILED",
        f"{row['steps']}",
        f"{row['rejected']}",
        seconds(row["smallest_dt"]),
        f"{median}, {worst}",
        f"{row['linear_iterations']}",
        short(row["energy_defect"], 2),
        short(row["energy_tolerance"], 2),
        f"{short(row['smallest_stretch'])} – {short(row['largest_stretch'])}",
        seconds(row["step_wall_seconds"]),
        short(row["step_over_base"]),
        short(row["step_over_base_cpu"]),
    ]
