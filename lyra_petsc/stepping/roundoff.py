"""What round-off alone may leave of a residual."""

from __future__ import annotations

import numpy as np

from lyra_petsc.stepping.conditioning import vertex_scales
from lyra_petsc.stepping.stage_equations import StageEquations


def residual_roundoff(system: StageEquations, size: float) -> float:
    """Norm [N] that round-off may give the residual: 10 ε of the internal force scale; collective.

    ``size`` [m] is the largest coordinate: differences of such numbers make the strains.
    """
    square = float(np.sum(vertex_scales(system, size) ** 2))
    return 10.0 * float(np.finfo(float).eps) * float(np.sqrt(system.points.comm.allreduce(square)))
