"""Ratio of stiffness to inertia in a step, and the linear iterations to expect from it."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.stage_equations import StageEquations


def vertex_scales(equations: StageEquations, size: float) -> Array:
    """Force [N] at each owned row (n_owned,) if all coordinates changed by ``size`` [m] at random."""
    points = equations.points
    scale = np.zeros(points.n_local)
    for term in equations.active.elastic:
        amount = np.repeat(term.force_scale(size), term.stencil.shape[1])
        scale += np.bincount(term.stencil.ravel(), amount, points.n_local)
        if term.edges is not None:
            of_edges = np.repeat(term.force_scale(size), term.edges.shape[1])
            scale += np.bincount(term.edges.ravel() // 3, of_edges, points.n_local)
    return scale[: points.n_owned]


def expected_iterations(equations: StageEquations, dt: float) -> float:
    """Iterations of conjugate gradients with block Jacobi in a step of length dt [s]; collective.

    It is half the root of the largest ratio of stiffness to inertia: after scaling with the diagonal the
    spectrum reaches from the inertia to the stiffness.
    """
    n = equations.points.n_vertices
    ratio = dt * dt * vertex_scales(equations, 1.0)[:n] / equations.mass[:n]
    return 0.5 * float(np.sqrt(equations.points.comm.allreduce(float(ratio.max(initial=0.0)), MPI.MAX)))
