"""Report of a failed step: as one sentence, as a few lines for the terminal, and as a text for a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lyra_petsc.mesh.mesh import Source
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.failure.failure_diagnosis import SNES, Diagnosis, diagnose
from lyra_petsc.stepping.newton.newton_trace import FailedSolve, Iteration
from lyra_petsc.stepping.problem import Problem
from lyra_petsc.stepping.stage_solver import StageSolver
from lyra_petsc.stepping.stepper import BEYOND_LIMIT, Attempt

if TYPE_CHECKING:
    from lyra_petsc.contact.collisions import RefusedDisplacement
    from lyra_petsc.contact.contact_report import NearPair

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
    time : float
        Start [s] of the step; the load factor in a static analysis.
    static : bool
    attempts : list of FailedAttempt
        All attempts at this step, in order.
    diagnosis : Diagnosis
    advice : list of str
        General remedies, the most promising first.
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
    static: bool
    attempts: list[FailedAttempt]
    diagnosis: Diagnosis
    advice: list[str]
    sources: list[Source]
    failed_solve: FailedSolve
    near: NearPair | None = None
    obstacle: NearPair | None = None

    @property
    def sentence(self) -> str:
        """One line: what failed, where, and the first advice."""
        start = f"load factor {self.time:g}" if self.static else f"t = {self.time:g} s"
        last = self.attempts[-1]
        cause = last.words
        if near := self.near is not None and self.near.blocks:
            cause += f": {_pair_text(self.near)}"
        if self.failed_solve.iterations or not near:
            vertex = self.diagnosis.vertex
            cause += (
                f" ({self.diagnosis.kind}); last residual {self.diagnosis.norm:.3g} N, worst at "
                f"{self._vertex()} around {_point(vertex.before, 4)} m, mostly {vertex.largest_force}"
            )
        how = f"even with {self._length(last)}" if last.dt > 0.0 else "after what has broken"
        return (
            f"step {self.step} ({start}) did not converge {how}: {cause}; "
            f"the state at {start} is kept; try {self.advice[0]}"
        )

    @property
    def lines(self) -> tuple[str, ...]:
        """Short lines with the iterations, the worst vertex, the nearest pair, and further advice."""
        iterations = [_iteration_text(iteration) for iteration in self.failed_solve.iterations]
        earlier = [
            f"{one.dt:.3g}: {one.residual:.3g} ({one.newton_iterations})" for one in self.attempts[:-1]
        ]
        length = "increment" if self.static else "Δt [s]"
        norms = self._linear_residuals
        linear = [f"{norm:.3g}" for norm in norms[:: max(1, len(norms) - 1)]]
        titled = (
            ("residual [N] by iteration (linear iterations)", ", ".join(_shortened(iterations))),
            (f"residual [N] of the last linear solve in {len(norms) - 1} iterations", " → ".join(linear)),
            (f"attempts before, {length}: residual [N] (Newton iterations)", ", ".join(_shortened(earlier))),
        )
        history = [f"{title}: {text}" for title, text in titled if text]
        return (*history, *self._places(), *(f"or try {change}" for change in self.advice[1:]))

    @property
    def text(self) -> str:
        """The whole report, for a file."""
        rows = [self.sentence, "", "Attempts at this step:"]
        rows += [
            f"  {self._length(attempt)} ({attempt.solver}): {attempt.newton_iterations} Newton and "
            f"{attempt.linear_iterations} linear iterations, residual {attempt.residual:.3g} N: "
            f"{attempt.words}"
            for attempt in self.attempts
        ]
        rows += ["", "The last attempt, Newton iteration by iteration:"]
        rows += [f"  {'it':>4}  {'residual [N]':>12}  {'linear its':>10}  {'KSP reason':>10}    fraction"]
        for number, iteration in enumerate(self.failed_solve.iterations):
            part = "" if iteration.taken is None else f"{iteration.taken:.3g}"
            linear = f"{iteration.linear_iterations:10d}  {iteration.linear_reason:10d}"
            rows += [f"  {number:4d}  {iteration.residual:12.5e}  {linear}  {part:>10}".rstrip()]
        rows += ["", "Where (vertices are counted from 0, in file order):"]
        rows += [f"  {line}" for line in self._places()]
        rows += ["", "What to try:", *(f"  {change}" for change in self.advice)]
        if self._linear_residuals:
            rows += ["", "The last linear solve, residual norm by iteration:"]
            rows += [f"  {number:4d}  {norm:12.5e}" for number, norm in enumerate(self._linear_residuals)]
        return "\n".join(rows) + "\n"

    def content(self) -> dict[str, Any]:
        """Entries of summary.json."""
        pairs = {"near": self.near, "obstacle": self.obstacle}
        return {
            "step": self.step,
            "load_factor" if self.static else "time": self.time,
            "attempts": [asdict(attempt) for attempt in self.attempts],
            "iterations": [asdict(iteration) for iteration in self.failed_solve.iterations],
            **asdict(self.diagnosis),
            **{name: asdict(pair) for name, pair in pairs.items() if pair is not None},
            "advice": self.advice,
        }

    def _length(self, attempt: FailedAttempt) -> str:
        return f"an increment of {attempt.dt:.3g}" if self.static else f"Δt = {attempt.dt:.3g} s"

    @property
    def _linear_residuals(self) -> list[float]:
        """Residuals of the last linear solve; empty unless it is the cause."""
        norms = self.failed_solve.linear_residuals
        return norms.tolist() if self.diagnosis.kind == "linear trouble" and len(norms) > 1 else []

    def _places(self) -> list[str]:
        """Lines on the nearest pair and the worst vertex."""
        vertex, many = self.diagnosis.vertex, self.diagnosis.not_finite
        forces = ", ".join(f"{name} {size:.3g}" for name, size in vertex.forces.items())
        return [
            *([f"{many} vertices have a residual that is not finite"] if many else []),
            *([f"nearest or colliding: {_pair_text(self.near)}"] if self.near is not None else []),
            *([f"nearest obstacle: {_pair_text(self.obstacle)}"] if self.obstacle is not None else []),
            f"{self._vertex()} at {_point(vertex.position)} m, before the step {_point(vertex.before)} m: "
            f"residual {math.hypot(*vertex.residual):.3g} N of forces [N] {forces}",
        ]

    def _vertex(self) -> str:
        """The worst vertex, by its number in the mesh and in its file."""
        number, tag = self.diagnosis.vertex.number, self.diagnosis.vertex.tag
        ends = np.cumsum([source.n_vertices for source in self.sources])
        source = self.sources[int(np.searchsorted(ends, number, side="right"))]
        first = int(ends[self.sources.index(source)]) - source.n_vertices
        if tag:
            return f"vertex {number} (node {tag} of {source.label})"
        return f"vertex {number}" + (
            f" (vertex {number - first} of {source.label})" if len(self.sources) > 1 else ""
        )


def explain_failure(
    problem: Problem,
    scene: Scene,
    solver: StageSolver,
    solve: FailedSolve,
    attempts: list[FailedAttempt],
    *,
    refused: RefusedDisplacement | None,
    step: int,
    time: float,
    iterations_key: str,
) -> Failure:
    """Report on the last failed attempt at a step; collective.

    Parameters
    ----------
    problem : Problem
        In the state before the step.
    scene : Scene
    solver : StageSolver
    solve : FailedSolve
        Of the last attempt.
    attempts : list of FailedAttempt
        All attempts at this step.
    refused : RefusedDisplacement or None
        A displacement of the last one that collides.
    step : int
        Number of the step, from 1.
    time : float
        Start [s] of the step; the load factor in a static analysis.
    iterations_key : str
        Key or option that limits Newton's iterations.
    """
    equations = problem.equations
    diagnosis = diagnose(problem.points, solve, equations.x, problem.tags)
    near = obstacle = None
    if (contact := equations.contact) is not None:
        report = contact.report(equations.evaluated.x, equations.step.frozen)
        near = report.nearest(refused)
        obstacle = report.nearest_obstacle() if near is not None and not near.obstacle else None
    static, kind = not equations.integrator.dynamic, diagnosis.kind
    shorter = f"a smaller time.step, or -ts_adapt_dt_min below {attempts[-1].dt:.3g}"
    if static:
        shorter = "a smaller time.step (first increment of the load), or a damped motion instead"
    if attempts[-1].dt == 0.0:
        shorter = "a damped motion instead (without analysis: static)"
    advice = [f"a smaller {solver.stopped_by}, or none"] if solver.stopped_by else []
    if near is not None and near.blocks:
        # contact forces grow without bounds where parts would cross, so other advice would mislead
        advice += [
            "more space for the sheet: other or slower motions of obstacles and handles",
            "smaller loads or initial velocities, or a larger contact.gap",
            f"{shorter}; time.integrator: beuler is the most robust at impacts",
        ]
    elif attempts[-1].words == BEYOND_LIMIT:
        advice += ["a shorter motion of the handles, or a larger material.stretch_limit", shorter]
    elif kind == "overflow":
        parts = f" (overflow in: {', '.join(diagnosis.overflowing)})" if diagnosis.overflowing else ""
        advice += [f"smaller numbers where one is absurd, or has the wrong unit{parts}"]
        advice += ["another mesh.transform.scale, if the mesh is not in metres", shorter]
    elif static and not scene.handles:
        advice += ["handles (nothing holds the sheet)"]
    elif kind == "linear trouble":
        package = " -pc_factor_mat_solver_type mumps" if problem.points.comm.size > 1 else ""
        advice += [f"a direct solver: -pc_type lu{package}, with -pc_factor_shift_type positive_definite"]
        advice += [
            f"-ksp_max_it above {solver.ksp.getTolerances()[3]}",
            "solver.hessian: regularised",
        ]
    else:
        if solve.snes_reason == SNES.DIVERGED_MAX_IT:
            advice += [f"{iterations_key} above {solver.snes.getTolerances()[3]}"]
        advice += [shorter, "more material.damping, gentler motions and loads, or a finer mesh"]
        advice += ["a larger solver.force_tolerance, if the residual is small compared with the forces"]
    return Failure(
        step=step,
        time=time,
        static=static,
        attempts=attempts,
        diagnosis=diagnosis,
        advice=advice[:3],
        sources=problem.whole.sources,
        failed_solve=solve,
        near=near,
        obstacle=obstacle,
    )


def _pair_text(near: NearPair) -> str:
    """A pair and its separation."""
    beyond = f" beyond contact.thickness = {near.kept:g} m" if near.kept else ""
    return f"{near.text} {near.gap:.3g} m apart{beyond}"


def _iteration_text(iteration: Iteration) -> str:
    linear = f" ({iteration.linear_iterations})" if iteration.taken is not None else ""
    part = f" ×{iteration.taken:.2g}" if iteration.taken is not None and iteration.taken < 0.995 else ""
    return f"{iteration.residual:.3g}{linear}{part}"


def _shortened(entries: list[str]) -> list[str]:
    return entries if len(entries) <= MAX_SHOWN else [*entries[:3], "…", *entries[-4:]]


def _point(position: Sequence[float], digits: int = 6) -> str:
    return "(" + ", ".join(f"{value:.{digits}g}" for value in position) + ")"
