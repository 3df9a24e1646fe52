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


def first_guess(system: StageEquations, start: Array, out: Array) -> bool:
    """Write velocities of the stage to ``out`` (n_owned, 3), prescribed unknowns exactly; collective.

    ``start`` (n_owned, 3) can be reached from the positions at the start of the step without a collision.

    Returns whether they are extrapolated from earlier equilibria.
    """
    n, integrator = system.points.n_owned, system.integrator
    if integrator.starts_at_rest:
        out[:] = start
        if not isinstance(integrator, Static) or integrator.predicted is None:
            return False
        guess = integrator.predicted / integrator.pseudo_dt
        system.prescribe(guess)
        if system.near or not limits.moves_freely(system, out, guess - out):
            return False
        out[:] = guess
        system.predicted_stress.take_state(system.x)
        return True
    moving = system.v[:n].copy()
    system.prescribe(moving)
    still = start
    if limits.limits_steps(system):
        fraction = limits.largest_step(system, still, moving - still)
        moving = moving if fraction == 1.0 else still + fraction * (moving - still)
    if integrator.order > 1 and system.contact is None and not system.active.limiting:
        out[:] = moving
        return False
    energies = [system.forces.objective(system.evaluate(each))[0] for each in (still, moving)]
    use_still = energies[0] < energies[1]
    out[:] = still if use_still else moving
    return False


def has_start(system: StageEquations, start: Array) -> bool:
    """Whether the first guess of a solve is within the limits of all terms; collective."""
    if not (system.active.limiting and system.integrator.iterates):  # one linear solve starts from the state
        return True
    guess = np.empty_like(start)
    first_guess(system, start, guess)
    return limits.are_kept(system, system.evaluate(guess).x)
