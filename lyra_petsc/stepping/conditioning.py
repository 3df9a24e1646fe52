"""How much stiffer than inertia a sheet is in a step, and what conjugate gradients make of it."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.stepping.system import ReducedSystem

Array = NDArray[np.float64]


def vertex_scales(system: ReducedSystem, size: float) -> Array:
    """Force [N] at each owned vertex (n_owned,) if all coordinates changed by ``size`` [m] at random."""
    points = system.points
    scale = np.zeros(points.n_local)
    for term in system.elastic:
        amount = np.repeat(term.force_scale(size), term.stencil.shape[1])
        scale += np.bincount(term.stencil.ravel(), amount, points.n_local)
    return scale[: points.n_owned]


def expected_iterations(system: ReducedSystem, dt: float) -> float:
    """Iterations of conjugate gradients with block Jacobi in a step of length dt [s]; collective.

    Half the root of the largest ratio of stiffness to inertia: what is left of the spectrum after scaling
    by the diagonal reaches from the one to the other.
    """
    ratio = dt * dt * vertex_scales(system, 1.0) / system.mass
    return 0.5 * float(np.sqrt(system.points.comm.allreduce(float(ratio.max(initial=0.0)), MPI.MAX)))
