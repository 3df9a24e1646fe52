"""Runs a case, takes the balance of every step, and judges."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.experiments import case as experiments
from lyra_petsc.experiments.bench import Trial, problem_of
from lyra_petsc.experiments.launch import Watch
from lyra_petsc.experiments.stress.balance import Accountant
from lyra_petsc.experiments.stress.case import Case, Level, NotHere, Setting
from lyra_petsc.experiments.stress.record import Record
from lyra_petsc.experiments.stress.stage import StageAccountant
from lyra_petsc.experiments.stress.verdicts import LITTLE_LOST, of_physics, speed

Array = NDArray[np.float64]

LONGEST = {Level.QUICK: 20.0, Level.USUAL: 60.0, Level.FULL: 600.0}
"""Wall seconds [s] after which a case is ended between two steps."""

BASE_STEPS = 20
"""Steps of the base scene that are timed: as many as most cases take, since later ones cost more."""


@dataclass
class Outcome(experiments.Outcome[Case]):
    """What came of a case.

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
        """In a word: what is solved need not be right, where the integrator takes much of the energy away."""
        if not self.passed:
            return "FAILED"
        return "right" if self.record.lost <= LITTLE_LOST else "solved"


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
    case: Case,
    setting: Setting,
    clock: BaseClock | None = None,
    watch: Watch | None = None,
) -> Outcome:
    """Run a case and judge it; collective, the same outcome on all ranks.

    Parameters
    ----------
    comm : MPI.Comm
    case : Case
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
    began = time.perf_counter()
    before = clock.latest if clock is not None else None
    outcome = Outcome(case, record=Record(case.steps))
    with setting.bench(comm, watch) as bench:
        try:
            content = case.content(setting, bench)
        except NotHere as why:
            outcome.left_out = str(why)
            return outcome
        record = outcome.record
        record.nominal, record.end = content["time"]["step"], content["time"]["end"]
        record.integrator = content["time"].get("integrator", "beuler")
        try:
            with bench.simulation(content) as trial:
                _run(trial, case, record, began + LONGEST[setting.level])
        except (InputError, SolverError) as error:
            record.stopped = problem_of(comm, error)
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


def _run(trial: Trial, case: Case, record: Record, deadline: float) -> None:
    """Step to the end, or to the deadline, and note everything."""
    simulation = trial.simulation
    comm = simulation.comm
    mesh = simulation.problem.mesh
    record.triangles = mesh.triangles if mesh is not None else None
    if case.shape is not None:
        shape = case.shape(trial.x, simulation.problem.outline.spacing)
        trial.set_state(x=shape)
        simulation.ledger.measure()
    record.start_energy = _energy(trial)
    if case.observe is not None:
        record.observed.append(case.observe(trial))
    accountant = None
    if record.integrator != "semi-implicit":  # which promises no balance
        kind = Accountant if record.integrator == "beuler" else StageAccountant
        accountant = kind(simulation)
    try:
        while not simulation.finished:
            if comm.bcast(time.perf_counter() > deadline, root=0):
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
