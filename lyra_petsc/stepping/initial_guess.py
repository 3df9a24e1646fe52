"""Where Newton starts: with the velocities of the last step, or at rest where it stands.

The former is right where the motion is smooth, as those who choose a second-order integrator expect it to be.
In stiff sheets that crumple, going on along the tangents stretches the sheet by far more than the step will,
and staying is nearer; the objective tells. An equilibrium is sought from where those before it lead.
"""

from __future__ import annotations

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.integrators.static import Static
from lyra_petsc.stepping.stage_equations import StageEquations


def first_guess(system: StageEquations, out: Array) -> bool:
    """Velocities of the stage into ``out`` (n_owned, 3), prescribed coordinates exactly; whether they are
    extrapolated from past equilibria; collective.
    """
    n, integrator = system.points.n_owned, system.integrator
    if integrator.starts_at_rest:
        out[:], ahead = 0.0, None
        if isinstance(integrator, Static) and not system.discretisation.limits_motion:
            ahead = integrator.predicted
            if ahead is not None:
                out[:] = ahead / integrator.pseudo_dt
                system.linearise_at_state()
        system.prescribe(out)
        return ahead is not None
    going_on = system.v[:n].copy()
    system.prescribe(going_on)
    if integrator.order > 1 and not system.discretisation.limits_motion:
        out[:] = going_on
        return False
    staying = system.start_velocity()
    if system.discretisation.limits_motion:
        going_on = staying + system.largest_step(staying, going_on - staying) * (going_on - staying)
    less = system.objective(staying)[0] < system.objective(going_on)[0]
    out[:] = staying if less else going_on
    return False
