"""The rows of a study: errors that can be told, observed orders, the Pareto front."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

from lyra_petsc.experiments.study.axes import Axis
from lyra_petsc.experiments.study.case import Result
from lyra_petsc.experiments.study.combination import Combination, described
from lyra_petsc.experiments.study.refine import SAFETY
from lyra_petsc.show.report.plots import fitted_slope


@dataclass
class Row:
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


def mark_unresolved(row: Row) -> None:
    """Note the quantities whose error is below the reference's own, with a margin."""
    for name, error in row.errors.items():
        own = row.own.get(name, 0.0)
        if not math.isnan(error) and not math.isnan(own) and own > 0.0 and error < SAFETY * own:
            row.unresolved.add(name)


def extent(row: Row, axis: Axis) -> float:
    """The length, time or tolerance that shrinks along a numeric axis: as it really was."""
    if axis.path == "mesh":
        return row.result.spacing
    if axis.path == "time.step" and row.result.mean_step > 0.0:
        return row.result.mean_step
    value = row.combination.settings[axis.key]
    return float(value) if isinstance(value, float) else math.nan


def families(rows: Sequence[Row], axis: Axis | None) -> dict[str, list[Row]]:
    """Rows that ran and differ in one axis alone, coarsest first; by what they share, in words."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        if row.result.done:
            found.setdefault(shared_label(row, axis), []).append(row)
    if axis is not None:
        for group in found.values():
            group.sort(key=lambda row: -extent(row, axis))
    return found


def shared_label(row: Row, axis: Axis | None) -> str:
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


def observed_orders(rows: Sequence[Row], axes: Sequence[Axis], quantities: Sequence[str]) -> list[Order]:
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


def mark_front(rows: Sequence[Row], quantity: str) -> None:
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
