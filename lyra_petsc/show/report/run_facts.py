"""What the files of a run say about how it went: sums and shares of its history and its summary."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.output.history import HISTORY_COLUMNS
from lyra_petsc.output.read_run import Run
from lyra_petsc.output.run_folder import in_use

Array = NDArray[np.float64]

ENERGIES = {
    "kinetic_energy": "kinetic",
    "membrane_energy": "membrane",
    "bending_energy": "bending",
    "potential_energy": "potential",
}
"""Names of the columns of energies [J] in words."""


@dataclass(frozen=True)
class Facts:
    """A run in numbers.

    Attributes
    ----------
    run : Run
    columns : dict of str to (n,) array
        The history; row 0 is the initial state.
    summary : dict
        summary.json; empty where it is missing.
    """

    run: Run
    columns: dict[str, Array]
    summary: dict[str, Any]

    @classmethod
    def of(cls, run: Run) -> Facts:
        """Read the history and the summary of a run."""
        history = run.history
        return cls(run, {name: np.asarray(history[name], float) for name in HISTORY_COLUMNS}, run.summary)

    def steps(self, name: str) -> Array:
        """A column without the row of the initial state."""
        return self.columns[name][1:]

    @property
    def static(self) -> bool:
        """Whether it seeks an equilibrium: time is the load factor then."""
        return self.run.scene.time.analysis == "static"

    @cached_property
    def outcome(self) -> str:
        """``done``, ``running``, ``killed``, ``unknown``, or the words with which it stopped."""
        words = str(self.summary.get("outcome", "unknown"))
        return "killed" if words == "running" and not in_use(self.run.folder) else words

    @property
    def failed(self) -> bool:
        """Whether the solver gave up."""
        return "failure" in self.summary

    # -- energy --------------------------------------------------------------------------------------

    @cached_property
    def total_energy(self) -> Array:
        """(n,) kinetic + elastic + potential energy [J]."""
        return np.asarray(np.sum([self.columns[name] for name in ENERGIES], axis=0))

    @cached_property
    def scheme_loss(self) -> Array:
        """(n,) energy [J] that neither loads nor damping account for: what the time scheme took away."""
        gain = self.columns["external_work"] - self.columns["dissipation"]
        return np.asarray(self.total_energy[0] + gain - self.total_energy)

    @cached_property
    def turnover(self) -> float:
        """The largest change [J] of any energy or work over the run."""
        names = [*ENERGIES, "external_work", "dissipation"]
        return max(float(np.ptp(self.columns[name])) for name in names)

    # -- effort --------------------------------------------------------------------------------------

    @property
    def n_steps(self) -> int:
        """Accepted steps."""
        return len(self.columns["step"]) - 1

    @property
    def step_seconds(self) -> float:
        """Wall time [s] of all steps, those before a resumption included."""
        return float(self.steps("wall_seconds").sum())

    @property
    def newton_per_step(self) -> float:
        """Mean Newton iterations of a step, attempts that were rejected included."""
        return float(self.steps("newton_iterations").mean()) if self.n_steps else 0.0

    @property
    def linear_per_newton(self) -> float:
        """Mean linear iterations of a Newton iteration."""
        newton = float(self.steps("newton_iterations").sum())
        return float(self.steps("linear_iterations").sum()) / newton if newton else 0.0

    @property
    def rejected(self) -> int:
        """Attempts at a step that were repeated."""
        return int(self.steps("rejected").sum())

    @property
    def phases(self) -> dict[str, float]:
        """Wall time [s] by phase, of the last start of the run; empty while it goes on."""
        return {} if self.outcome in ("running", "killed") else dict(self.summary.get("wall_seconds", {}))

    def share(self, phase: str) -> float:
        """Part of the wall time that a phase took."""
        total = sum(self.phases.values())
        return self.phases.get(phase, 0.0) / total if total else 0.0
