"""What ``stress`` tells: a line for each case, and a page on which the worst cases stand first."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lyra_petsc.experiments.results import Line, View
from lyra_petsc.experiments.stress.stress_scenes import Setting, StressCase, as_it_is
from lyra_petsc.experiments.stress.trials import StressOutcome
from lyra_petsc.experiments.stress.verdicts import over
from lyra_petsc.show.report.closing import PLOTS
from lyra_petsc.show.report.document import Report
from lyra_petsc.show.report.numbers import seconds, short
from lyra_petsc.show.report.shapes import Curve, over_time, surface

PICTURES = 6
"""Of the worst cases."""

HEADINGS = {
    "case": 28, "verdict": 7, "steps": 7, "rejected": 0, "least Δt": 8, "Newton": 8, "linear": 7,
    "energy off [J]": 8, "tolerance [J]": 8, "stretch": 13, "step": 8, "over base": 0, "CPU": 5,
}  # fmt: skip
"""Heads of the table's columns, and how wide each is at least."""


def row_of(outcome: StressOutcome) -> dict[str, Any]:
    """The line of a case in the CSV; energies in J, times in s, NaN where there is nothing to tell."""
    record = outcome.record
    balances = record.balances
    worst = max(balances, key=lambda b: over(abs(b.defect), b.tolerance), default=None)
    momenta = [(over(b.momentum, b.momentum_tolerance), over(b.spin, b.spin_tolerance)) for b in balances]
    nan = math.nan
    return {
        "case": outcome.case.name,
        "family": outcome.case.family,
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
        "residual_over_promised": max((over(b.residual, b.promised) for b in balances), default=nan),
        "energy_defect": abs(worst.defect) if worst else nan,
        "energy_tolerance": worst.tolerance if worst else nan,
        "energy_turned_over": worst.moved if worst else nan,
        "verdict": outcome.verdict,
        "numerical_dissipation": record.lost,
        "momentum_defect_over_tolerance": max(map(max, momenta), default=nan),
        "smallest_stretch": record.stretches[0],
        "largest_stretch": record.stretches[1],
        "step_wall_seconds": record.median_seconds,
        "step_over_base": outcome.ratio,
        "step_over_base_cpu": outcome.busy_ratio,
        "wall_seconds": outcome.seconds,
        "failures": "; ".join(f"{name}: {verdict.words}" for name, verdict in outcome.failures.items()),
    }


def cells(outcome: StressOutcome) -> list[str]:
    """A case's line of the table, by `HEADINGS`."""
    row = row_of(outcome)
    return [
        outcome.case.name,
        outcome.verdict,
        f"{row['steps']}",
        f"{row['rejected']}",
        seconds(row["smallest_dt"]),
        f"{short(row['newton_median'])}, {row['newton_worst']}",
        f"{row['linear_iterations']}",
        short(row["energy_defect"], 2),
        short(row["energy_tolerance"], 2),
        f"{short(row['smallest_stretch'])} – {short(row['largest_stretch'])}",
        seconds(row["step_wall_seconds"]),
        short(row["step_over_base"]),
        short(row["step_over_base_cpu"]),
    ]


