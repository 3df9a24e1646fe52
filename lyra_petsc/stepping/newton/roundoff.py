"""Estimates of the round-off of a residual."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.newton.conditioning import vertex_scales
from lyra_petsc.stepping.stage_equations import StageEquations

ROUNDOFF = 10.0 * float(np.finfo(np.float64).eps)
"""Relative round-off of an internal force that is computed from differences of coordinates."""


def residual_roundoff(system: StageEquations, size: float) -> float:
    """Norm [N] of the residual's round-off: 10 ε times the scale of internal forces; collective.

    ``size`` [m] is the largest coordinate; strains are differences of such numbers.
    """
    return _norm(system, vertex_scales(system, size))


def limit_roundoff(system: StageEquations) -> float:
    """The same for terms that limit steps, at the positions last evaluated: their stiffness grows without
    bound; collective.
    """
    points, x = system.points, system.evaluated.x
    scale, size = np.zeros(points.n_local), points.global_max(float(np.abs(x).max(initial=0.0)))[0]
    contact = [] if system.contact is None else [system.contact.barrier]
    for term in (*contact, *system.active.limiting):
        amount = term.stiffness(x, system.step.frozen[term]) * term.coordinate_scale(size)
        scale += np.bincount(term.stencil.ravel(), np.repeat(amount, term.stencil.shape[1]), points.n_local)
    return _norm(system, scale[: points.n_owned])


def _norm(system: StageEquations, scale: Array) -> float:
    """Norm [N] of the round-off for scales (n_owned,) [N] of the forces on owned rows; collective."""
    return ROUNDOFF * float(np.sqrt(system.points.comm.allreduce(float(np.sum(scale**2)))))
