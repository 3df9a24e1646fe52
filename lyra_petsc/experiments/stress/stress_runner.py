"""Runs the cases of ``stress``, takes the balance of every step, judges, and reports."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.experiments.bench import Trial, failure_message
from lyra_petsc.experiments.case import Launcher, Outcome, Verdict, Watch
from lyra_petsc.experiments.results import Line, View
from lyra_petsc.experiments.stress.step_balance import (
    LITTLE_LOST,
    Accountant,
    Record,
    StageAccountant,
    of_physics,
    over,
    speed,
)
from lyra_petsc.experiments.stress.stress_scenes import (
    NotApplicable,
    Scope,
    Setting,
    StressCase,
    as_it_is,
)
from lyra_petsc.kernels.compilation import COMPILATION
from lyra_petsc.show.report.document import PLOTS, Report, seconds, short
from lyra_petsc.show.report.plots import Series, over_time, surface

LONGEST = {Scope.QUICK: 20.0, Scope.USUAL: 60.0, Scope.FULL: 600.0}
"""Wall seconds [s], but for those in which kernels are compiled, after which a case is ended between two
steps."""

BASE_STEPS = 20
"""Steps of the base scene that are timed: as many as most cases take, since later ones cost more."""


@dataclass
class SavedOutcome:
    """A `StressOutcome` without its case, as the process of a case returns it to the one that launched it."""

    verdicts: dict[str, Verdict]
    seconds: float
    left_out: str
    record: Record
    ratio: float
    busy_ratio: float


@dataclass
class StressOutcome(Outcome[StressCase]):
    """The result of a case.

    Attributes
    ----------
    record : Record
    ratio : float
        Median wall time of a step over that of the base scene, measured before and after the case.
    busy_ratio : float
        The same of CPU time.
    """

    record: Record = field(default_factory=Record)
    ratio: float = math.nan
    busy_ratio: float = math.nan

    @property
    def verdict(self) -> str:
        """In a word; ``solved`` instead of ``right`` where the integrator dissipates much of the energy."""
        if not self.passed:
            return "FAILED"
        return "right" if self.record.lost <= LITTLE_LOST else "solved"

    def saved(self) -> SavedOutcome:
        """All but the case, which cannot be stored in a file."""
        return SavedOutcome(**{name: value for name, value in vars(self).items() if name != "case"})


class BaseClock:
    """Wall time of a step of the base scene, measured again and again; collective.

    Parameters
    ----------
    comm : MPI.Comm
    setting : Setting
    watch : callable, optional
        Called before every step.

    Attributes
    ----------
    latest : (2,) array
        What was measured last [s].
    size : float
        Diagonal of the base scene's bounding box [m].
    """

    def __init__(self, comm: MPI.Comm, setting: Setting, watch: Watch | None = None) -> None:
        self._comm, self._setting, self._watch = comm, setting, watch
        self.size = math.nan
        self.measure()  # kernels are compiled or loaded
        self.latest = self.measure()

    def measure(self) -> Array:
        """Median wall time and CPU time [s] of the base scene's first steps, (2,).

        Raises
        ------
        InputError, SolverError
            If not even the base scene runs.
        """
        content = self._setting.content()
        content["time"] = {**content["time"], "end": BASE_STEPS * self._setting.step}
        seconds: list[tuple[float, float]] = []
        with self._setting.bench(self._comm, self._watch) as bench, bench.simulation(content) as trial:
            self.size = trial.simulation.problem.outline.size
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
        What wall times are compared with; without, they are not.
    watch : callable, optional
        Called before every step on all ranks; may raise to end the work.

    Raises
    ------
    SolverError
        What one rank alone met, so that the others cannot go on.
    """
    began, compiled = time.perf_counter(), COMPILATION.seconds
    before = clock.latest if clock is not None else None
    outcome = StressOutcome(case, record=Record(case.steps))
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
                _run(trial, case, record, began - compiled + LONGEST[setting.level])
        except (InputError, SolverError) as error:
            record.stopped = failure_message(comm, error)
        outcome.verdicts = of_physics(record)
        if clock is not None and before is not None:
            wall, busy = 0.5 * (before + clock.measure())
            ratios = record.median_seconds / wall, record.median_busy / busy
            outcome.ratio, outcome.busy_ratio = comm.bcast(tuple(map(float, ratios)), root=0)
            if case.swift:
                outcome.verdicts["speed"] = speed(record, outcome.ratio, outcome.busy_ratio)
        if case.judge is not None and not record.stopped:
            outcome.verdicts |= case.judge(setting, bench, record)
    outcome.seconds = comm.bcast(time.perf_counter() - began, root=0)
    return outcome


def _run(trial: Trial, case: StressCase, record: Record, deadline: float) -> None:
    """Step to the end, or until wall time [s] without that of compiling reaches the deadline, and note
    everything.
    """
    simulation = trial.simulation
    comm = simulation.comm
    mesh = simulation.problem.mesh
    record.triangles = mesh.triangles if mesh is not None else None
    if case.shape is not None:
        shape = case.shape(trial.x, simulation.problem.outline.spacing)
        trial.set_state(x=shape)
    record.start_energy = _energy(trial)
    if case.observe is not None:
        record.observed.append(case.observe(trial))
    accountant = None
    if record.integrator != "semi-implicit":  # which promises no balance
        kind = Accountant if record.integrator == "beuler" else StageAccountant
        accountant = kind(simulation)
    try:
        while not simulation.finished:
            if comm.bcast(time.perf_counter() - COMPILATION.seconds > deadline, root=0):
                record.stopped = (
                    f"given up at t = {simulation.time:g} s of {record.end:g} s: the case has had its time"
                )
                break
            busy = time.process_time()
            report = trial.step()
            record.busy.append(comm.allreduce(time.process_time() - busy, op=MPI.MAX))
            record.reports.append(report)
            record.energies.append(_energy(trial))
            if accountant is not None:
                record.balances.append(accountant.balance(report))
                accountant.look()
            if case.observe is not None:
                record.observed.append(case.observe(trial))
    except SolverError as error:
        if error.collective or comm.size == 1:
            record.last = _drawn(trial)
        raise
    finally:
        record.notes = list(simulation.notes)
        record.balance = simulation.guard.content() if simulation.guard is not None else {}
    # gathered to be drawn: once in a case, and freed by later cases
    record.last = _drawn(trial)


