"""The rows of a study: errors that can be told, observed orders, the Pareto front.

What to choose for an accuracy, in plain words and from what ran alone.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

from lyra_petsc.experiments.study.combinations import Axis, Combination, described
from lyra_petsc.experiments.study.jobs import Result
from lyra_petsc.experiments.study.references import SAFETY
from lyra_petsc.show.report.numbers import percent, seconds
from lyra_petsc.show.report.plots import fitted_slope


@dataclass
class StudyRow:
    """A combination with what came of it.

    Attributes
    ----------
    combination : Combination
    result : Result
    errors : dict of str to float
        By quantity; NaN where nothing can be told.
    own : dict of str to float
        The reference's own error, NaN where it is unknown.
    unresolved : set of str
        Quantities whose error cannot be told from the reference's.
    orders : dict of (axis key, quantity) to float
        Observed, from the next coarser row that differs in that axis alone.
    on_front, recommended : bool
    """

    combination: Combination
    result: Result
    errors: dict[str, float] = field(default_factory=dict)
    own: dict[str, float] = field(default_factory=dict)
    unresolved: set[str] = field(default_factory=set)
    orders: dict[tuple[str, str], float] = field(default_factory=dict)
    on_front: bool = False
    recommended: bool = False

    @property
    def run(self) -> float:
        """Median wall time [s] of the steps alone; NaN for a failed row."""
        return statistics.median(self.result.run_seconds()) if self.result.timings else math.nan

    @property
    def total(self) -> float:
        """Median wall time [s] with set-up."""
        return statistics.median(self.result.total_seconds()) if self.result.timings else math.nan

    def shown(self, quantity: str) -> float:
        """The error as a number, NaN where it is not resolved."""
        return math.nan if quantity in self.unresolved else self.errors.get(quantity, math.nan)

    def at_most(self, quantity: str) -> float:
        """What the true error is at most, with the reference's own error; NaN where nothing is known."""
        own = self.own.get(quantity, 0.0)
        own = 0.0 if math.isnan(own) else own
        if quantity in self.unresolved:
            return (SAFETY + 1.0) * own
        return self.errors.get(quantity, math.nan) + own

    @property
    def line(self) -> str:
        """What its line in a diagram is called: its integrator."""
        return self.result.integrator or str(self.combination.settings.get("integrator", ""))


def mark_unresolved(row: StudyRow) -> None:
    """Note the quantities whose error is below the reference's own, with a margin."""
    for name, error in row.errors.items():
        own = row.own.get(name, 0.0)
        if not math.isnan(error) and not math.isnan(own) and own > 0.0 and error < SAFETY * own:
            row.unresolved.add(name)


def extent(row: StudyRow, axis: Axis) -> float:
    """The length, time or tolerance that shrinks along a numeric axis: as it really was."""
    if axis.path == "mesh":
        return row.result.spacing
    if axis.path == "time.step" and row.result.mean_step > 0.0:
        return row.result.mean_step
    value = row.combination.settings[axis.key]
    return float(value) if isinstance(value, float) else math.nan


def families(rows: Sequence[StudyRow], axis: Axis | None) -> dict[str, list[StudyRow]]:
    """Rows that ran and differ in one axis alone, coarsest first; by what they share, in words."""
    found: dict[str, list[StudyRow]] = {}
    for row in rows:
        if row.result.done:
            found.setdefault(shared_label(row, axis), []).append(row)
    if axis is not None:
        for group in found.values():
            group.sort(key=lambda row: -extent(row, axis))
    return found


def shared_label(row: StudyRow, axis: Axis | None) -> str:
    """The settings of a row but for one axis, in words, with the integrator first."""
    words = [row.line] if row.line else []
    for other, value in zip(row.combination.axes, row.combination.values, strict=True):
        if other is not axis and other.path != "time.integrator":
            words.append(described(other.key, value))
    return ", ".join(words)


@dataclass(frozen=True)
class Order:
    """Observed order of convergence of one family of rows.

    Attributes
    ----------
    axis, quantity, family : str
    fitted : float
        Least-squares slope over all resolved rows.
    neighbours : tuple of float
        Between neighbours, coarsest first.
    """

    axis: str
    quantity: str
    family: str
    fitted: float
    neighbours: tuple[float, ...]


def observed_orders(rows: Sequence[StudyRow], axes: Sequence[Axis], quantities: Sequence[str]) -> list[Order]:
    """Orders along every numeric axis; also noted in the rows."""
    found = []
    for axis in (axis for axis in axes if axis.refines):
        for label, group in families(rows, axis).items():
            for name in quantities:
                told = [row for row in group if row.shown(name) > 0.0]
                for coarse, fine in itertools.pairwise(told):
                    a, b = extent(coarse, axis), extent(fine, axis)
                    if a > b > 0.0:
                        order = math.log(coarse.shown(name) / fine.shown(name)) / math.log(a / b)
                        fine.orders[axis.key, name] = order
                if len(told) >= 2:
                    slope = fitted_slope([extent(r, axis) for r in told], [r.shown(name) for r in told])
                    between = tuple(r.orders.get((axis.key, name), math.nan) for r in told[1:])
                    found.append(Order(axis.key, name, label, slope, between))
    return found


