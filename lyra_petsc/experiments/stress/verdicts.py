"""The steps of a case of ``stress``, and whether they are right."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.stress.step_balance import StepBalance
from lyra_petsc.show.report.document import short
from lyra_petsc.stepping.energy_guard import LARGEST_SUM
from lyra_petsc.stepping.simulation import StepReport
from lyra_petsc.terms.stretch import SOFTENS_BELOW


def median(values: Sequence[float]) -> float:
    """The median; NaN of no values."""
    return float(statistics.median(values)) if values else math.nan


@dataclass
class RunRecord:
    """All steps of a case, the same on every rank.

    Attributes
    ----------
    planned : int
        Number of steps at the nominal Δt.
    nominal : float
        Nominal Δt [s].
    end : float
        End time [s].
    start_energy : float
        Kinetic + potential energy at the start [J].
    reports : list of StepReport
        One per accepted step.
    balances : list of StepBalance
        One per accepted step; empty for the semi-implicit method, which has no such balance.
    energies : list of float
        Kinetic + potential energy after each step [J].
    observed : list
        Results of the ``observe`` function of the case, at the start and after each step.
    notes : list of str
        Notes of the simulation.
    stop_reason : str
        Why the case did not reach its end; empty if it did.
    integrator : str
    balance : dict
        Energy balance of the whole run, as in summary.json; empty if nothing ran.
    cpu_seconds : list of float
        CPU time of each step [s], the maximum over ranks.
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
    stop_reason: str = ""
    integrator: str = "beuler"
    balance: dict[str, Any] = field(default_factory=dict)
    cpu_seconds: list[float] = field(default_factory=list)

    @property
    def newton(self) -> list[int]:
        """Newton iterations of each step, including its rejected attempts."""
        return [report.newton_iterations for report in self.reports]

    @property
    def linear(self) -> int:
        """Linear iterations of all steps."""
        return sum(report.linear_iterations for report in self.reports)

    @property
    def rejected(self) -> int:
        """Number of attempts at steps that failed or were too inaccurate."""
        return sum(report.rejected for report in self.reports)

    @property
    def smallest_step(self) -> float:
        """Smallest Δt [s] of an accepted step; NaN without any."""
        return min((report.dt for report in self.reports), default=math.nan)

    @property
    def stretches(self) -> tuple[float, float]:
        """Smallest and largest principal stretch of all steps; NaN without a step."""
        if not self.reports:
            return math.nan, math.nan
        return (
            min(report.smallest_stretch for report in self.reports),
            max(report.largest_stretch for report in self.reports),
        )

    @property
    def median_seconds(self) -> float:
        """Median wall time of a step [s]; NaN without any."""
        return median([report.wall_seconds for report in self.reports])

    @property
    def dissipation(self) -> float:
        """Numerical dissipation over the largest energy exchanged; NaN without a step."""
        return float(self.balance.get("numerical_dissipation", math.nan)) if self.reports else math.nan

    @property
    def times(self) -> list[float]:
        """Times [s] at the ends of steps."""
        return [report.time for report in self.reports]


SMALL_DISSIPATION = 0.05
"""Numerical dissipation over the largest energy exchanged up to which a motion is called right."""


def judge_convergence(record: RunRecord) -> Verdict:
    """Whether every step was solved and the end was reached."""
    if record.stop_reason:
        return Verdict(False, f"{len(record.reports)} steps, then: {record.stop_reason}")
    text = f"all {len(record.reports)} steps"
    if record.rejected:
        smallest = short(record.smallest_step)
        text += (
            f", {record.rejected} attempts rejected, smallest Δt {smallest} s of {short(record.nominal)} s"
        )
    return Verdict(bool(record.reports), text)


def judge_equations(record: RunRecord) -> Verdict:
    """Whether the residual, computed again, is as small as the solver promised in every step."""
    number, worst = _worst_step(record, lambda b: ratio(b.residual, b.promised + b.floor))
    at_floor = sum(balance.promised <= balance.floor for balance in record.balances)
    text = (
        f"worst in step {number}: {short(worst.residual)} N left on the free vertices, "
        f"{short(worst.promised)} N promised"
    )
    if at_floor:
        text += f"; in {at_floor} steps that is the floor of round-off"
    return Verdict(worst.residual <= worst.promised + worst.floor, text)


