"""What round-off alone may leave of a residual."""

from __future__ import annotations

import numpy as np

from lyra_petsc.stepping.system import ReducedSystem


def residual_roundoff(system: ReducedSystem, size: float) -> float:
    """Norm [N] that round-off may give the residual: 10 ε of the internal force scale; collective.

    ``size`` [m] is the largest coordinate: differences of such numbers make the strains.
    """
    points = system.points
    scale = np.zeros(points.n_local)
    for term in system.elastic:
        amount = np.repeat(term.force_scale(size), term.stencil.shape[1])
        scale += np.bincount(term.stencil.ravel(), amount, points.n_local)
    square = float(np.sum(scale[: points.n_owned] ** 2))
    return 10.0 * float(np.finfo(float).eps) * float(np.sqrt(points.comm.allreduce(square)))