def mark_front(rows: Sequence[StudyRow], quantity: str) -> None:
    """Mark the rows that no other beats in both run time and error."""
    able = [row for row in rows if row.result.done and not math.isnan(row.at_most(quantity))]
    for row in able:
        error = row.at_most(quantity)
        row.on_front = not any(
            other is not row
            and other.run <= row.run
            and other.at_most(quantity) <= error
            and (other.run < row.run or other.at_most(quantity) < error)
            for other in able
        )


TARGETS = (0.1, 0.01, 0.001)
DEFAULT_TARGET = 0.01
"""The accuracy that the diagram's recommended setting is for."""

FINEST_TARGET = 1e-6


@dataclass(frozen=True)
class Advice:
    """What to choose for an accuracy.

    Attributes
    ----------
    target : float
    row : StudyRow or None
        The fastest that keeps it; None if none does.
    words : str
    """

    target: float
    row: StudyRow | None
    words: str


def advise(rows: Sequence[StudyRow], quantity: str, axis: Axis | None = None) -> list[Advice]:
    """The fastest setting for each accuracy, among what ran; nothing is extrapolated.

    Parameters
    ----------
    rows : sequence of StudyRow
    quantity : str
    axis : Axis, optional
        Along it a winner may be the coarsest that ran, which the words then say.
    """
    able = [row for row in rows if row.result.done and not math.isnan(row.at_most(quantity))]
    if not able:
        return []
    best = min(row.at_most(quantity) for row in able)
    targets = list(TARGETS)
    while targets[-1] > FINEST_TARGET and best <= targets[-1] / 10.0:
        targets.append(targets[-1] / 10.0)
    coarsest: list[StudyRow] = []
    if axis is not None:
        coarsest = [group[0] for group in families(able, axis).values()]
    return [_advice(able, quantity, float(f"{target:.3g}"), coarsest) for target in targets]


def _advice(rows: Sequence[StudyRow], quantity: str, target: float, coarsest: Sequence[StudyRow]) -> Advice:
    good = [row for row in rows if row.at_most(quantity) <= target]
    if not good:
        best = min(rows, key=lambda row: row.at_most(quantity))
        return Advice(
            target,
            None,
            f"For {percent(target)} nothing that ran is accurate enough; the most accurate is "
            f"{setting(best)}, {_error(best, quantity)}, in {seconds(best.run)}.",
        )
    winner = min(good, key=lambda row: row.run)
    tried = ", the coarsest that ran" if any(row is winner for row in coarsest) else ""
    words = f"For {percent(target)} choose {setting(winner)}: {seconds(winner.run)}"
    words += f" ({_error(winner, quantity)}{tried})"
    high = max(winner.result.run_seconds())
    ties = [
        row
        for row in good
        if row is not winner and row.line == winner.line and min(row.result.run_seconds()) <= high
    ]
    if ties:
        words += (
            f", or as fast within the spread, {setting(min(ties, key=lambda row: row.at_most(quantity)))}"
        )
    for line in dict.fromkeys(row.line for row in rows):
        if line != winner.line:
            words += "; " + _beside(line, [row for row in rows if row.line == line], quantity, target)
    return Advice(target, winner, words + ".")


def _beside(line: str, rows: Sequence[StudyRow], quantity: str, target: float) -> str:
    good = [row for row in rows if row.at_most(quantity) <= target]
    if good:
        row = min(good, key=lambda row: row.run)
        return f"{line} needs {seconds(row.run)} ({_without_line(row)})"
    best = min(rows, key=lambda row: row.at_most(quantity))
    return f"{line} did not reach it ({_without_line(best)}: {_error(best, quantity)}, {seconds(best.run)})"


def setting(row: StudyRow) -> str:
    """All settings of a row, in words, with the integrator first."""
    return shared_label(row, None) or row.combination.label


def _without_line(row: StudyRow) -> str:
    return setting(row).removeprefix(row.line).removeprefix(", ") or row.line


def _error(row: StudyRow, quantity: str) -> str:
    if quantity in row.unresolved:
        words = f"error below {percent(row.at_most(quantity))}"
    else:
        words = f"error {percent(row.errors[quantity])}"
    largest = row.at_most("position_max")
    if quantity == "position_l2" and math.isfinite(largest):
        words += f", at most {percent(largest)} anywhere"
    return words


def choose_recommended(advice: Sequence[Advice]) -> StudyRow | None:
    """Mark the setting that the diagram's star names: the fastest for 1 %; none if no setting keeps that."""
    for one in advice:
        if one.row is not None and math.isclose(one.target, DEFAULT_TARGET):
            one.row.recommended = True
            return one.row
    return None
