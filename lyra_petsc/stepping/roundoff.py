"""What round-off alone may leave of a residual."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.conditioning import vertex_scales
from lyra_petsc.stepping.stage_equations import StageEquations

ROUNDOFF = 10.0 * float(np.finfo(np.float64).eps)
"""Part of the forces that differences of coordinates would make, were these not small."""


def residual_roundoff(system: StageEquations, size: float) -> float:
    """Norm [N] that round-off may give the residual: 10 ε of the internal force scale; collective.

    ``size`` [m] is the largest coordinate: differences of such numbers make the strains.
    """
    return _norm(system, vertex_scales(system, size))


def roundoff_of_contact(system: StageEquations) -> float:
    """The same of what touches where the equations were last evaluated, which stiffens without bound as it is
    pressed; collective.
    """
    points, (x, _) = system.points, system.evaluated
    scale, size = np.zeros(points.n_local), points.global_max(float(np.abs(x).max(initial=0.0)))[0]
    for term in system.active.limiting:
        amount = term.stiffness(x, system.active.frozen[term]) * term.sizes(size)
        scale += np.bincount(term.stencil.ravel(), np.repeat(amount, term.stencil.shape[1]), points.n_local)
    return _norm(system, scale[: points.n_owned])


def _norm(system: StageEquations, scale: Array) -> float:
    """Of the round-off of forces [N] on owned rows (n_owned,)."""
    return ROUNDOFF * float(np.sqrt(system.points.comm.allreduce(float(np.sum(scale**2)))))
