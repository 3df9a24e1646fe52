"""Runs the cases of ``stress``, computes the balance of every step, judges the cases and reports them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.experiments.bench import Trial, failure_message
from lyra_petsc.experiments.case import Launcher, Outcome, Verdict, Watch
from lyra_petsc.experiments.results import Line, View
from lyra_petsc.experiments.stress.step_balance import BalanceRecorder
from lyra_petsc.experiments.stress.stress_scenes import NotApplicable, Scope, Setting, StressCase, base_scene
from lyra_petsc.experiments.stress.verdicts import (
    SMALL_DISSIPATION,
    RunRecord,
    judge_physics,
    judge_speed,
    median,
    ratio,
)
from lyra_petsc.kernels.compilation import COMPILATION
from lyra_petsc.show.report.document import Report, seconds, short

TIME_LIMIT = {Scope.QUICK: 20.0, Scope.USUAL: 60.0, Scope.FULL: 600.0}
"""CPU time [s], without the compilation of kernels, after which a case is stopped between two steps."""


@dataclass
class SavedOutcome:
    """A `StressOutcome` without its case, as the process of a case returns it to the one that launched it."""

    verdicts: dict[str, Verdict]
    seconds: float
    left_out: str
    record: RunRecord
    wall_ratio: float
    cpu_ratio: float


@dataclass
class StressOutcome(Outcome[StressCase]):
    """The result of a case.

    Attributes
    ----------
    record : Record
    wall_ratio : float
        Median wall time of a step over that of the base scene, measured before and after the case.
    cpu_ratio : float
        The same ratio of CPU times.
    """

    record: RunRecord = field(default_factory=RunRecord)
    wall_ratio: float = math.nan
    cpu_ratio: float = math.nan

    @property
    def verdict(self) -> str:
        """``FAILED``, ``right``, or ``solved`` if the integrator dissipates much of the energy."""
        if not self.passed:
            return "FAILED"
        return "right" if self.record.dissipation <= SMALL_DISSIPATION else "solved"

    def saved(self) -> SavedOutcome:
        """All but the case, which cannot be stored in a file."""
        return SavedOutcome(**{name: value for name, value in vars(self).items() if name != "case"})


class BaseClock:
    """Repeated measurements of the time per step of the base scene; collective.

    Parameters
    ----------
    comm : MPI.Comm
    setting : Setting
    watch : callable, optional
        Called before every step.

    Attributes
    ----------
    latest : (2,) array
        Median wall and CPU time [s] of the last measurement.
    size : float
        Diagonal of the base scene's bounding box [m].
    """

    def __init__(self, comm: MPI.Comm, setting: Setting, watch: Watch | None = None) -> None:
        self._comm, self._setting, self._watch = comm, setting, watch
        self.size = math.nan
        self.measure()  # compiles or loads kernels
        self.latest = self.measure()

    def measure(self) -> Array:
        """Median wall time and CPU time [s] of the first steps of the base scene, (2,).

        Raises
        ------
        InputError, SolverError
            If the base scene does not run.
        """
        content = self._setting.content()
        # timed steps of the base scene: as many as most cases take, since later steps cost more
        content["time"] = {**content["time"], "end": 20 * self._setting.step}
        seconds: list[tuple[float, float]] = []
        with self._setting.bench(self._comm, self._watch) as bench, bench.simulation(content) as trial:
            self.size = trial.simulation.problem.whole.size
            while not trial.simulation.finished:
                began = time.process_time()
                seconds.append((trial.step().wall_seconds, time.process_time() - began))
        mine = np.median(seconds, axis=0) if seconds else np.full(2, np.nan)
        self.latest = np.max(self._comm.allgather(mine), axis=0)
        return self.latest


def run_case(
    comm: MPI.Comm,
    case: StressCase,
    setting: Setting,
    clock: BaseClock | None = None,
    watch: Watch | None = None,
) -> StressOutcome:
    """Run a case and judge it; collective, the same outcome on all ranks.

    Parameters
    ----------
    comm : MPI.Comm
    case : StressCase
    setting : Setting
    clock : BaseClock, optional
        Times of the base scene, which times per step are compared with if given.
    watch : callable, optional
        Called before every step on all ranks; may raise to end the work.

    Raises
    ------
    SolverError
        An error on one rank only, after which the ranks cannot continue together.
    """
    began, deadline = time.perf_counter(), _own_seconds() + TIME_LIMIT[setting.level]
    before = clock.latest if clock is not None else None
    outcome = StressOutcome(case, record=RunRecord(case.steps))
    with setting.bench(comm, watch) as bench:
        try:
            content = case.content(setting, bench)
        except NotApplicable as why:
            outcome.left_out = str(why)
            return outcome
        record = outcome.record
        record.nominal, record.end = content["time"]["step"], content["time"]["end"]
        record.integrator = content["time"].get("integrator", "beuler")
        try:
            with bench.simulation(content) as trial:
                _run_steps(trial, case, record, deadline)
        except (InputError, SolverError) as error:
            record.stop_reason = failure_message(comm, error)
        outcome.verdicts = judge_physics(record)
        if clock is not None and before is not None:
            wall, cpu_seconds = 0.5 * (before + clock.measure())
            ratios = record.median_seconds / wall, median(record.cpu_seconds) / cpu_seconds
            outcome.wall_ratio, outcome.cpu_ratio = comm.bcast(tuple(map(float, ratios)), root=0)
            if case.is_timed:
                outcome.verdicts["speed"] = judge_speed(record, outcome.wall_ratio, outcome.cpu_ratio)
        if case.judge is not None and not record.stop_reason:
            outcome.verdicts |= case.judge(setting, bench, record)
    outcome.seconds = comm.bcast(time.perf_counter() - began, root=0)
    return outcome


def _own_seconds() -> float:
    """CPU time [s] of this process so far, less the wall time of compilations, which is no shorter."""
    return time.process_time() - COMPILATION.seconds


def _run_steps(trial: Trial, case: StressCase, record: RunRecord, deadline: float) -> None:
    """Fill the record, step by step to the end or until `_own_seconds` of rank 0 reach a deadline."""
    simulation = trial.simulation
    comm = simulation.comm
    if case.shape is not None:
        shape = case.shape(trial.x, simulation.problem.whole.spacing)
        trial.set_state(x=shape)
    record.start_energy = simulation.budget.total
    if case.observe is not None:
        record.observed.append(case.observe(trial))
    recorder = None
    if record.integrator != "semi-implicit":  # it satisfies no such balance
        recorder = BalanceRecorder(simulation)
    try:
        while not simulation.finished:
            if comm.bcast(_own_seconds() > deadline, root=0):
                record.stop_reason = (
                    f"given up at t = {simulation.time:g} s of {record.end:g} s: the case has had its time"
                )
                break
            cpu_seconds = time.process_time()
            report = trial.step()
            record.cpu_seconds.append(comm.allreduce(time.process_time() - cpu_seconds, op=MPI.MAX))
            record.reports.append(report)
            record.energies.append(simulation.budget.total)
            if recorder is not None:
                record.balances.append(recorder.balance(report))
                recorder.record_state()
            if case.observe is not None:
                record.observed.append(case.observe(trial))
    finally:
        record.notes = list(simulation.notes)
        record.balance = simulation.guard.content() if simulation.guard is not None else {}


def launched(launcher: Launcher, case: StressCase, arguments: Sequence[str], watch: Watch) -> StressOutcome:
    """Run a case in processes of its own.

    Parameters
    ----------
    launcher : Launcher
    case : StressCase
    arguments : sequence of str
        Scene and options of ``stress``.
    watch : callable
        Called repeatedly; if it raises, the processes are terminated.

    Raises
    ------
    InputError
        If the launched program rejects its arguments.
    """
    saved, message = launcher.run_case([*arguments, "--only", case.name], watch, SavedOutcome)
    if saved is not None:
        return StressOutcome(case, **vars(saved))
    record = RunRecord(case.steps, stop_reason=message)
    return StressOutcome(case, judge_physics(record), record=record)


def csv_row(outcome: StressOutcome) -> dict[str, Any]:
    """The row of a case in the CSV file; energies in J, times in s, NaN where a value is missing."""
    record = outcome.record
    balances = record.balances
    worst = max(balances, key=lambda b: ratio(abs(b.defect), b.tolerance), default=None)
    momenta = [
        (ratio(b.momentum, b.momentum_tolerance), ratio(b.angular, b.angular_tolerance)) for b in balances
    ]
    nan = math.nan
    return {
        "case": outcome.case.name,
        "family": outcome.case.family,
        "passed": outcome.passed,
        "converged": not record.stop_reason,
        "why": record.stop_reason,
        "steps": len(record.reports),
        "steps_planned": record.planned,
        "dt": record.nominal,
        "smallest_dt": record.smallest_step,
        "rejected": record.rejected,
        "newton_median": median(record.newton),
        "newton_worst": max(record.newton, default=0),
        "linear_iterations": record.linear,
        "residual_over_promised": max((ratio(b.residual, b.promised) for b in balances), default=nan),
        "energy_defect": abs(worst.defect) if worst else nan,
        "energy_tolerance": worst.tolerance if worst else nan,
        "energy_turned_over": worst.turned_over if worst else nan,
        "verdict": outcome.verdict,
        "numerical_dissipation": record.dissipation,
        "momentum_defect_over_tolerance": max(map(max, momenta), default=nan),
        "smallest_stretch": record.stretches[0],
        "largest_stretch": record.stretches[1],
        "step_wall_seconds": record.median_seconds,
        "step_over_base": outcome.wall_ratio,
        "step_over_base_cpu": outcome.cpu_ratio,
        "wall_seconds": outcome.seconds,
        "failures": "; ".join(f"{name}: {verdict.message}" for name, verdict in outcome.failures.items()),
    }


HEADINGS: dict[str, tuple[int, Callable[[Mapping[str, Any]], str]]] = {
    "case": (28, lambda row: row["case"]),
    "verdict": (7, lambda row: row["verdict"]),
    "steps": (7, lambda row: f"{row['steps']}"),
    "rejected": (0, lambda row: f"{row['rejected']}"),
    "least Δt": (8, lambda row: seconds(row["smallest_dt"])),
    "Newton": (8, lambda row: f"{short(row['newton_median'])}, {row['newton_worst']}"),
    "linear": (7, lambda row: f"{row['linear_iterations']}"),
    "energy off [J]": (8, lambda row: short(row["energy_defect"], 2)),
    "tolerance [J]": (8, lambda row: short(row["energy_tolerance"], 2)),
    "stretch": (13, lambda row: f"{short(row['smallest_stretch'])} – {short(row['largest_stretch'])}"),
    "step": (8, lambda row: seconds(row["step_wall_seconds"])),
    "over base": (0, lambda row: short(row["step_over_base"])),
    "CPU": (5, lambda row: short(row["step_over_base_cpu"])),
}
"""The columns of the table: headings, minimum widths, and cells by the row of the CSV file."""


def cells(outcome: StressOutcome) -> list[str]:
    """The row of a case in the table with the columns `HEADINGS`."""
    row = csv_row(outcome)
    return [cell(row) for _, cell in HEADINGS.values()]


class StressView(View[StressOutcome]):
    """One row per case.

    Parameters
    ----------
    setting : Setting
    count : int
        Number of cases to be run.
    """

    verb = "stress"
    title = "Stress: stiff and extreme cases"
    columns = tuple(csv_row(StressOutcome(StressCase("", "", base_scene))))

    def __init__(self, setting: Setting, count: int) -> None:
        self._setting, self._count = setting, count

    def heading(self) -> str:
        return _aligned_cells(list(HEADINGS))

    def terminal_lines(self, outcome: StressOutcome) -> Iterable[Line]:
        if outcome.left_out:
            yield f"{outcome.case.name}: left out: {outcome.left_out}", "dim"
            return
        yield _aligned_cells(cells(outcome)), "" if outcome.passed else "bold red"
        for name, verdict in outcome.failures.items():
            yield f"    {name}: {verdict.message}", "red"

    def summary_table(self, outcomes: Sequence[StressOutcome]) -> list[Sequence[str]]:
        table: list[Sequence[str]] = [("family", "passed", "run time [s]")]
        run = [outcome for outcome in outcomes if not outcome.left_out]
        for family in dict.fromkeys(outcome.case.family for outcome in run):
            mine = [outcome for outcome in run if outcome.case.family == family]
            passed = f"{sum(outcome.passed for outcome in mine)} of {len(mine)}"
            table.append((family, passed, f"{sum(outcome.seconds for outcome in mine):.1f}"))
        return table

    def csv_rows(self, outcome: StressOutcome) -> Iterable[Mapping[str, Any]]:
        yield csv_row(outcome)

    def case_content(self, outcome: StressOutcome) -> dict[str, Any]:
        record = outcome.record
        return csv_row(outcome) | {
            "notes": record.notes,
            "newton_iterations": record.newton,
            "times": record.times,
            "energies": [record.start_energy, *record.energies],
        }

    def summary_content(self, outcomes: Sequence[StressOutcome]) -> dict[str, Any]:
        left_out = {outcome.case.name: outcome.left_out for outcome in outcomes if outcome.left_out}
        return {"complete": len(outcomes) == self._count, "left_out": left_out}

    def fill(self, report: Report, outcomes: Sequence[StressOutcome], summary: str, *, plots: bool) -> None:
        run = sorted((outcome for outcome in outcomes if not outcome.left_out), key=severity, reverse=True)
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
            f"{outcome.case.name} ({outcome.case.title}): {name}: {verdict.message}"
            for outcome in run
            for name, verdict in outcome.failures.items()
        ]
        if failed:
            report.heading("What failed")
            report.bullets(failed)
        report.heading("Notes of the runs")
        for outcome in run:
            report.bullets([f"{outcome.case.name}: {note}" for note in outcome.record.notes])
        report.heading("What was judged")
        judged = [
            [one.case.name, name, verdict.line] for one in run for name, verdict in one.verdicts.items()
        ]
        report.table(["case", "what", "verdict"], judged)
        left_out = [f"{one.case.name}: {one.left_out}" for one in outcomes if one.left_out]
        if left_out:
            report.heading("Left out")
            report.bullets(left_out)


def severity(outcome: StressOutcome) -> tuple[bool, bool, int, int]:
    """Sort key; larger is worse: failed, stopped early, rejected steps, largest number of iterations."""
    record = outcome.record
    return not outcome.passed, bool(record.stop_reason), record.rejected, max(record.newton, default=0)


def _aligned_cells(texts: Sequence[str]) -> str:
    widths = [max(len(name), minimum) for name, (minimum, _) in HEADINGS.items()]
    first, *others = zip(texts, widths, strict=True)
    return "  ".join([first[0].ljust(first[1]), *(text.rjust(width) for text, width in others)]).rstrip()
