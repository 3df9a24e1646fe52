"""What can be claimed of the errors of a case, and the verdict on it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from lyra_petsc.experiments.case import Verdict


@dataclass
class Row:
    """One line of a case's table.

    Attributes
    ----------
    quantity, unit : str
    n, h : float
        Resolution, and the length or time that shrinks.
    value, exact : float
        In ``unit``.
    error : float
        Relative to the scale of the quantity.
    order : float
        From the row before: log of the errors' ratio over log of the ratio of h; NaN where there is none.
    steps : int
        Accepted time or load steps of all simulations of this resolution.
    wall_seconds : float
        Of all of them, set-up included.
    problem : str
        Why there is no value, in words; empty if there is one.
    """

    quantity: str
    unit: str
    n: float
    h: float
    value: float = math.nan
    exact: float = math.nan
    error: float = math.nan
    order: float = math.nan
    steps: int = 0
    wall_seconds: float = 0.0
    problem: str = ""


class Claim(ABC):
    """A statement about the rows of one quantity."""

    #: whether the errors are of a size that an order can be read from
    has_order: ClassVar[bool] = True

    @abstractmethod
    def judge(self, rows: Sequence[Row], finest: float) -> Verdict:
        """The verdict on rows without problems, coarsest first, at least one.

        ``finest`` is h of the finest resolution the case has, which a quick run leaves out.
        """


@dataclass(frozen=True)
class Exact(Claim):
    """At every resolution the error is at most ``bound``: only round-off and the solver's tolerance."""

    has_order: ClassVar[bool] = False

    bound: float = 1e-10

    def judge(self, rows: Sequence[Row], finest: float) -> Verdict:
        worst = max(rows, key=_size_of_error)
        good = worst.error <= self.bound
        words = f"largest error {worst.error:.1e}, " + ("within" if good else "above")
        return Verdict(good, f"{words} {self.bound:.0e}")


@dataclass(frozen=True)
class Converges(Claim):
    """The error shrinks with ``order`` in h, within ``slack``, to at most ``bound`` at the finest.

    The order is that of the two finest rows; with an infinite slack none is claimed. Where a quick run
    stops at a larger h, the bound grows with h to the power of the order.
    """

    order: float
    bound: float
    slack: float = 0.25

    def judge(self, rows: Sequence[Row], finest: float) -> Verdict:
        last = rows[-1]
        bound = self.bound * max(1.0, last.h / finest) ** self.order
        small = last.error <= bound
        words = [f"error {last.error:.1e} at n = {last.n:g}, {'within' if small else 'above'} {bound:.1e}"]
        right = True
        if len(rows) > 1 and self.slack < math.inf:
            right = abs(last.order - self.order) <= self.slack
            expected = f"{'as' if right else 'not the'} expected {self.order:g} ± {self.slack:g}"
            words.append(f"order {last.order:.2f}, {expected}")
        return Verdict(small and right, "; ".join(words))


def at_finest(bound: float) -> Converges:
    """At the finest resolution the error is at most ``bound``; where a run stops before, (h / finest)² of it.

    No order is claimed: strips that bend within a cell or two, and criss-cross ones whose membrane resists
    the dimple in every cell, converge faster at first than in the end.
    """
    return Converges(2.0, bound, slack=math.inf)


def _size_of_error(row: Row) -> float:
    return math.inf if math.isnan(row.error) else row.error


def observed_order(before: Row, row: Row) -> float:
    """Order of convergence between two rows; NaN where one error is zero or missing."""
    if not (before.error > 0.0 and row.error > 0.0 and before.h != row.h):
        return math.nan
    return math.log(before.error / row.error) / math.log(before.h / row.h)
