"""From an unstable equilibrium along its lowest modes to a stable one, and what is said of the stability."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.statics.buckled_shape import BuckledShape
from lyra_petsc.stepping.statics.stability import Examination, Stability
from lyra_petsc.stepping.stepper import Attempt

MAX_DESCENTS = 5
"""Largest number of unstable equilibria that are left along their lowest mode."""

NO_POTENTIAL = (
    "pressure beside free edges, or a moment on edges that turn, has no potential, and the symmetric part of "
    "the stiffness is indefinite"
)


@dataclass(frozen=True)
class EquilibriumReport:
    """Stability of the last equilibrium, iterations to find it, and a note for the user."""

    stability: Stability
    newton_iterations: int
    linear_iterations: int
    note: str


def descend(
    equations: StageEquations,
    load_step: tuple[float, float],
    size: float,
    attempt: Callable[[], Attempt],
    skew_part_stabilises: Callable[[Stability, Array], bool],
    friction_note: Callable[[], str],
) -> EquilibriumReport:
    """Leave the equilibrium just found along its lowest mode while it is unstable; collective.

    Parameters
    ----------
    load_step : (float, float)
        Load factors before and at the equilibrium.
    size : float
        Diagonal of the mesh's bounding box [m].
    attempt : callable
        Finds the equilibrium near the present shape.
    skew_part_stabilises : callable
        Whether the skew part of the stiffness stabilises an unstable mode (n_owned, 3).
    friction_note : callable
        What is not known of friction in the present equilibrium.
    """
    newton = linear = followed = 0
    while True:
        note, x = friction_note(), equations.x[: equations.points.n_owned].copy()
        with Examination(equations, size) as examination:
            stability = examination.stability
            if stability.stable is not False:
                obstacle = ""
                break
            mode = examination.lowest_mode()
            if mode is not None and skew_part_stabilises(stability, mode):
                stability, obstacle = Stability(reason=NO_POTENTIAL), ""
                break
            obstacle = _obstacle(examination, mode, followed)
        if mode is None or obstacle:
            break
        buckled = BuckledShape(equations, lambda: Examination(equations, size), *load_step, size)
        solve = attempt() if buckled.find(mode) else None
        if solve is not None:
            newton += solve.newton_iterations
            linear += solve.linear_iterations
        if solve is None or not solve.converged:
            equations.state.set(x, np.zeros_like(x))
            equations.begin_step(*load_step)
            equations.evaluate(equations.stationary_velocity())
            obstacle = "from its lowest mode no other was found"
            break
        followed += 1
    note = "; ".join(part for part in (_note(stability, followed, obstacle), note) if part)
    return EquilibriumReport(stability, newton, linear, note)


def _obstacle(examination: Examination, mode: Array | None, followed: int) -> str:
    """Why a mode is not followed, or an empty string."""
    if mode is None:
        return "its lowest mode was not found"
    if examination.is_wrinkle(mode):
        return (
            "sheets without bending wrinkle as finely as the mesh, which is not followed; give a bending "
            "stiffness"
        )
    return f"its lowest mode was followed {followed} times" if followed == MAX_DESCENTS else ""


def _note(stability: Stability, followed: int, obstacle: str) -> str:
    """Note for the user on the stability of an equilibrium, or an empty string."""
    if stability.stable is None:
        return f"whether the equilibrium is stable is not known: {stability.reason}"
    if not stability.stable:
        modes = "1 way" if stability.negative == 1 else f"{stability.negative} ways"
        return f"the equilibrium is unstable, it gives way in {modes} (negative pivots): {obstacle}"
    notes = []
    if followed:
        times = "once" if followed == 1 else f"{followed} times"
        notes.append(
            f"the first equilibrium was unstable; its lowest mode was followed {times}, to a stable one"
        )
    if stability.rigid:
        notes.append(f"nothing holds the sheet in {stability.rigid} rigid motions")
    return "; ".join(notes)
