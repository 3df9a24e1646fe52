"""What a case is told and what comes of it; both are files, so that studies resume and launch processes."""

from __future__ import annotations

import hashlib
import json
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from lyra_petsc.output.atomic import replace_text

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
    """

    scene: str
    overrides: tuple[str, ...]
    folder: str
    repeats: int
    fingerprint: str

    def text(self) -> str:
        """As JSON."""
        return json.dumps(asdict(self), indent=2, ensure_ascii=False) + "\n"

    @classmethod
    def read(cls, path: Path) -> Job:
        """The job in a file that ``text`` wrote."""
        content = json.loads(path.read_text(encoding="utf-8"))
        return cls(**{**content, "overrides": tuple(content["overrides"])})


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
        replace_text(folder / RESULT_FILE, json.dumps(asdict(self), indent=2, ensure_ascii=False) + "\n")


def read_result(folder: Path, fingerprint: str) -> Result | None:
    """The result of a finished case, or None if there is none for this fingerprint."""
    try:
        content: dict[str, Any] = json.loads((folder / RESULT_FILE).read_text(encoding="utf-8"))
        known = {item.name for item in fields(Result)}
        if content["fingerprint"] != fingerprint or not known >= content.keys():
            return None
        timings = [Timing(**timing) for timing in content.pop("timings", [])]
        return Result(**content, timings=timings)
    except (OSError, ValueError, TypeError, KeyError):
        return None


def fingerprint(*parts: Sequence[str] | str) -> str:
    """A short digest of texts."""
    text = json.dumps([part if isinstance(part, str) else list(part) for part in parts])
    return hashlib.sha256(text.encode()).hexdigest()[:20]
