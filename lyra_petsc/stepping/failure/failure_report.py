"""Report of a failed step: as one sentence, as a few lines for the terminal, and as a text for a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lyra_petsc.mesh.mesh import Source
from lyra_petsc.stepping.failure.failure_diagnosis import Diagnosis
from lyra_petsc.stepping.failure.near_pairs import NearPair
from lyra_petsc.stepping.newton.newton_trace import FailedSolve, Iteration
from lyra_petsc.stepping.stepper import Attempt

MAX_SHOWN = 8
"""Largest number of iterations, or of attempts, that the few lines show without abridging them."""


@dataclass(frozen=True)
class FailedAttempt:
    """A failed attempt at a step.

    Attributes
    ----------
    dt : float
        Length [s], or increment of the load factor.
    solver : str
        Preset of the linear solver.
    newton_iterations, linear_iterations : int
    residual : float
        Norm of the last residual [N].
    words : str
        Why it failed.
    """

    dt: float
    solver: str
    newton_iterations: int
    linear_iterations: int
    residual: float
    words: str

    @classmethod
    def of(cls, attempt: Attempt, dt: float, solver: str) -> FailedAttempt:
        """The record of a stepper's failed attempt."""
        iterations = attempt.newton_iterations, attempt.linear_iterations
        norm = attempt.residual if attempt.failed_solve is None else attempt.failed_solve.norm
        return cls(dt, solver, *iterations, norm, attempt.message)


