"""What may be the cause of a failed solve, and which key of the scene or option to change.

Rules, the most specific first; each looks at a diagnosis and names what to change, or returns None.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from petsc4py import PETSc

from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.failure_diagnosis import Diagnosis
from lyra_petsc.stepping.near_pairs import NearPair
from lyra_petsc.stepping.newton_trace import FailedSolve

SNES = PETSc.SNES.ConvergedReason
KSP = PETSc.KSP.ConvergedReason

SOFTENS = 1.0 / math.sqrt(3.0)
"""Stretch below which the stiffness of St. Venant-Kirchhoff in compression is negative."""

LONG = 0.5
"""Element sizes that something may move in one step and be harmless."""

FAR = 1e6
"""Element sizes that nothing moves in one step but by mistake."""

STRETCHED = 1.5
SLIVER = 50.0
NEARLY = 1e-3
"""Residual over the forces at work below which a solve was nearly there."""

NEAR_ROUNDOFF = 100.0
FEW_ITERATIONS = 10
MANY_LINEAR = 1000
MANY_CUTS = 100.0
"""Cut of Δt after which a smaller one is not what is missing."""

KEYS = {
    "inertia": "initial.velocity, motions and time.step",
    "internal": "material and the units of the mesh (mesh.transform.scale)",
    "springs": "handles[].stiffness",
    "loads": "gravity and loads",
    "damping": "material.damping",
    "wind": "wind.velocity and wind.density",
}
"""Where the sizes of the parts of the residual come from."""


@dataclass(frozen=True)
class Circumstances:
    """What else one must know of the step that failed.

    Attributes
    ----------
    dt, nominal : float
        Length of the last attempt and planned length [s], or increments of the load factor.
    spacing : float
        Mean edge length [m].
    floor : float
        Norm of the residual's round-off [N].
    max_iterations : int
        Newton iterations a solve may take.
    iterations_key : str
        What sets them.
    linear_iterations : int
        What ``-ksp_max_it`` allows.
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
    # what stopped the solve is the direction that this linear solve failed to give; where the iterations
    # ran out it may be one failure of many solves
    solved = solve.iterations[1:]
    failed = sum(each.linear_reason < 0 for each in solved)
    ran_out = solve.snes_reason == SNES.DIVERGED_MAX_IT and 2 * failed < len(solved)
    return "nonlinear trouble" if ran_out else "linear trouble"


def advice(diagnosis: Diagnosis, solve: FailedSolve, scene: Scene, now: Circumstances) -> list[str]:
    """What to try and why, most promising first; never empty."""
    kind = failure_kind(diagnosis, solve)
    if kind == "overflow":
        return [_overflow_advice(diagnosis, now), *_step_advice(scene, now)]
    found = _local_advice(diagnosis, scene, now)
    static = scene.time.scheme == "static"
    if static and not scene.handles:
        found.insert(0, "handles (nothing holds the sheet)")
        return [*found, *_linear_advice(solve, scene, now)]
    if kind == "linear trouble":
        return [*_linear_advice(solve, scene, now), *found]
    limit = _iteration_advice(solve, now)
    if limit and (now.max_iterations < FEW_ITERATIONS or solve.snes_reason == SNES.DIVERGED_FUNCTION_COUNT):
        return [*limit, *found, *_step_advice(scene, now)]
    found += [*_tolerance_advice(diagnosis, scene, now), *limit, *_step_advice(scene, now)]
    if not found:
        found = [
            "more handles, or a damped motion instead" if static else "more material.damping, or a finer mesh"
        ]
    return found


def contact_advice(meets: NearPair, scene: Scene) -> str:
    """What to change where two parts meet that may not."""
    moving = [name for name, obstacle in (scene.obstacles or {}).items() if obstacle.motion]
    handled = any(handle.motion for handle in scene.handles)
    named = [meets.obstacle] if meets.obstacle in moving else moving
    who = [f"obstacles.{name}.motion" for name in named]
    if handled and meets.obstacle not in moving:
        who.append("the motions of handles")
    if who:
        return f"more room for the sheet: {' and '.join(who)} must leave it some"
    if scene.time.scheme in ("static", "beuler"):
        return (
            "slower motion or smaller loads (initial.velocity, gravity, loads, wind), or a larger contact.gap"
        )
    return f"time.integrator: beuler, which stands impacts that {scene.time.scheme} does not"


def _overflow_advice(diagnosis: Diagnosis, now: Circumstances) -> str:
    absurd = "smaller numbers where one is absurd, or lost its unit: in "
    if not diagnosis.iterate_finite or not diagnosis.overflowing:
        return absurd + "material, gravity, loads, wind, initial, motions, or mesh.transform.scale"
    if diagnosis.vertex.moved > FAR * now.spacing:
        return (
            f"{absurd}initial.velocity, motions, gravity and loads (vertex {diagnosis.vertex.number} moves "
            f"{diagnosis.vertex.moved:.3g} m in this step)"
        )
    keys = "; ".join(KEYS.get(name, name) for name in diagnosis.overflowing)
    return f"{absurd}{keys} (what overflows: {', '.join(diagnosis.overflowing)})"


