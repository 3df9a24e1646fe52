"""What may be the cause of a failed solve, and which key of the scene or option to change.

Rules, most telling first; each looks at a diagnosis and names what to change, or says nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.diagnosis import Diagnosis
from lyra_petsc.stepping.trace import Stuck

SNES = PETSc.SNES.ConvergedReason
KSP = PETSc.KSP.ConvergedReason

SOFTENS = 1.0 / math.sqrt(3.0)
"""Stretch below which the stiffness of St. Venant-Kirchhoff in compression is negative."""

LONG = 0.5
"""Element sizes that something may move in one step and be harmless."""

STRETCHED = 1.5
SLIVER = 50.0
NEARLY = 1e-3
"""Residual over the forces at work below which a solve was nearly there."""

NEAR_ROUNDOFF = 100.0
FEW_ITERATIONS = 10
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


def trouble(diagnosis: Diagnosis, stuck: Stuck) -> str:
    """``overflow``, ``linear trouble`` or ``nonlinear trouble``."""
    if diagnosis.not_finite:
        return "overflow"
    if stuck.snes_reason == SNES.DIVERGED_LINEAR_SOLVE:
        return "linear trouble"
    solved = stuck.iterations[1:]
    failed = sum(each.linear_reason < 0 for each in solved)
    if stuck.ksp_reason < 0 and 2 * failed >= len(solved):
        return "linear trouble"
    return "nonlinear trouble"


def advice(diagnosis: Diagnosis, stuck: Stuck, scene: Scene, now: Circumstances) -> list[str]:
    """What to try, most promising first; never empty."""
    kind = trouble(diagnosis, stuck)
    if kind == "overflow":
        return [_overflow(diagnosis, stuck), *_steps(scene, now)]
    found = [*_place(diagnosis, scene, now)]
    if kind == "linear trouble":
        return [_linear(stuck, now), *found]
    limit = _limit(stuck, now)
    if limit and now.max_iterations < FEW_ITERATIONS:
        return [*limit, *found, *_steps(scene, now)]
    found += [*_nearly(diagnosis, scene, now), *limit, *_steps(scene, now)]
    return found or ["more material.damping, or a finer mesh"]


def _overflow(diagnosis: Diagnosis, stuck: Stuck) -> str:
    if not diagnosis.iterate_finite:
        return (
            "the velocities are not finite: look for absurd numbers in material, gravity, loads, wind and "
            "initial, and in the units of the mesh (mesh.transform.scale)"
        )
    keys = "; ".join(KEYS.get(name, name) for name in diagnosis.overflowing) or KEYS["internal"]
    return (
        f"numbers overflow in the forces ({', '.join(diagnosis.overflowing)}): look for absurd ones in {keys}"
    )


def _place(diagnosis: Diagnosis, scene: Scene, now: Circumstances) -> list[str]:
    """What is odd at the worst vertex and triangle."""
    found = []
    triangle, vertex = diagnosis.triangle, diagnosis.vertex
    if diagnosis.handle is not None and diagnosis.jump > LONG * now.spacing:
        motion = scene.handles[diagnosis.handle].motion
        found.append(
            f"handles[{diagnosis.handle}] moves {diagnosis.jump:.3g} m in this step, "
            f"{diagnosis.jump / now.spacing:.2g} element sizes: give "
            + (f"motions.{motion} more time" if motion else "it a motion without jumps")
        )
    small, large = triangle.stretches
    if small < SOFTENS:
        found.append(
            f"triangle {triangle.number} is squeezed to {small:.3g} of its size; below 1/√3 = 0.577 the "
            "St. Venant-Kirchhoff membrane softens: squeeze it less (motions, loads), or let it fold with "
            "a finer mesh"
        )
    if large > STRETCHED:
        found.append(
            f"triangle {triangle.number} is stretched to {large:.3g} times its size: "
            "less load or motion, or more material.membrane"
        )
    if scene.time.scheme != "static":
        for name, keys in (("wind", "wind.velocity"), ("loads", "gravity and loads")):
            way = vertex.forces.get(name, 0.0) / vertex.mass * now.dt**2
            if way > LONG * now.spacing:
                found.append(
                    f"{name} alone would move vertex {vertex.number} by {way:.3g} m in this step, "
                    f"{way / now.spacing:.2g} element sizes: less {keys}, or a smaller time.step"
                )
    if triangle.aspect > SLIVER:
        found.append(
            f"triangle {triangle.number} has an aspect ratio of {triangle.aspect:.3g} at rest: mesh it better"
        )
    return found


def _linear(stuck: Stuck, now: Circumstances) -> str:
    direct = "-pc_type lu" if now.ranks == 1 else "-pc_type lu -pc_factor_mat_solver_type mumps"
    if stuck.ksp_reason == KSP.DIVERGED_MAX_IT:
        if now.linear_iterations < 1000:
            return f"-ksp_max_it above {now.linear_iterations}, or a direct solver: {direct}"
        return f"a direct solver: {direct}"
    if stuck.ksp_reason == KSP.DIVERGED_NANORINF:
        return f"look for absurd numbers in material, loads and wind; or a direct solver: {direct}"
    if now.preconditioner in ("lu", "cholesky"):
        return "-pc_factor_shift_type positive_definite, or less absurd numbers in material"
    return f"another preconditioner than -pc_type {now.preconditioner}; safest is a direct solver: {direct}"


def _limit(stuck: Stuck, now: Circumstances) -> list[str]:
    """Whether more iterations would help."""
    if stuck.snes_reason == SNES.DIVERGED_FUNCTION_COUNT:
        return ["-snes_max_funcs larger"]
    if stuck.snes_reason != SNES.DIVERGED_MAX_IT:
        return []
    norms = [each.residual for each in stuck.iterations]
    third = 2 * len(norms) // 3
    falling = third > 0 and min(norms[third:]) < 0.5 * min(norms[:third])
    if now.max_iterations < FEW_ITERATIONS or falling:
        why = "; the residual was still falling" if falling else ""
        return [f"{now.iterations_key} above {now.max_iterations}{why}"]
    return [
        f"more material.damping: {now.max_iterations} iterations ({now.iterations_key}) did not lessen it"
    ]


def _nearly(diagnosis: Diagnosis, scene: Scene, now: Circumstances) -> list[str]:
    """Whether the tolerances ask for more than there is."""
    asked = scene.solver.force_tolerance
    if diagnosis.scale == 0.0 or diagnosis.norm > NEARLY * diagnosis.scale:
        return []
    share = diagnosis.norm / diagnosis.scale
    loose = 10.0 ** math.ceil(math.log10(max(2.0 * share, float(np.finfo(float).tiny))))
    if diagnosis.norm <= NEAR_ROUNDOFF * now.floor:
        return [
            f"little more than round-off is left ({now.floor:.2g} N): solver.force_tolerance: "
            f"{max(loose, 10.0 * asked):.0e}, and solver.step_tolerance likewise"
        ]
    if share <= asked:
        return [f"forces balance to {share:.1e}: solver.step_tolerance above {scene.solver.step_tolerance:g}"]
    return [
        f"forces balance to {share:.1e} of the largest: if that will do, solver.force_tolerance: {loose:.0e}"
    ]


def _steps(scene: Scene, now: Circumstances) -> list[str]:
    if now.nominal > MANY_CUTS * now.dt:
        return []
    if scene.time.scheme == "static":
        return [
            "a smaller time.step (first increment of the load), or a damped motion (time.analysis: dynamic)"
        ]
    return [f"a smaller time.step, or -ts_adapt_dt_min below {now.dt:.3g}"]