@dataclass(frozen=True)
class Failure:
    """A step that did not converge.

    Attributes
    ----------
    step : int
        Number of the step, from 1.
    time, dt : float
        Start and length [s] of the last attempt; load factors in a static analysis.
    static : bool
    kind : str
        ``overflow``, ``linear trouble`` or ``nonlinear trouble``.
    attempts : list of FailedAttempt
        All attempts at this step, in order.
    diagnosis : Diagnosis
    advice : list of str
    sources : list of Source
        Sources of the mesh.
    failed_solve : FailedSolve
        This rank's arrays of the last attempt.
    near : NearPair or None
        In a scene with contact: the pair that would collide in the last attempt, else the nearest pair.
    obstacle : NearPair or None
        The nearest touching pair with an obstacle, if ``near`` is a pair of sheets.
    """

    step: int
    time: float
    dt: float
    static: bool
    kind: str
    attempts: list[FailedAttempt]
    diagnosis: Diagnosis
    advice: list[str]
    sources: list[Source]
    failed_solve: FailedSolve
    near: NearPair | None = None
    obstacle: NearPair | None = None

    @property
    def start(self) -> str:
        """Text for the time or load factor at the start of the step."""
        return f"load factor {self.time:g}" if self.static else f"t = {self.time:g} s"

    @property
    def sentence(self) -> str:
        """One line: what failed, where, and the first advice."""
        last = f"an increment of {self.dt:.3g}" if self.static else f"Δt = {self.dt:.3g} s"
        near = f": {_pair_text(self.near)}" if self.near is not None and self.near.blocks else ""
        what = f"{self.attempts[-1].words}{near}"
        if self.failed_solve.iterations or not near:
            what += (
                f" ({self.kind}); last residual {self.diagnosis.norm:.3g} N, "
                f"worst at {self._vertex()} around {_point(self.diagnosis.vertex.before, 4)} m "
                f"and {self._triangle()}"
            )
        return (
            f"step {self.step} ({self.start}) did not converge even with {last}: {what}; "
            f"the state at {self.start} is kept; try {self.advice[0]}"
        )

    @property
    def lines(self) -> tuple[str, ...]:
        """Short lines with the iterations, the worst vertex and triangle, and further advice."""
        history = ", ".join(_shortened([_iteration_text(each) for each in self.failed_solve.iterations]))
        found = [f"residual [N] by iteration (linear iterations): {history}"] if history else []
        found += [line for line in (self._linear(), self._earlier()) if line]
        found += self._worst_elements()
        return (*found, *(f"or try {change}" for change in self.advice[1:4]))

    @property
    def text(self) -> str:
        """The whole report, for a file."""
        rows = [self.sentence, "", "Attempts at this step:"]
        rows += [f"  {self._attempt(each)}: {each.words}" for each in self.attempts]
        rows += ["", "The last attempt, Newton iteration by iteration:"]
        rows += [f"  {'it':>4}  {'residual [N]':>12}  {'linear its':>10}  {'KSP reason':>10}    fraction"]
        for number, each in enumerate(self.failed_solve.iterations):
            part = "" if each.taken is None else f"{each.taken:.3g}"
            linear = f"{each.linear_iterations:10d}  {each.linear_reason:10d}"
            rows += [f"  {number:4d}  {each.residual:12.5e}  {linear}  {part:>10}".rstrip()]
        rows += ["", "Where (vertices and triangles are counted from 0, in file order):"]
        rows += [f"  {line}" for line in self._worst_elements()]
        rows += ["", "What to try:", *(f"  {change}" for change in self.advice)]
        if self._linear():
            rows += ["", "The last linear solve, residual norm by iteration:"]
            norms = self.failed_solve.linear_residuals
            rows += [f"  {number:4d}  {norm:12.5e}" for number, norm in enumerate(norms)]
        return "\n".join(rows) + "\n"

    def content(self) -> dict[str, Any]:
        """Entries of summary.json."""
        return {
            "step": self.step,
            "load_factor" if self.static else "time": self.time,
            "kind": self.kind,
            "attempts": [asdict(each) for each in self.attempts],
            "iterations": [asdict(each) for each in self.failed_solve.iterations],
            **asdict(self.diagnosis),
            **({} if self.near is None else {"near": asdict(self.near)}),
            **({} if self.obstacle is None else {"obstacle": asdict(self.obstacle)}),
            "advice": self.advice,
        }

    # -- pieces ----------------------------------------------------------------------------------------

    def _attempt(self, attempt: FailedAttempt) -> str:
        length = f"increment {attempt.dt:.3g}" if self.static else f"Δt {attempt.dt:.3g} s"
        return (
            f"{length} ({attempt.solver}): {attempt.newton_iterations} Newton and "
            f"{attempt.linear_iterations} linear iterations, residual {attempt.residual:.3g} N"
        )

    def _earlier(self) -> str:
        """A line on the attempts before the last one; empty if there was only one."""
        each = [
            f"{attempt.dt:.3g}: {attempt.residual:.3g} ({attempt.newton_iterations})"
            for attempt in self.attempts[:-1]
        ]
        step = "increment" if self.static else "Δt [s]"
        shown = ", ".join(_shortened(each))
        return f"attempts before, {step}: residual [N] (Newton iterations): {shown}" if each else ""

    def _linear(self) -> str:
        """A line on the last linear solve; empty unless it is the cause."""
        norms = self.failed_solve.linear_residuals
        if self.kind != "linear trouble" or len(norms) < 2:
            return ""
        return f"last linear solve: residual {norms[0]:.3g} → {norms[-1]:.3g} in {len(norms) - 1} iterations"

    def _worst_elements(self) -> list[str]:
        """Lines on the worst vertex and triangle, and on the nearest pair."""
        vertex, triangle = self.diagnosis.vertex, self.diagnosis.triangle
        forces = ", ".join(f"{name} {size:.3g}" for name, size in vertex.forces.items())
        size = math.hypot(*vertex.residual)
        many = self.diagnosis.not_finite
        return [
            *([f"{many} vertices have a residual that is not finite"] if many else []),
            *([f"nearest or colliding: {_pair_text(self.near)}"] if self.near is not None else []),
            *([f"nearest obstacle: {_pair_text(self.obstacle)}"] if self.obstacle is not None else []),
            f"{self._vertex()} at {_point(vertex.position)} m, before the step {_point(vertex.before)} m: "
            f"residual {size:.3g} N of forces [N] {forces}",
            f"{self._triangle()} of vertices {', '.join(map(str, triangle.vertices))} around "
            f"{_point(triangle.centre)} m: stretched to {triangle.stretches[0]:.3g} and "
            f"{triangle.stretches[1]:.3g}, aspect ratio at rest {triangle.aspect:.3g}",
        ]

    def _vertex(self) -> str:
        vertex = self.diagnosis.vertex
        label, number = self._within(vertex.number, [each.n_vertices for each in self.sources])
        labels = [f"node {vertex.tag}"] if vertex.tag else []
        labels += [f"vertex {number}"] if len(self.sources) > 1 and not vertex.tag else []
        more = f" ({labels[0]} of {label})" if labels else ""
        return f"vertex {vertex.number}{more}"

    def _triangle(self) -> str:
        whole = self.diagnosis.triangle.number
        label, number = self._within(whole, [each.n_triangles for each in self.sources])
        return f"triangle {whole}" + (f" (triangle {number} of {label})" if len(self.sources) > 1 else "")

    def _within(self, number: int, counts: Sequence[int]) -> tuple[str, int]:
        """The mesh source of a vertex or triangle, and its number in this source.

        ``counts`` are the numbers of vertices or triangles of the sources.
        """
        ends = np.cumsum(counts)
        which = int(np.searchsorted(ends, number, side="right"))
        return self.sources[which].label, number - int(ends[which] - counts[which])


def _pair_text(near: NearPair) -> str:
    """A pair and its separation."""
    beyond = f" beyond contact.thickness = {near.kept:g} m" if near.kept else ""
    return f"{near.text} {near.gap:.3g} m apart{beyond}"


def _iteration_text(each: Iteration) -> str:
    linear = f" ({each.linear_iterations})" if each.taken is not None else ""
    part = f" ×{each.taken:.2g}" if each.taken is not None and each.taken < 0.995 else ""
    return f"{each.residual:.3g}{linear}{part}"


def _shortened(entries: list[str]) -> list[str]:
    return entries if len(entries) <= MAX_SHOWN else [*entries[:3], "…", *entries[-4:]]


def _point(position: Sequence[float], digits: int = 6) -> str:
    return "(" + ", ".join(f"{value:.{digits}g}" for value in position) + ")"