def _local_advice(diagnosis: Diagnosis, scene: Scene, now: Circumstances) -> list[str]:
    """What is odd at the worst vertex and triangle."""
    found = []
    triangle, vertex = diagnosis.triangle, diagnosis.vertex
    sizes = diagnosis.jump / now.spacing
    if diagnosis.handle is not None and sizes > LONG:
        motion = scene.handles[diagnosis.handle].motion
        found.append(
            (f"more time for motions.{motion}" if motion else "a motion without jumps")
            + f" (handles[{diagnosis.handle}] moves {diagnosis.jump:.3g} m in this step, "
            f"{sizes:.2g} element sizes)"
        )
    small, large = triangle.stretches
    if small < SOFTENS:
        law = "; below 1/√3 = 0.577 the St. Venant-Kirchhoff membrane softens"
        found.append(
            f"less squeezing by motions and loads, or a finer mesh that can fold (triangle {triangle.number} "
            f"is at {small:.3g} of its size{law if scene.material[0].law == 'stvk' else ''})"
        )
    if large > STRETCHED:
        found.append(
            "less motion or load, or more material.membrane "
            f"(triangle {triangle.number} is stretched to {large:.3g} times its size)"
        )
    if scene.time.scheme != "static":
        for name, keys in (("wind", "wind.velocity"), ("loads", "gravity and loads")):
            way = vertex.forces.get(name, 0.0) / vertex.mass * now.dt**2
            if way > LONG * now.spacing:
                found.append(
                    f"less {keys}, or a smaller time.step ({name} alone would move vertex {vertex.number} by "
                    f"{way:.3g} m in this step, {way / now.spacing:.2g} element sizes)"
                )
    if triangle.aspect > SLIVER:
        found.append(
            f"a better mesh (triangle {triangle.number} has an aspect ratio of {triangle.aspect:.3g} at rest)"
        )
    return found


def _linear_advice(solve: FailedSolve, scene: Scene, now: Circumstances) -> list[str]:
    direct = "a direct solver: -pc_type lu"
    if now.ranks > 1:
        direct += " -pc_factor_mat_solver_type mumps"
    if solve.ksp_reason == KSP.DIVERGED_MAX_IT and now.linear_iterations < MANY_LINEAR:
        return [f"-ksp_max_it above {now.linear_iterations}", direct]
    if solve.ksp_reason == KSP.DIVERGED_INDEFINITE_MAT and scene.solver.hessian != "regularised":
        return ["solver.hessian: regularised", direct]
    if now.preconditioner in ("lu", "cholesky"):
        return ["-pc_factor_shift_type positive_definite, or smaller numbers where material has absurd ones"]
    return [direct, f"another preconditioner than -pc_type {now.preconditioner}"]


def _iteration_advice(solve: FailedSolve, now: Circumstances) -> list[str]:
    """Whether more iterations would help."""
    if solve.snes_reason == SNES.DIVERGED_FUNCTION_COUNT:
        return ["a larger -snes_max_funcs"]
    if solve.snes_reason != SNES.DIVERGED_MAX_IT:
        return []
    norms = [each.residual for each in solve.iterations]
    early = 2 * len(norms) // 3
    falling = early > 0 and min(norms[early:]) < 0.5 * min(norms[1:early] or norms[:1])
    above = f"{now.iterations_key} above {now.max_iterations}"
    if falling:
        return [f"{above} (the residual was still falling)"]
    if now.max_iterations < FEW_ITERATIONS:
        return [above]
    return [
        f"more material.damping (the last of {now.max_iterations} iterations did not lessen the residual)"
    ]


def _tolerance_advice(diagnosis: Diagnosis, scene: Scene, now: Circumstances) -> list[str]:
    """Whether the tolerances ask for more than there is."""
    asked = scene.solver.force_tolerance
    if diagnosis.scale == 0.0 or diagnosis.norm > NEARLY * diagnosis.scale:
        return []
    share = diagnosis.norm / diagnosis.scale
    loose = 10.0 ** math.ceil(math.log10(max(2.0 * share, 10.0 * asked)))
    if diagnosis.norm <= NEAR_ROUNDOFF * now.floor:
        return [
            f"solver.force_tolerance: {loose:.0e} and solver.step_tolerance likewise "
            f"(little more than round-off, {now.floor:.2g} N, is left)"
        ]
    balance = f"(forces balance to {share:.1e} of the largest)"
    if share <= asked:
        return [f"solver.step_tolerance above {scene.solver.step_tolerance:g} {balance}"]
    return [f"solver.force_tolerance: {loose:.0e}, if that will do {balance}"]


def _step_advice(scene: Scene, now: Circumstances) -> list[str]:
    if now.nominal > MANY_CUTS * now.dt:
        return []
    if scene.time.scheme == "static":
        return ["a smaller time.step (first increment of the load), or a damped motion instead"]
    return [f"a smaller time.step, or -ts_adapt_dt_min below {now.dt:.3g}"]