def judge_resolution(record: RunRecord) -> Verdict:
    """Whether the residual is far below the driving forces, or the displacement that it causes is small.

    At the round-off floor the residual of stiff forces may be as large as the weight without any effect.
    """
    # part of the driving forces below which a residual is negligible; the same for the displacements by both
    negligible = 0.1
    steps = zip(record.balances, record.reports, strict=True)
    by_force = [ratio(balance.residual, negligible * balance.driving) for balance in record.balances]
    by_displacement = [
        ratio(report.remaining, negligible * balance.displacement) for balance, report in steps
    ]
    number = max(range(len(by_force)), key=lambda i: min(by_force[i], by_displacement[i]))
    worst, last = record.balances[number], record.reports[number].remaining
    text = (
        f"worst in step {number + 1}: {short(worst.residual)} N left, {short(worst.driving)} N move the sheet"
    )
    if worst.promised <= worst.floor:
        text += "; round-off at this stiffness allows no better"
    if by_displacement[number] < by_force[number]:
        text += (
            f"; they still move it by {short(last)} m, and the step's forces by {short(worst.displacement)} m"
        )
    return Verdict(min(by_force[number], by_displacement[number]) <= 1.0, text)


def judge_energy(record: RunRecord) -> Verdict:
    """Whether the energy identity of backward Euler holds in every step within its tolerance.

    For other integrators: whether the work of elastic forces equals the change of their energy.
    """
    number, worst = _worst_step(record, lambda b: ratio(abs(b.defect), b.tolerance))
    text = (
        f"worst in step {number}: off by {short(abs(worst.defect))} J, tolerance {short(worst.tolerance)} J, "
        f"{short(worst.turned_over)} J turned over"
    )
    jumped = sum(balance.jumped for balance in record.balances)
    if jumped:
        text += (
            f"; in {jumped} steps hinges turned too far or jumped, or contact came from too far, and "
            "count by their energies"
        )
    return Verdict(abs(worst.defect) <= worst.tolerance, text)


def judge_gain(record: RunRecord) -> Verdict:
    """Whether the energy grows by no more than the work where the bracket of the identity is not positive."""
    steps = [
        (number, balance)
        for number, balance in enumerate(record.balances, 1)
        if not balance.account.bracket > balance.tolerance
    ]
    with_gain = len(record.balances) - len(steps)
    about_gain = f"; in {with_gain} steps buckling could feed energy in" if with_gain else ""
    if not steps:
        return Verdict(True, f"not to be judged{about_gain}")
    number, worst = max(steps, key=lambda step: ratio(_gain(step[1]), step[1].tolerance))
    gain = _gain(worst)
    if gain > worst.tolerance:
        text = f"step {number} gained {short(gain)} J beyond the work, tolerance {short(worst.tolerance)} J"
        return Verdict(False, text + about_gain)
    negative = [n for n, b in enumerate(record.balances, 1) if -b.account.damping_heat > b.tolerance]
    if negative:
        return Verdict(False, f"damping fed energy into step {negative[0]}{about_gain}")
    return Verdict(True, f"none in the {len(steps)} steps where the elastic energy is convex{about_gain}")


def judge_run(record: RunRecord) -> Verdict:
    """Whether the whole run gains no energy and, if semi-implicit, does not lose most of it."""
    gained, dissipation = float(record.balance["numerical_gain"]), record.dissipation
    net = gained - dissipation
    text = (
        f"{100.0 * dissipation:.2g} % of the largest energy at work lost to the integrator, "
        f"{100.0 * gained:.2g} % made by it"
    )
    if record.balance["repeated"]:
        text += f", {record.balance['repeated']} attempts repeated for it"
    # the same ratio beyond which a run fails if its steps have no other balance (semi-implicit)
    good = net <= LARGEST_SUM and (record.integrator != "semi-implicit" or dissipation <= 0.5)
    if good and dissipation > SMALL_DISSIPATION:
        text += "; solved, but a smaller Δt moves otherwise"
    return Verdict(good, text)


