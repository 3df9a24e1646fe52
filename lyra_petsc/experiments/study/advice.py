"""What to choose for an accuracy, in plain words and from what ran alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lyra_petsc.experiments.study.analysis import Row, families, shared_label
from lyra_petsc.experiments.study.axes import Axis
from lyra_petsc.show.report.numbers import percent, seconds

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
    row : Row or None
        The fastest that keeps it; None if none does.
    words : str
    """

    target: float
    row: Row | None
    words: str


def advise(rows: Sequence[Row], quantity: str, axis: Axis | None = None) -> list[Advice]:
    """The fastest setting for each accuracy, among what ran; nothing is extrapolated.

    Parameters
    ----------
    rows : sequence of Row
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
    coarsest: list[Row] = []
    if axis is not None:
        coarsest = [group[0] for group in families(able, axis).values()]
    return [_advice(able, quantity, float(f"{target:.3g}"), coarsest) for target in targets]


def _advice(rows: Sequence[Row], quantity: str, target: float, coarsest: Sequence[Row]) -> Advice:
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


def _beside(line: str, rows: Sequence[Row], quantity: str, target: float) -> str:
    good = [row for row in rows if row.at_most(quantity) <= target]
    if good:
        row = min(good, key=lambda row: row.run)
        return f"{line} needs {seconds(row.run)} ({_without_line(row)})"
    best = min(rows, key=lambda row: row.at_most(quantity))
    return f"{line} did not reach it ({_without_line(best)}: {_error(best, quantity)}, {seconds(best.run)})"


def setting(row: Row) -> str:
    """All settings of a row, in words, with the integrator first."""
    return shared_label(row, None) or row.combination.label


def _without_line(row: Row) -> str:
    return setting(row).removeprefix(row.line).removeprefix(", ") or row.line


def _error(row: Row, quantity: str) -> str:
    if quantity in row.unresolved:
        words = f"error below {percent(row.at_most(quantity))}"
    else:
        words = f"error {percent(row.errors[quantity])}"
    largest = row.at_most("position_max")
    if quantity == "position_l2" and math.isfinite(largest):
        words += f", at most {percent(largest)} anywhere"
    return words


def choose_recommended(advice: Sequence[Advice]) -> Row | None:
    """Mark the setting that the diagram's star names: the fastest for 1 %; none if no setting keeps that."""
    for one in advice:
        if one.row is not None and math.isclose(one.target, DEFAULT_TARGET):
            one.row.recommended = True
            return one.row
    return None
