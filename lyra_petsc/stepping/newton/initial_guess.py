"""First guess of Newton's method: the velocities of the last step, or none.

The velocities of the last step are right for smooth motions, as users of second-order integrators expect. In
stiff sheets that crumple they stretch the sheet by far more than the step will. The guess with the lower
objective is then taken. An equilibrium starts from the extrapolation of earlier ones, unless parts are near
each other.
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping import motion_limits as limits
from lyra_petsc.stepping.integrators.static import Static
from lyra_petsc.stepping.stage_equations import StageEquations


def first_guess(equations: StageEquations, start: Array, out: Array) -> bool:
    """Write velocities of the stage to ``out`` (n_owned, 3), prescribed unknowns exactly; collective.

    ``start`` (n_owned, 3) can be reached from the positions at the start of the step without a collision.

    Returns whether they are extrapolated from earlier equilibria.
    """
    n, integrator = equations.points.n_owned, equations.integrator
    if integrator.starts_at_rest:
        out[:] = start
        if not isinstance(integrator, Static) or integrator.predicted is None:
            return False
        guess = integrator.predicted / integrator.pseudo_dt
        equations.prescribe(guess)
        if equations.near or not limits.moves_freely(equations, out, guess - out):
            return False
        out[:] = guess
        equations.predicted_stress.take_state(equations.x)
        return True
    moving = equations.v[:n].copy()
    equations.prescribe(moving)
    still = start
    if limits.limits_steps(equations):
        fraction = limits.largest_step(equations, still, moving - still)
        moving = moving if fraction == 1.0 else still + fraction * (moving - still)
    if integrator.order > 1 and equations.acting_contact is None and not equations.active.limiting:
        out[:] = moving
        return False
    energies = [equations.evaluate(v).objective[0] for v in (still, moving)]
    use_still = energies[0] < energies[1]
    out[:] = still if use_still else moving
    return False


def has_start(equations: StageEquations, start: Array) -> bool:
    """Whether the first guess of a solve is within the limits of all terms; collective."""
    if not (
        equations.active.limiting and equations.integrator.iterates
    ):  # one linear solve starts from the state
        return True
    guess = np.empty_like(start)
    first_guess(equations, start, guess)
    return limits.are_kept(equations, equations.evaluate(guess).x)