def judge_momentum(record: RunRecord) -> Verdict:
    """Whether linear and angular momentum change by external forces only: internal forces sum to zero."""
    at, line = _worst_step(record, lambda b: ratio(b.momentum, b.momentum_tolerance))
    turn_step, turn = _worst_step(record, lambda b: ratio(b.angular, b.angular_tolerance))
    text = f"worst in step {at}: {short(line.momentum)} N s, tolerance {short(line.momentum_tolerance)} N s"
    if turn.angular_tolerance:
        text += (
            f"; angular in step {turn_step}: {short(turn.angular)} N m s, "
            f"tolerance {short(turn.angular_tolerance)} N m s"
        )
    good = line.momentum <= line.momentum_tolerance and turn.angular <= turn.angular_tolerance
    return Verdict(good, text)


def judge_softening(record: RunRecord) -> Verdict:
    """Whether a triangle that is compressed into the softening range of its model was reported."""
    smallest = record.stretches[0]
    if not smallest < SOFTENS_BELOW:
        return Verdict(True, f"no triangle below {SOFTENS_BELOW:.3f} of its length")
    notes = [note for note in record.notes if "St. Venant-Kirchhoff model softens" in note]
    text = f"down to {short(smallest)} of its length, " + (
        "which is said" if notes else "and NOTHING was said"
    )
    return Verdict(bool(notes), text)


def judge_speed(record: RunRecord, wall_ratio: float, cpu_ratio: float) -> Verdict:
    """Whether steps take few iterations, and a time comparable to that of the base scene.

    ``wall_ratio`` and ``cpu_ratio`` are ratios of median wall and CPU times; one of them suffices, as wall
    times mean little on a machine with other load.
    """
    # allowed Newton iterations per step of a stiff sheet, median and maximum
    newton_median, newton_max = 10, 30
    # allowed median time per step of a stiff sheet over that of the base scene
    max_ratio = 5.0
    typical, worst = median(record.newton), max(record.newton, default=0)
    good = typical <= newton_median and worst <= newton_max and min(wall_ratio, cpu_ratio) <= max_ratio
    text = (
        f"Newton iterations {short(typical)} in the median and {worst} at worst "
        f"({newton_median} and {newton_max} allowed), {short(wall_ratio)} times the base's wall time, "
        f"{short(cpu_ratio)} times its CPU time ({max_ratio:g} allowed)"
    )
    return Verdict(good and not record.stop_reason, text)


def judge_physics(record: RunRecord) -> dict[str, Verdict]:
    """All verdicts that apply to any case, by name."""
    verdicts = {"converged": judge_convergence(record)}
    if record.balances:
        verdicts |= {
            "equations": judge_equations(record),
            "resolved": judge_resolution(record),
            "energy": judge_energy(record),
            "momentum": judge_momentum(record),
        }
        if record.integrator == "beuler":
            verdicts["no gain"] = judge_gain(record)
    if record.reports:
        verdicts["softening"] = judge_softening(record)
        if record.balance:
            verdicts["whole run"] = judge_run(record)
    return verdicts


def _gain(balance: StepBalance) -> float:
    return balance.account.change - balance.account.external


def ratio(amount: float, tolerance: float) -> float:
    """The amount over its tolerance; infinite if one of them is NaN."""
    if math.isnan(amount) or math.isnan(tolerance):
        return math.inf
    return amount / tolerance if tolerance > 0.0 else math.copysign(math.inf, amount) if amount else 0.0


def _worst_step(record: RunRecord, measure: Callable[[StepBalance], float]) -> tuple[int, StepBalance]:
    """Number, counted from 1, and balance of the step with the largest ``measure``."""
    number = max(range(len(record.balances)), key=lambda i: measure(record.balances[i]))
    return number + 1, record.balances[number]
