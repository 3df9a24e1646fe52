"""The page about a ``stress``: the table, and the worst cases first with their shapes and energies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from lyra_petsc.report.closing import PLOTS, close, lacking
from lyra_petsc.report.document import Report
from lyra_petsc.report.numbers import seconds
from lyra_petsc.report.shapes import Curve, over_time, surface
from lyra_petsc.stress.case import Setting
from lyra_petsc.stress.runner import Outcome
from lyra_petsc.stress.table import cells, headings

PICTURES = 6
"""Of the worst cases."""


def write_report(
    folder: Path,
    outcomes: Sequence[Outcome],
    setting: Setting,
    versions: Mapping[str, str],
    ranks: int,
    command: Sequence[str],
) -> str:
    """Write ``report.md``, and ``report.html`` with pictures where the extra ``study`` is there. On one rank.

    Returns
    -------
    str
        What is missing and how to get it; empty if nothing is.
    """
    drawn = not lacking()
    run = sorted((outcome for outcome in outcomes if not outcome.left_out), key=badness, reverse=True)
    passed = sum(outcome.passed for outcome in run)
    report = Report("Stress: stiff and extreme cases")
    report.paragraph(
        f"{passed} of {len(run)} cases passed on {ranks} rank{'s' if ranks > 1 else ''}. Base scene: "
        f"{setting.base.get('title') or 'without a title'}, Δt {seconds(setting.step)}. The worst cases "
        "stand first. Newton iterations of a step: median, worst. Energy off: how far the worst step misses "
        "the energy identity of backward Euler, and what its residual allows. Stretch: smallest and largest "
        "principal stretch of any triangle. Step: median wall time, and how many times that of the base "
        "scene, measured before and after the case; CPU: the same of CPU time."
    )
    names = [name for name, _ in headings()]
    report.table(names, [cells(outcome) for outcome in run], marked=[not outcome.passed for outcome in run])
    failed = [outcome for outcome in run if not outcome.passed]
    if failed:
        report.heading("What failed")
        report.bullets(
            [
                f"{outcome.case.name} ({outcome.case.title}): {name}: {verdict.words}"
                for outcome in failed
                for name, verdict in outcome.failures.items()
            ]
        )
    report.heading("The worst cases")
    for outcome in run[:PICTURES]:
        _case(report, outcome, pictures=drawn)
    report.heading("What was judged")
    report.table(
        ["case", "what", "verdict"],
        [
            [outcome.case.name, name, ("passed: " if verdict.passed else "FAILED: ") + verdict.words]
            for outcome in run
            for name, verdict in outcome.verdicts.items()
        ],
    )
    left_out = [outcome for outcome in outcomes if outcome.left_out]
    if left_out:
        report.heading("Left out")
        report.bullets([f"{outcome.case.name}: {outcome.left_out}" for outcome in left_out])
    return close(report, folder, versions, command, pictures="pictures")


def badness(outcome: Outcome) -> tuple[float, ...]:
    """Cases that failed first, then those with the most trouble."""
    record = outcome.record
    return (
        float(not outcome.passed),
        float(bool(record.stopped)),
        float(record.rejected),
        float(max(record.newton, default=0)),
    )


def release_shapes(outcomes: Sequence[Outcome]) -> None:
    """Let go of the shapes that the page will not show, since worse cases are there."""
    for outcome in sorted(outcomes, key=badness, reverse=True)[PICTURES:]:
        outcome.record.last = outcome.record.triangles = None


def _case(report: Report, outcome: Outcome, *, pictures: bool) -> None:
    case, record = outcome.case, outcome.record
    report.paragraph(f"{case.name}: {case.title}.")
    report.bullets(record.notes)
    if not pictures:
        return
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
            work, total = [record.start_energy], record.start_energy
            for balance in record.balances:
                total += balance.work
                work.append(total)
            curves.append(Curve("energy at the start + work done", times, work))
        report.figure(
            over_time(
                curves, name=f"{PLOTS}/{case.name}-energy", caption=f"{case.name}: energy over time",
                y_label="energy [J]",
            )
        )  # fmt: skip
