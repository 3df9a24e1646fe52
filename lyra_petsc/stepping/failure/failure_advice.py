"""Advice on a failed solve: which keys of the scene or options to change, and why.

A list of rules, the most specific first. Each checks a diagnosis for one probable cause.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from petsc4py import PETSc

from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.failure.failure_diagnosis import Diagnosis
from lyra_petsc.stepping.failure.near_pairs import NearPair
from lyra_petsc.stepping.newton.newton_trace import FailedSolve
from lyra_petsc.terms.stretch import SOFTENS_BELOW

SNES = PETSc.SNES.ConvergedReason
KSP = PETSc.KSP.ConvergedReason

LARGE_MOTION = 0.5
"""Displacement of a vertex in one step, over the mean edge length, above which it may be the cause."""

ABSURD_MOTION = 1e6
"""Displacement in one step, over the mean edge length, which only a mistake in the scene can cause."""

LARGE_STRETCH = 1.5
LARGE_ASPECT_RATIO = 50.0

SMALL_RESIDUAL = 1e-3
"""Residual over the largest part of the forces below which a solve had almost converged."""

NEAR_ROUNDOFF = 100.0
"""Residual over its round-off below which the tolerances are too small."""

FEW_ITERATIONS = 10
"""Limit of the Newton iterations below which a larger limit is the first advice."""

MANY_LINEAR_ITERATIONS = 1000
"""Limit of the linear iterations from which on a larger limit is no longer advised."""

LARGE_CUT = 100.0
"""Planned over last Δt above which an even smaller Δt is no longer advised."""

KEYS = {
    "inertia": "initial.velocity, motions and time.step",
    "internal": "material and the units of the mesh (mesh.transform.scale)",
    "springs": "handles[].stiffness",
    "friction": "contact.friction",
    "loads": "gravity and loads",
    "damping": "material.damping",
    "wind": "wind.velocity and wind.density",
}
"""Keys of the scene that determine the parts of the residual, by name of the part."""


@dataclass(frozen=True)
class FailedStep:
    """Properties of the failed step on which the advice depends.

    Attributes
    ----------
    dt, nominal : float
        Length of the last attempt and planned length [s], or increments of the load factor.
    spacing : float
        Mean edge length [m].
    floor : float
        Norm of the residual's round-off [N].
    max_iterations : int
        Largest number of Newton iterations of a solve.
    iterations_key : str
        The key or option that sets this number.
    linear_iterations : int
        Largest number of linear iterations of a solve, ``-ksp_max_it``.
    preconditioner : str
    ranks : int
    """

    dt: float
    nominal: float
    spacing: float
    floor: float
    max_iterations: int
    iterations_key: str
    linear_iterations: int
    preconditioner: str
    ranks: int


def failure_kind(diagnosis: Diagnosis, solve: FailedSolve) -> str:
    """``overflow``, ``linear trouble`` or ``nonlinear trouble``."""
    if diagnosis.not_finite or not math.isfinite(diagnosis.norm):
        return "overflow"
    if solve.snes_reason == SNES.DIVERGED_LINEAR_SOLVE:
        return "linear trouble"
    if solve.ksp_reason >= 0:
        return "nonlinear trouble"
    # The last linear solve failed. If Newton's method reached its limit of iterations, that is the cause only
    # if most of the earlier linear solves failed, too.
    solved = solve.iterations[1:]
    failed = sum(each.linear_reason < 0 for each in solved)
    few_failed = solve.snes_reason == SNES.DIVERGED_MAX_IT and 2 * failed < len(solved)
    return "nonlinear trouble" if few_failed else "linear trouble"


def advice(diagnosis: Diagnosis, solve: FailedSolve, scene: Scene, step: FailedStep) -> list[str]:
    """Changes to try, each with its reason, the most promising first; never empty."""
    kind = failure_kind(diagnosis, solve)
    if kind == "overflow":
        return [_overflow_advice(diagnosis, step), *_step_advice(scene, step)]
    found = _local_advice(diagnosis, scene, step)
    static = scene.time.scheme == "static"
    if static and not scene.handles:
        found.insert(0, "handles (nothing holds the sheet)")
        return [*found, *_linear_advice(solve, scene, step)]
    if kind == "linear trouble":
        return [*_linear_advice(solve, scene, step), *found]
    limit = _iteration_advice(solve, step)
    if limit and (step.max_iterations < FEW_ITERATIONS or solve.snes_reason == SNES.DIVERGED_FUNCTION_COUNT):
        return [*limit, *found, *_step_advice(scene, step)]
    found += [*_tolerance_advice(diagnosis, scene, step), *limit, *_step_advice(scene, step)]
    if not found:
        found = [
            "more handles, or a damped motion instead" if static else "more material.damping, or a finer mesh"
        ]
    return found


def contact_advice(pair: NearPair, scene: Scene) -> str:
    """The change to try if the step failed because this pair would collide."""
    moving = [name for name, obstacle in (scene.obstacles or {}).items() if obstacle.motion]
    handled = any(handle.motion for handle in scene.handles)
    named = [pair.obstacle] if pair.obstacle in moving else moving
    motions = [f"obstacles.{name}.motion" for name in named]
    if handled and pair.obstacle not in moving:
        motions.append("the motions of handles")
    if motions:
        return f"more space for the sheet, which is squeezed: change {' and '.join(motions)}"
    if scene.time.scheme in ("static", "beuler"):
        return (
            "slower motion or smaller loads (initial.velocity, gravity, loads, wind), or a larger contact.gap"
        )
    return f"time.integrator: beuler, which is more robust at impacts than {scene.time.scheme}"


def _overflow_advice(diagnosis: Diagnosis, step: FailedStep) -> str:
    absurd = "smaller numbers where one is absurd, or has the wrong unit: in "
    if not diagnosis.iterate_finite or not diagnosis.overflowing:
        return absurd + "material, gravity, loads, wind, initial, motions, or mesh.transform.scale"
    if diagnosis.vertex.moved > ABSURD_MOTION * step.spacing:
        return (
            f"{absurd}initial.velocity, motions, gravity and loads (vertex {diagnosis.vertex.number} moves "
            f"{diagnosis.vertex.moved:.3g} m in this step)"
        )
    keys = "; ".join(KEYS.get(name, name) for name in diagnosis.overflowing)
    return f"{absurd}{keys} (overflow in: {', '.join(diagnosis.overflowing)})"


def _local_advice(diagnosis: Diagnosis, scene: Scene, step: FailedStep) -> list[str]:
    """Advice on extreme values at the vertex and triangle with the largest residual, and on handles."""
    found = []
    triangle, vertex = diagnosis.triangle, diagnosis.vertex
    sizes = diagnosis.jump / step.spacing
    if diagnosis.handle is not None and sizes > LARGE_MOTION:
        motion = scene.handles[diagnosis.handle].motion
        found.append(
            (f"more time for motions.{motion}" if motion else "a motion without jumps")
            + f" (handles[{diagnosis.handle}] moves {diagnosis.jump:.3g} m in this step, "
            f"{sizes:.2g} element sizes)"
        )
    small, large = triangle.stretches
    if small < SOFTENS_BELOW:
        stvk = scene.material[0].law == "stvk"
        law = "; below 1/√3 = 0.577 the St. Venant-Kirchhoff membrane softens" if stvk else ""
        found.append(
            "less compression by motions and loads, or a finer mesh that can fold "
            f"(triangle {triangle.number} is at {small:.3g} of its size{law})"
        )
    if large > LARGE_STRETCH:
        found.append(
            "less motion or load, or more material.membrane "
            f"(triangle {triangle.number} is stretched to {large:.3g} times its size)"
        )
    if scene.time.scheme != "static":
        for name, keys in (("wind", "wind.velocity"), ("loads", "gravity and loads")):
            distance = vertex.forces.get(name, 0.0) / vertex.mass * step.dt**2
            if distance > LARGE_MOTION * step.spacing:
                found.append(
                    f"less {keys}, or a smaller time.step ({name} alone would move vertex {vertex.number} by "
                    f"{distance:.3g} m in this step, {distance / step.spacing:.2g} element sizes)"
                )
    if triangle.aspect > LARGE_ASPECT_RATIO:
        found.append(
            f"a better mesh (triangle {triangle.number} has an aspect ratio of {triangle.aspect:.3g} at rest)"
        )
    return found


def _linear_advice(solve: FailedSolve, scene: Scene, step: FailedStep) -> list[str]:
    direct = "a direct solver: -pc_type lu"
    if step.ranks > 1:
        direct += " -pc_factor_mat_solver_type mumps"
    if solve.ksp_reason == KSP.DIVERGED_MAX_IT and step.linear_iterations < MANY_LINEAR_ITERATIONS:
        return [f"-ksp_max_it above {step.linear_iterations}", direct]
    if solve.ksp_reason == KSP.DIVERGED_INDEFINITE_MAT and scene.solver.hessian != "regularised":
        return ["solver.hessian: regularised", direct]
    if step.preconditioner in ("lu", "cholesky"):
        return ["-pc_factor_shift_type positive_definite, or smaller numbers where material has absurd ones"]
    return [direct, f"another preconditioner than -pc_type {step.preconditioner}"]


def _iteration_advice(solve: FailedSolve, step: FailedStep) -> list[str]:
    """Advice if the limit of iterations or function evaluations ended the solve."""
    if solve.snes_reason == SNES.DIVERGED_FUNCTION_COUNT:
        return ["a larger -snes_max_funcs"]
    if solve.snes_reason != SNES.DIVERGED_MAX_IT:
        return []
    norms = [each.residual for each in solve.iterations]
    early = 2 * len(norms) // 3
    falling = early > 0 and min(norms[early:]) < 0.5 * min(norms[1:early] or norms[:1])
    above = f"{step.iterations_key} above {step.max_iterations}"
    if falling:
        return [f"{above} (the residual was still falling)"]
    if step.max_iterations < FEW_ITERATIONS:
        return [above]
    return [
        f"more material.damping (the last of {step.max_iterations} iterations did not reduce the residual)"
    ]


def _tolerance_advice(diagnosis: Diagnosis, scene: Scene, step: FailedStep) -> list[str]:
    """Advice if the solve had almost converged: larger tolerances."""
    tolerance = scene.solver.force_tolerance
    if diagnosis.scale == 0.0 or diagnosis.norm > SMALL_RESIDUAL * diagnosis.scale:
        return []
    relative = diagnosis.norm / diagnosis.scale
    loose = 10.0 ** math.ceil(math.log10(max(2.0 * relative, 10.0 * tolerance)))
    if diagnosis.norm <= NEAR_ROUNDOFF * step.floor:
        return [
            f"solver.force_tolerance: {loose:.0e} and solver.step_tolerance likewise "
            f"(the residual is near its round-off, {step.floor:.2g} N)"
        ]
    balance = f"(forces balance to {relative:.1e} of the largest)"
    if relative <= tolerance:
        return [f"solver.step_tolerance above {scene.solver.step_tolerance:g} {balance}"]
    return [f"solver.force_tolerance: {loose:.0e}, if that is accurate enough {balance}"]


def _step_advice(scene: Scene, step: FailedStep) -> list[str]:
    if step.nominal > LARGE_CUT * step.dt:
        return []
    if scene.time.scheme == "static":
        return ["a smaller time.step (first increment of the load), or a damped motion instead"]
    return [f"a smaller time.step, or -ts_adapt_dt_min below {step.dt:.3g}"]
