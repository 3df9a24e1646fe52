"""What was seen while a case ran.

What physics says of a record: pure functions, the same on every rank.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.stress.step_balance import StepBalance
from lyra_petsc.show.report.numbers import short
from lyra_petsc.stepping.energy_guard import LARGEST_SUM
from lyra_petsc.stepping.simulation import StepReport
from lyra_petsc.terms.stretch import SOFTENS_BELOW


@dataclass
class Record:
    """A case's steps, the same on every rank.

    Attributes
    ----------
    planned : int
        Steps at the nominal Δt.
    nominal : float
        That Δt [s].
    end : float
        Time [s] to reach.
    start_energy : float
        Kinetic + potential at the start [J].
    reports : list of StepReport
        One for each accepted step.
    balances : list of StepBalance
        One for each; empty for the semi-implicit method, which solves no step.
    energies : list of float
        Kinetic + potential after each [J].
    observed : list
        What the case observes, from the start on.
    notes : list of str
        Of the simulation.
    stopped : str
        Why it did not reach its end; empty if it did.
    integrator : str
    balance : dict
        The whole run's energy balance, as in summary.json; empty where nothing ran.
    busy : list of float
        CPU time of each step [s], of the rank that took most.
    last : (V, 3) array or None
        Positions [m] after the last step, on rank 0; None if none were gathered, or they are freed.
    triangles : (F, 3) array or None
        On rank 0.
    """

    planned: int = 0
    nominal: float = math.nan
    end: float = math.nan
    start_energy: float = math.nan
    reports: list[StepReport] = field(default_factory=list)
    balances: list[StepBalance] = field(default_factory=list)
    energies: list[float] = field(default_factory=list)
    observed: list[Any] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    stopped: str = ""
    integrator: str = "beuler"
    balance: dict[str, Any] = field(default_factory=dict)
    busy: list[float] = field(default_factory=list)
    last: NDArray[np.float64] | None = None
    triangles: NDArray[np.int64] | None = None

    @property
    def newton(self) -> list[int]:
        """Newton iterations of each step, those of its rejected attempts included."""
        return [report.newton_iterations for report in self.reports]

    @property
    def linear(self) -> int:
        """Linear iterations of all steps."""
        return sum(report.linear_iterations for report in self.reports)

    @property
    def rejected(self) -> int:
        """Attempts that failed, or were too inaccurate."""
        return sum(report.rejected for report in self.reports)

    @property
    def smallest_step(self) -> float:
        """Smallest Δt [s] of an accepted step; NaN without any."""
        return min((report.dt for report in self.reports), default=math.nan)

    @property
    def stretches(self) -> tuple[float, float]:
        """Smallest and largest principal stretch met; NaN without a step."""
        if not self.reports:
            return math.nan, math.nan
        return (
            min(report.smallest_stretch for report in self.reports),
            max(report.largest_stretch for report in self.reports),
        )

    @property
    def median_seconds(self) -> float:
        """Median wall time of a step; NaN without any."""
        return statistics.median(r.wall_seconds for r in self.reports) if self.reports else math.nan

    @property
    def median_busy(self) -> float:
        """Median CPU time of a step; NaN without any."""
        return statistics.median(self.busy) if self.busy else math.nan

    @property
    def median_newton(self) -> float:
        """Median Newton iterations of a step; NaN without any."""
        return float(statistics.median(self.newton)) if self.reports else math.nan

    @property
    def lost(self) -> float:
        """Numerical dissipation over the largest energy at work; NaN without a step."""
        return float(self.balance.get("numerical_dissipation", math.nan)) if self.reports else math.nan

    @property
    def times(self) -> list[float]:
        """Times [s] at which steps ended."""
        return [report.time for report in self.reports]


RESOLVED = 0.1
"""Part of the forces that move a sheet, or of how far they do, below which the rest is negligible."""

LITTLE_LOST = 0.05
"""Numerical dissipation over the largest energy at work up to which a motion may be called right."""

MUCH_LOST = 0.5
"""Beyond which one is wrong whose steps nothing else speaks for."""

MOST_NEWTON_MEDIAN, MOST_NEWTON = 10, 30
"""Newton iterations a step of a stiff sheet may take, in the median and at worst."""

MOST_TIME = 5.0
"""Wall time of a step of a stiff sheet over that of the base scene, medians."""


def converged(record: Record) -> Verdict:
    """Every step was solved, and the end reached."""
    if record.stopped:
        return Verdict(False, f"{len(record.reports)} steps, then: {record.stopped}")
    words = f"all {len(record.reports)} steps"
    if record.rejected:
        smallest = short(record.smallest_step)
        words += (
            f", {record.rejected} attempts rejected, smallest Δt {smallest} s of {short(record.nominal)} s"
        )
    return Verdict(bool(record.reports), words)


def solved(record: Record) -> Verdict:
    """The forces left, computed anew, are as small as the solver promised in every step."""
    number, worst = _worst(record, lambda b: over(b.residual, b.promised + b.floor))
    at_floor = sum(balance.promised <= balance.floor for balance in record.balances)
    words = (
        f"worst in step {number}: {short(worst.residual)} N left on the free vertices, "
        f"{short(worst.promised)} N promised"
    )
    if at_floor:
        words += f"; in {at_floor} steps that is the floor of round-off"
    return Verdict(worst.residual <= worst.promised + worst.floor, words)


def resolved(record: Record) -> Verdict:
    """The forces left are far below those that move the sheet, or what they still move is.

    At the floor of round-off stiff forces may be left that are as large as the weight, and move nothing.
    """
    steps = zip(record.balances, record.reports, strict=True)
    by_force = [over(balance.residual, RESOLVED * balance.driving) for balance in record.balances]
    by_way = [over(report.left, RESOLVED * balance.push) for balance, report in steps]
    number = max(range(len(by_force)), key=lambda i: min(by_force[i], by_way[i]))
    worst, last = record.balances[number], record.reports[number].left
    words = (
        f"worst in step {number + 1}: {short(worst.residual)} N left, {short(worst.driving)} N move the sheet"
    )
    if worst.promised <= worst.floor:
        words += "; round-off at this stiffness allows no better"
    if by_way[number] < by_force[number]:
        words += f"; they still move it by {short(last)} m, and the step's forces by {short(worst.push)} m"
    return Verdict(min(by_force[number], by_way[number]) <= 1.0, words)


def identity(record: Record) -> Verdict:
    """The energy identity of backward Euler holds in every step to what its residual allows.

    Of other integrators: the elastic forces along each step add up to the change of their energy.
    """
    number, worst = _worst(record, lambda b: over(abs(b.defect), b.tolerance))
    words = (
        f"worst in step {number}: off by {short(abs(worst.defect))} J, tolerance {short(worst.tolerance)} J, "
        f"{short(worst.moved)} J turned over"
    )
    jumped = sum(balance.jumped for balance in record.balances)
    if jumped:
        words += f"; in {jumped} steps hinges turned too far or jumped, and count by their energies"
    return Verdict(abs(worst.defect) <= worst.tolerance, words)


def no_gain(record: Record) -> Verdict:
    """Where the bracket of the identity is not positive, no more energy than the work put in."""
    steps = [
        (number, balance)
        for number, balance in enumerate(record.balances, 1)
        if not balance.bracket > balance.tolerance
    ]
    fed = len(record.balances) - len(steps)
    more = f"; in {fed} steps buckling could feed energy in" if fed else ""
    if not steps:
        return Verdict(True, f"not to be judged{more}")
    number, worst = max(steps, key=lambda step: over(_gain(step[1]), step[1].tolerance))
    gain = _gain(worst)
    if gain > worst.tolerance:
        words = f"step {number} gained {short(gain)} J beyond the work, tolerance {short(worst.tolerance)} J"
        return Verdict(False, words + more)
    negative = [n for n, b in enumerate(record.balances, 1) if -b.viscous > b.tolerance]
    if negative:
        return Verdict(False, f"damping fed energy into step {negative[0]}{more}")
    return Verdict(True, f"none in the {len(steps)} steps where the elastic energy is convex{more}")


def whole(record: Record) -> Verdict:
    """The run as a whole makes no energy, and where its steps are not solved, does not lose most of it."""
    gained, lost = (float(record.balance[f"numerical_{what}"]) for what in ("gain", "dissipation"))
    net = gained - lost
    words = (
        f"{100.0 * lost:.2g} % of the largest energy at work lost to the integrator, "
        f"{100.0 * gained:.2g} % made by it"
    )
    if record.balance["repeated"]:
        words += f", {record.balance['repeated']} attempts repeated for it"
    good = net <= LARGEST_SUM and (record.integrator != "semi-implicit" or lost <= MUCH_LOST)
    if good and lost > LITTLE_LOST:
        words += "; solved, but a smaller Δt moves otherwise"
    return Verdict(good, words)


def momentum(record: Record) -> Verdict:
    """Momentum and angular momentum change by what acts from outside: inner forces add up to nothing."""
    at, line = _worst(record, lambda b: over(b.momentum, b.momentum_tolerance))
    turn_at, turn = _worst(record, lambda b: over(b.spin, b.spin_tolerance))
    words = f"worst in step {at}: {short(line.momentum)} N s, tolerance {short(line.momentum_tolerance)} N s"
    if turn.spin_tolerance:
        words += (
            f"; angular in step {turn_at}: {short(turn.spin)} N m s, "
            f"tolerance {short(turn.spin_tolerance)} N m s"
        )
    good = line.momentum <= line.momentum_tolerance and turn.spin <= turn.spin_tolerance
    return Verdict(good, words)


def softening(record: Record) -> Verdict:
    """A triangle compressed beyond where the model softens was reported."""
    smallest = record.stretches[0]
    if not smallest < SOFTENS_BELOW:
        return Verdict(True, f"no triangle below {SOFTENS_BELOW:.3f} of its length")
    told = [note for note in record.notes if "St. Venant-Kirchhoff model softens" in note]
    words = f"down to {short(smallest)} of its length, " + (
        "which is said" if told else "and NOTHING was said"
    )
    return Verdict(bool(told), words)


def speed(record: Record, ratio: float, busy_ratio: float) -> Verdict:
    """Few iterations, and a time like that of the base scene.

    ``ratio`` of the medians of wall time, ``busy_ratio`` of CPU time: on a machine that others use, too,
    the former says little of what a step costs, and one that is good enough suffices.
    """
    median, worst = record.median_newton, max(record.newton, default=0)
    good = median <= MOST_NEWTON_MEDIAN and worst <= MOST_NEWTON and min(ratio, busy_ratio) <= MOST_TIME
    words = (
        f"Newton iterations {short(median)} in the median and {worst} at worst "
        f"({MOST_NEWTON_MEDIAN} and {MOST_NEWTON} allowed), {short(ratio)} times the base's wall time, "
        f"{short(busy_ratio)} times its CPU time ({MOST_TIME:g} allowed)"
    )
    return Verdict(good and not record.stopped, words)


def of_physics(record: Record) -> dict[str, Verdict]:
    """All verdicts that need no knowledge of the case, by name."""
    verdicts = {"converged": converged(record)}
    if record.balances:
        verdicts |= {
            "equations": solved(record),
            "resolved": resolved(record),
            "energy": identity(record),
            "momentum": momentum(record),
        }
        if record.integrator == "beuler":
            verdicts["no gain"] = no_gain(record)
    if record.reports:
        verdicts["softening"] = softening(record)
        if record.balance:
            verdicts["whole run"] = whole(record)
    return verdicts


def _gain(balance: StepBalance) -> float:
    return balance.change - balance.work


def over(amount: float, tolerance: float) -> float:
    """How many times the tolerance; what is no number is worst."""
    if math.isnan(amount) or math.isnan(tolerance):
        return math.inf
    return amount / tolerance if tolerance > 0.0 else math.copysign(math.inf, amount) if amount else 0.0


def _worst(record: Record, measure: Callable[[StepBalance], float]) -> tuple[int, StepBalance]:
    """Number, from 1, and balance of the step for which ``measure`` is largest."""
    number = max(range(len(record.balances)), key=lambda i: measure(record.balances[i]))
    return number + 1, record.balances[number]