def _drawn(trial: Trial) -> Array | None:
    """Positions (V, 3) [m] on rank 0."""
    x = trial.x
    return x if trial.simulation.comm.rank == 0 else None


def _energy(trial: Trial) -> float:
    """Kinetic + potential [J]."""
    budget = trial.simulation.budget
    return budget.kinetic + budget.membrane + budget.bending + budget.potential


def launched(launcher: Launcher, case: StressCase, asked: Sequence[str], watch: Watch) -> StressOutcome:
    """The result of a case that is run in processes of its own.

    Parameters
    ----------
    launcher : Launcher
    case : StressCase
    asked : sequence of str
        Scene and options of ``stress`` that say what is run.
    watch : callable
        Called again and again; where it raises, the processes are ended.

    Raises
    ------
    InputError
        If the launched program refuses what it was asked for.
    """
    saved, message = launcher.run_case([*asked, "--only", case.name], watch, SavedOutcome)
    if saved is not None:
        return StressOutcome(case, **vars(saved))
    record = Record(case.steps, stopped=message)
    return StressOutcome(case, of_physics(record), record=record)


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
        "failures": "; ".join(f"{name}: {verdict.message}" for name, verdict in outcome.failures.items()),
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

    def terminal_lines(self, outcome: StressOutcome) -> Iterable[Line]:
        if outcome.left_out:
            yield f"{outcome.case.name}: left out: {outcome.left_out}", "dim"
            return
        yield _padded(cells(outcome)), "" if outcome.passed else "bold red"
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

    def case_ended(self, outcomes: Sequence[StressOutcome]) -> None:
        """Free the shapes that the page will not show, since there are worse cases."""
        for outcome in sorted(outcomes, key=badness, reverse=True)[PICTURES:]:
            outcome.record.last = outcome.record.triangles = None

    def csv_rows(self, outcome: StressOutcome) -> Iterable[Mapping[str, Any]]:
        yield row_of(outcome)

    def case_content(self, outcome: StressOutcome) -> dict[str, Any]:
        record = outcome.record
        return row_of(outcome) | {
            "notes": record.notes,
            "newton_iterations": record.newton,
            "times": record.times,
            "energies": [record.start_energy, *record.energies],
        }

    def summary_content(self, outcomes: Sequence[StressOutcome]) -> dict[str, Any]:
        left_out = {outcome.case.name: outcome.left_out for outcome in outcomes if outcome.left_out}
        return {"complete": len(outcomes) == self._count, "left_out": left_out}

    def fill(self, report: Report, outcomes: Sequence[StressOutcome], summary: str, *, plots: bool) -> None:
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
            f"{outcome.case.name} ({outcome.case.title}): {name}: {verdict.message}"
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
            if plots:
                _figures(report, outcome)
        report.heading("What was judged")
        report.table(
            ["case", "what", "verdict"],
            [
                [outcome.case.name, name, verdict.line]
                for outcome in run
                for name, verdict in outcome.verdicts.items()
            ],
        )
        left_out = [f"{one.case.name}: {one.left_out}" for one in outcomes if one.left_out]
        if left_out:
            report.heading("Left out")
            report.bullets(left_out)


def badness(outcome: StressOutcome) -> tuple[bool, bool, int, int]:
    """Cases that failed first, then those with the most trouble."""
    record = outcome.record
    return not outcome.passed, bool(record.stopped), record.rejected, max(record.newton, default=0)


def _padded(texts: Sequence[str]) -> str:
    widths = [max(len(name), least) for name, least in HEADINGS.items()]
    first, *others = zip(texts, widths, strict=True)
    return "  ".join([first[0].ljust(first[1]), *(text.rjust(width) for text, width in others)]).rstrip()


def _figures(report: Report, outcome: StressOutcome) -> None:
    """The last shape, and the energy over time beside the work done."""
    case, record = outcome.case, outcome.record
    if record.last is not None and record.triangles is not None:
        when = f"t = {seconds(record.times[-1])}" if record.times else "the start"
        words, name = f"{case.name}: {case.title}, {when}", f"{PLOTS}/{case.name}-shape"
        report.figure(surface(record.last, record.triangles, name=name, caption=words))
    if len(record.times) > 1:
        times = [0.0, *record.times]
        curves = [Series("kinetic + potential", times, [record.start_energy, *record.energies])]
        if record.balances and record.integrator == "beuler":
            work = itertools.accumulate((one.work for one in record.balances), initial=record.start_energy)
            curves.append(Series("energy at the start + work done", times, list(work)))
        words, name = f"{case.name}: energy over time", f"{PLOTS}/{case.name}-energy"
        report.figure(over_time(curves, name=name, caption=words, y_label="energy [J]"))
