"""First guess of Newton's method: the velocities of the last step, or none.

The velocities of the last step are right for smooth motions, as users of second-order integrators expect. In
stiff sheets that crumple they stretch the sheet by far more than the step will. The guess with the lower
objective is then taken. An equilibrium starts from the extrapolation of earlier ones, unless parts are near
each other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping import motion_limits as limits
from lyra_petsc.stepping.integrators.static import Static
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.time_step import Evaluation


class FirstGuess(NamedTuple):
    """How the first guess was found.

    Attributes
    ----------
    extrapolated : bool
        Whether it is extrapolated from earlier equilibria.
    point : Evaluation or None
        The stage there, if it was evaluated.
    """

    extrapolated: bool = False
    point: Evaluation | None = None


def first_guess(equations: StageEquations, start: Array, out: Array) -> FirstGuess:
    """Write velocities of the stage to ``out`` (n_owned, 3), prescribed unknowns exactly; collective.

    ``start`` (n_owned, 3) can be reached from the positions at the start of the step without a collision.
    """
    n, integrator = equations.points.n_owned, equations.integrator
    if integrator.starts_at_rest:
        out[:] = start
        if not isinstance(integrator, Static) or integrator.predicted is None:
            return FirstGuess()
        guess = integrator.predicted / integrator.pseudo_dt
        equations.prescribe(guess)
        if equations.near or not limits.moves_freely(equations, out, guess - out):
            return FirstGuess()
        out[:] = guess
        equations.predicted_stress.take_state(equations.x)
        return FirstGuess(extrapolated=True)
    moving = equations.v[:n].copy()
    equations.prescribe(moving)
    still = start
    if limits.limits_steps(equations):
        fraction = limits.largest_step(equations, still, moving - still)
        moving = moving if fraction == 1.0 else still + fraction * (moving - still)
    if integrator.order > 1 and equations.acting_contact is None and not equations.active.limiting:
        out[:] = moving
        return FirstGuess()
    points = [equations.evaluate(v) for v in (still, moving)]
    use_still = points[0].objective[0] < points[1].objective[0]
    out[:] = still if use_still else moving
    return FirstGuess(point=points[0 if use_still else 1])


def has_start(equations: StageEquations, start: Array) -> bool:
    """Whether the first guess of a solve is within the limits of all terms; collective."""
    if not (
        equations.active.limiting and equations.integrator.iterates
    ):  # one linear solve starts from the state
        return True
    guess = np.empty_like(start)
    first_guess(equations, start, guess)
    return limits.are_kept(equations, equations.evaluate(guess).x)
