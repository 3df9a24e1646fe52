"""The numbers on a run for its report page, and advice on how to make it faster or more accurate."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.output import read_run
from lyra_petsc.output.history import HISTORY_COLUMNS
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.show.report.document import percent, short

ENERGIES = {column: column.removesuffix("_energy") for column in read_run.ENERGIES}
"""Columns of energies [J] and their names on the page."""


@dataclass(frozen=True)
class Facts:
    """The numbers on a run: its history, its summary, and quantities computed from them.

    Attributes
    ----------
    run : StoredRun
    columns : dict of str to (n,) array
        The history; row 0 is the initial state.
    """

    run: StoredRun
    columns: dict[str, Array]

    @classmethod
    def of(cls, run: StoredRun) -> Facts:
        """Read the history and the summary of a run."""
        history = run.history
        return cls(run, {name: np.asarray(history[name], float) for name in HISTORY_COLUMNS})

    @property
    def summary(self) -> dict[str, Any]:
        """summary.json; empty if it is missing."""
        return self.run.summary

    def steps(self, name: str) -> Array:
        """A column without the row of the initial state."""
        return self.columns[name][1:]

    @property
    def static(self) -> bool:
        """Whether the run is a static analysis, whose time is the load factor."""
        return self.run.scene.time.static

    @property
    def failed(self) -> bool:
        """Whether the solver failed."""
        return "failure" in self.summary

    # -- energy --------------------------------------------------------------------------------------

    @cached_property
    def total_energy(self) -> Array:
        """(n,) kinetic + elastic + potential energy [J]."""
        return np.asarray(np.sum([self.columns[name] for name in ENERGIES], axis=0))

    @cached_property
    def scheme_loss(self) -> Array:
        """(n,) cumulative numerical dissipation [J]: the energy change due to neither loads nor damping."""
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
        """Number of accepted steps."""
        return len(self.columns["step"]) - 1

    @property
    def step_seconds(self) -> float:
        """Wall time [s] of all steps, including those before a resumption."""
        return float(self.steps("wall_seconds").sum())

    @property
    def newton_per_step(self) -> float:
        """Mean Newton iterations per accepted step, including rejected attempts."""
        return float(self.steps("newton_iterations").mean()) if self.n_steps else 0.0

    @property
    def linear_per_newton(self) -> float:
        """Mean linear iterations per Newton iteration."""
        newton = float(self.steps("newton_iterations").sum())
        return float(self.steps("linear_iterations").sum()) / newton if newton else 0.0

    @property
    def rejected(self) -> int:
        """Number of rejected attempts at steps."""
        return int(self.steps("rejected").sum())

    @property
    def phases(self) -> dict[str, float]:
        """Wall time [s] by phase since the last start or resumption; empty if the run is not finished."""
        return {} if self.run.outcome in ("running", "killed") else dict(self.summary.get("wall_seconds", {}))


NOTABLE = 0.05
"""Rejected attempts over accepted steps, or lost energy over the largest change of one, to be mentioned."""

MANY_NEWTON = 8.0
"""Mean Newton iterations per step."""

MANY_LINEAR = 100.0
"""Mean linear iterations per Newton iteration."""

Rule = Callable[[Facts], Iterator[str]]


def advice(facts: Facts) -> list[str]:
    """Sentences on reasons for slowness or inaccuracy and their remedies; empty if there are none."""
    return [sentence for rule in RULES for sentence in rule(facts)]


def _how_to_continue(facts: Facts) -> Iterator[str]:
    folder = facts.run.folder
    again = f"mpirun -n {facts.summary.get('ranks', 1)} lyra-petsc run --resume --out {folder}"
    if facts.failed:
        for hint in facts.summary["failure"].get("advice", []):
            yield f"The solver stopped. Try {hint}."
    elif facts.run.outcome == "killed":
        yield f"The run was killed before its end. It goes on from the newest checkpoint with: {again}"
    elif facts.run.outcome not in ("done", "running", "unknown"):
        yield f"The run was stopped before its end. It goes on with: {again}"


def _rejected_steps(facts: Facts) -> Iterator[str]:
    if facts.n_steps == 0 or facts.rejected <= NOTABLE * facts.n_steps:
        return
    seen = f"{facts.rejected} attempts at a step were rejected over {facts.n_steps} accepted steps"
    time, median = facts.run.scene.time, float(np.median(facts.steps("dt")))
    if time.adaptive:
        yield f"{seen}: each costs a solve. A larger time.tolerance rejects fewer."
    elif facts.static:
        yield f"{seen}. A smaller time.step (first increment of the load factor) saves the attempts."
    elif median < 0.99 * float(time.step):
        yield f"{seen}. Set time.step to {short(median)} s, the median of the steps that were accepted."
    else:
        yield f"{seen}, a few hard moments of the motion. time.step: auto takes small steps only there."


def _newton(facts: Facts) -> Iterator[str]:
    mean = facts.newton_per_step
    if facts.static or mean <= MANY_NEWTON:
        return
    yield (
        f"A step takes {short(mean)} Newton iterations on average. A smaller time.step needs fewer; so does "
        "more material.damping, if the material allows it. "
        "lyra-petsc study SCENE finds the Δt and the integrator that give an accuracy in the least time."
    )


def _linear(facts: Facts) -> Iterator[str]:
    mean = facts.linear_per_newton
    if mean <= MANY_LINEAR:
        return
    incomplete = "-pc_type ilu" if facts.summary.get("ranks", 1) == 1 else "-pc_type bjacobi -sub_pc_type ilu"
    yield (
        f"A Newton iteration takes {short(mean)} linear iterations on average with "
        f"'{facts.summary.get('linear_solver', '')}'. Try, comparing wall times: {incomplete}; -pc_type mg; "
        "-pc_type cholesky; or a looser -ksp_rtol."
    )


def _accuracy(facts: Facts) -> Iterator[str]:
    time = facts.run.scene.time
    error, tolerance = facts.summary.get("estimated_error"), time.tolerance
    if error is not None and tolerance is not None and error > tolerance:
        yield (
            f"The estimated error of the positions, {short(error)} of the sheet's size, is beyond "
            f"time.tolerance, {short(tolerance)}: a smaller -ts_adapt_dt_min lets the steps follow it."
        )
    if facts.static or facts.turnover == 0.0 or time.scheme not in ("beuler", "semi-implicit"):
        return
    lost = float(facts.scheme_loss[-1])
    if lost > NOTABLE * facts.turnover:
        yield (
            f"The time scheme ({time.scheme}) took away {short(lost)} J, {percent(lost / facts.turnover)} of "
            "the largest change of an energy. A smaller time.step loses less, and so do bdf2, midpoint and "
            "alpha2 as time.integrator."
        )


RULES: tuple[Rule, ...] = (_how_to_continue, _rejected_steps, _newton, _linear, _accuracy)
