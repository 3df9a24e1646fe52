"""Estimates of the round-off of a residual."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.newton.conditioning import vertex_scales
from lyra_petsc.stepping.stage_equations import StageEquations

ROUNDOFF = 10.0 * float(np.finfo(np.float64).eps)
"""Relative round-off of an internal force that is computed from differences of coordinates."""


def residual_roundoff(equations: StageEquations, size: float) -> float:
    """Norm [N] of the residual's round-off: 10 ε times the scale of internal forces; collective.

    ``size`` [m] is the largest coordinate; strains are differences of such numbers.
    """
    return _norm(equations, vertex_scales(equations, size))


def limit_roundoff(equations: StageEquations) -> float:
    """The same for terms that limit steps, at the positions last evaluated: their stiffness grows without
    bound; collective.
    """
    points, x = equations.points, equations.evaluated.x
    scale, size = np.zeros(points.n_local), points.global_max(float(np.abs(x).max(initial=0.0)))[0]
    contact = [] if equations.contact is None else [equations.contact.barrier]
    for term in (*contact, *equations.active.limiting):
        amount = term.stiffness(x, equations.step.frozen[term]) * term.coordinate_scale(size)
        scale += np.bincount(term.stencil.ravel(), np.repeat(amount, term.stencil.shape[1]), points.n_local)
    return _norm(equations, scale[: points.n_owned])


def _norm(equations: StageEquations, scale: Array) -> float:
    """Norm [N] of the round-off for scales (n_owned,) [N] of the forces on owned rows; collective."""
    return ROUNDOFF * float(np.sqrt(equations.points.comm.allreduce(float(np.sum(scale**2)))))
