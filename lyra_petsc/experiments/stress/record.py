"""What was seen while a case ran."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.stress.balance import Balance
from lyra_petsc.stepping.simulation import StepReport


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
    balances : list of Balance
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
    balances: list[Balance] = field(default_factory=list)
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