class Stress(View[StressOutcome]):
    """A line for each case.

    Parameters
    ----------
    setting : Setting
    count : int
        Cases to be run in all.
    """

    verb = "stress"
    title = "Stress: stiff and extreme cases"
    pictures = "pictures"
    columns = tuple(row_of(StressOutcome(StressCase("", "", as_it_is))))

    def __init__(self, setting: Setting, count: int) -> None:
        self._setting, self._count = setting, count

    def heading(self) -> str:
        return _padded(list(HEADINGS))

    def lines(self, outcome: StressOutcome) -> Iterable[Line]:
        if outcome.left_out:
            yield f"{outcome.case.name}: left out: {outcome.left_out}", "dim"
            return
        yield _padded(cells(outcome)), "" if outcome.passed else "bold red"
        for name, verdict in outcome.failures.items():
            yield f"    {name}: {verdict.words}", "red"

    def summary(self, outcomes: Sequence[StressOutcome]) -> list[Sequence[str]]:
        table: list[Sequence[str]] = [("family", "passed", "run time [s]")]
        run = [outcome for outcome in outcomes if not outcome.left_out]
        for family in dict.fromkeys(outcome.case.family for outcome in run):
            mine = [outcome for outcome in run if outcome.case.family == family]
            passed = f"{sum(outcome.passed for outcome in mine)} of {len(mine)}"
            table.append((family, passed, f"{sum(outcome.seconds for outcome in mine):.1f}"))
        return table

    def ended(self, outcomes: Sequence[StressOutcome]) -> None:
        """Free the shapes that the page will not show, since there are worse cases."""
        for outcome in sorted(outcomes, key=badness, reverse=True)[PICTURES:]:
            outcome.record.last = outcome.record.triangles = None

    def rows(self, outcome: StressOutcome) -> Iterable[Mapping[str, Any]]:
        yield row_of(outcome)

    def told(self, outcome: StressOutcome) -> dict[str, Any]:
        record = outcome.record
        return row_of(outcome) | {
            "notes": record.notes,
            "newton_iterations": record.newton,
            "times": record.times,
            "energies": [record.start_energy, *record.energies],
        }

    def facts(self, outcomes: Sequence[StressOutcome]) -> dict[str, Any]:
        left_out = {outcome.case.name: outcome.left_out for outcome in outcomes if outcome.left_out}
        return {"complete": len(outcomes) == self._count, "left_out": left_out}

    def page(self, report: Report, outcomes: Sequence[StressOutcome], summary: str, *, drawn: bool) -> None:
        run = sorted((outcome for outcome in outcomes if not outcome.left_out), key=badness, reverse=True)
        base = self._setting.base.get("title") or "without a title"
        report.paragraph(
            f"{summary} Base scene: {base}, Δt {seconds(self._setting.step)}. The worst cases stand first. "
            "Newton iterations of a step: median, worst. Energy off: how far the worst step misses the "
            "energy identity of backward Euler, and what its residual allows. Stretch: smallest and largest "
            "principal stretch of any triangle. A case is right where the integrator takes at most 5 % of "
            "the largest energy at work away, and solved where it takes more. Step: median wall time, and "
            "how many times that of the base scene, measured before and after the case; "
            "CPU: the same of CPU time."
        )
        report.table(list(HEADINGS), [cells(one) for one in run], marked=[not one.passed for one in run])
        failed = [
            f"{outcome.case.name} ({outcome.case.title}): {name}: {verdict.words}"
            for outcome in run
            for name, verdict in outcome.failures.items()
        ]
        if any(not outcome.passed for outcome in run):
            report.heading("What failed")
            report.bullets(failed)
        report.heading("The worst cases")
        for outcome in run[:PICTURES]:
            report.paragraph(f"{outcome.case.name}: {outcome.case.title}.")
            report.bullets(outcome.record.notes)
            if drawn:
                _figures(report, outcome)
        report.heading("What was judged")
        report.table(
            ["case", "what", "verdict"],
            [
                [outcome.case.name, name, ("passed: " if verdict.passed else "FAILED: ") + verdict.words]
                for outcome in run
                for name, verdict in outcome.verdicts.items()
            ],
        )
        left_out = [f"{one.case.name}: {one.left_out}" for one in outcomes if one.left_out]
        if left_out:
            report.heading("Left out")
            report.bullets(left_out)


def badness(outcome: StressOutcome) -> tuple[float, ...]:
    """Cases that failed first, then those with the most trouble."""
    record = outcome.record
    return (
        float(not outcome.passed),
        float(bool(record.stopped)),
        float(record.rejected),
        float(max(record.newton, default=0)),
    )


def _padded(texts: Sequence[str]) -> str:
    widths = [max(len(name), least) for name, least in HEADINGS.items()]
    first, *others = zip(texts, widths, strict=True)
    return "  ".join([first[0].ljust(first[1]), *(text.rjust(width) for text, width in others)]).rstrip()


def _figures(report: Report, outcome: StressOutcome) -> None:
    """The last shape, and the energy over time beside the work done."""
    case, record = outcome.case, outcome.record
    if record.last is not None and record.triangles is not None:
        when = f"t = {seconds(record.times[-1])}" if record.times else "the start"
        report.figure(
            surface(
                record.last, record.triangles, name=f"{PLOTS}/{case.name}-shape",
                caption=f"{case.name}: {case.title}, {when}",
            )
        )  # fmt: skip
    if len(record.times) > 1:
        times = [0.0, *record.times]
        curves = [Curve("kinetic + potential", times, [record.start_energy, *record.energies])]
        if record.balances and record.integrator == "beuler":
            work = itertools.accumulate((one.work for one in record.balances), initial=record.start_energy)
            curves.append(Curve("energy at the start + work done", times, list(work)))
        report.figure(
            over_time(
                curves, name=f"{PLOTS}/{case.name}-energy", caption=f"{case.name}: energy over time",
                y_label="energy [J]",
            )
        )  # fmt: skip
