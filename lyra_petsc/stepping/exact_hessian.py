"""The exact Hessian of an equilibrium, of use in static analyses alone."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.scatter import add_elements
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.load_stiffness import following_stiffness
from lyra_petsc.terms.term import Load, Term, UpcomingStep, Viscous


def add_exact_hessian(system: StageEquations, values: Array) -> None:
    """Add to block rows (n_blocks, 3, 3) the exact Hessian [N/m] of all energies at the state.

    And the symmetric part of the stiffness of loads that follow it; prescribed unknowns are decoupled.
    """
    rows, active, prescribed = system.discretisation.rows, system.active, system.prescribed
    for term in active.elastic:
        rows.add_stiffness(term, system.x, active.frozen[term], 0.0, 1.0, values)

    def force_of(term: Term, x: Array, out: Array) -> None:
        """Add the force [N] of a load, or of the wind on a sheet at rest, at positions x."""
        if isinstance(term, Load):
            term.add_force(x, system.t0, system.t1, out)
        elif isinstance(term, Viscous):
            against = np.zeros_like(out)
            step = UpcomingStep(system.t0, system.t1, system.t1, x, system.reference.at)
            term.add_gradient(np.zeros_like(x), term.freeze(step), against)
            out -= against

    following: list[Load | Viscous] = [load for load in active.loads if load.follows]
    for load in [*following, *active.viscous]:
        blocks = system.applied.factor * following_stiffness(load, system.x, force_of)
        offsets = rows.pattern.offsets_of(load.stencil)
        add_elements(np.ones(load.n_elements), blocks, offsets, values)
    if len(prescribed.beside.changing):
        rows.constrain(values, prescribed.mask, prescribed.beside)
