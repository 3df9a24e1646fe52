"""The exact Hessian of an equilibrium, of use in static analyses alone."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.following_loads import FollowingLoads
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.term import Load, UpcomingStep, Viscous


def add_exact_hessian(system: StageEquations, values: Array) -> None:
    """Add to block rows (n_blocks, 3, 3) the exact Hessian [N/m] of all energies at the state.

    And the symmetric part of the stiffness of loads that follow it; prescribed unknowns are decoupled.
    """
    rows, active, prescribed = system.discretisation.rows, system.active, system.prescribed
    for term in active.elastic:
        rows.add_stiffness(term, system.x, active.frozen[term], 0.0, 1.0, values)

    def force_of(term: Load | Viscous, x: Array, out: Array) -> None:
        """Add the force [N] of a load, or of the wind on a sheet at rest, at positions x."""
        if isinstance(term, Load):
            term.add_force(x, system.t0, system.t1, out)
        else:
            against = np.zeros_like(out)
            step = UpcomingStep(system.t0, system.t1, system.t1, x, system.reference.at)
            term.add_gradient(np.zeros_like(x), term.freeze(step), against)
            out -= against

    following = [*active.following, *active.viscous]
    loads = FollowingLoads(following, system.x, force_of, system.applied.factor)
    loads.add_hessian(1.0, rows.pattern, values)
    if len(prescribed.beside.changing):
        rows.constrain(values, prescribed.mask, prescribed.beside)
