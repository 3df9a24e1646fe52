"""Input and result of a case; both are files, so that studies resume and launch processes."""

from __future__ import annotations

import hashlib
import json
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lyra_petsc.experiments import records
from lyra_petsc.stepping.problem import Outline
from lyra_petsc.stepping.simulation import StepReport

RESULT_FILE = "result.json"
SET_UP = ("mesh", "partition", "assembly")
"""Phases of a run before its first step; the solver's objects are set up in them too."""


@dataclass(frozen=True)
class Job:
    """One run to make.

    Attributes
    ----------
    scene : str
        Path of the scene file.
    overrides : tuple of str
        All that ``--set`` would say.
    folder : str
        Where its states and its result go.
    repeats : int
        How often it is timed; the first repeat writes the states.
    fingerprint : str
        Of everything the result depends on.
    trust_mesh : bool
        Give gmsh the scene's scripts whatever they say.
    """

    scene: str
    overrides: tuple[str, ...]
    folder: str
    repeats: int
    fingerprint: str
    trust_mesh: bool = False


@dataclass
class Timing:
    """Wall seconds of one repeat, the slowest rank's.

    Attributes
    ----------
    set_up : float
        Mesh, partition, assembly set-up and solver objects.
    run : float
        All steps, without output.
    phases : dict of str to float
        By phase; ``files`` is the writing of states.
    """

    set_up: float
    run: float
    phases: dict[str, float] = field(default_factory=dict)


@dataclass
class Result:
    """What came of a case.

    Attributes
    ----------
    fingerprint : str
    problem : str
        Why it failed, in words; empty if it did not.
    ranks : int
    integrator : str
    vertices, triangles : int
    spacing : float
        Mean edge length [m].
    sheets : list of int
        Vertices of each mesh source.
    steps, rejected, newton_iterations, linear_iterations : int
    shortest, longest : float
        Δt [s] of accepted steps.
    end : float
        Time reached [s].
    linear_solver : str
    timings : list of Timing
    notes : list of str
    """

    fingerprint: str
    problem: str = ""
    ranks: int = 1
    integrator: str = ""
    vertices: int = 0
    triangles: int = 0
    spacing: float = 0.0
    sheets: list[int] = field(default_factory=list)
    steps: int = 0
    rejected: int = 0
    newton_iterations: int = 0
    linear_iterations: int = 0
    shortest: float = 0.0
    longest: float = 0.0
    end: float = 0.0
    linear_solver: str = ""
    timings: list[Timing] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def done(self) -> bool:
        """Whether it ran to its end."""
        return not self.problem

    @property
    def mean_step(self) -> float:
        """Mean Δt [s]; 0 without steps."""
        return self.end / self.steps if self.steps else 0.0

    def describe(self, outline: Outline) -> None:
        """Note the mesh."""
        self.vertices, self.triangles = outline.n_vertices, outline.n_triangles
        self.spacing, self.sheets = outline.spacing, [each.n_vertices for each in outline.sources]

    def count(self, reports: Sequence[StepReport]) -> None:
        """Note the steps of a run."""
        self.steps = len(reports)
        self.rejected = sum(report.rejected for report in reports)
        self.newton_iterations = sum(report.newton_iterations for report in reports)
        self.linear_iterations = sum(report.linear_iterations for report in reports)
        self.shortest = min((report.dt for report in reports), default=0.0)
        self.longest = max((report.dt for report in reports), default=0.0)

    def fail(self, problem: str) -> None:
        """It has not ended as it should: no time of it counts."""
        self.problem, self.timings = problem, []

    def run_seconds(self) -> list[float]:
        """Of each repeat: the steps alone."""
        return [timing.run for timing in self.timings]

    def total_seconds(self) -> list[float]:
        """Of each repeat: set-up and steps."""
        return [timing.set_up + timing.run for timing in self.timings]

    def phase_seconds(self) -> dict[str, float]:
        """Median of each phase over the repeats."""
        names = dict.fromkeys(name for timing in self.timings for name in timing.phases)
        return {
            name: statistics.median(timing.phases.get(name, 0.0) for timing in self.timings)
            for name in names
            if name != "files"
        }

    def write(self, folder: Path) -> None:
        """Write ``result.json``; the case counts as finished from then on. Call on one rank."""
        records.save(folder / RESULT_FILE, self)


def read_result(folder: Path, fingerprint: str) -> Result | None:
    """The result of a finished case, or None if there is none for this fingerprint."""
    try:
        found = records.load(folder / RESULT_FILE, Result)
    except (OSError, ValueError):
        return None
    return found if found.fingerprint == fingerprint else None


def fingerprint(*parts: Sequence[str] | str) -> str:
    """A short digest of texts."""
    text = json.dumps([part if isinstance(part, str) else list(part) for part in parts])
    return hashlib.sha256(text.encode()).hexdigest()[:20]
