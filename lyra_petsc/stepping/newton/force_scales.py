"""Scales of internal forces: the round-off of residuals, and the linear iterations to expect."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.points import Layout
from lyra_petsc.stepping.forces import StageForces
from lyra_petsc.stepping.time_step import Evaluation
from lyra_petsc.terms.protocols import HoldsTogether, LimitsStep
from lyra_petsc.terms.term import Elastic

ROUNDOFF = 10.0 * float(np.finfo(np.float64).eps)
"""Relative round-off of an internal force that is computed from differences of coordinates, and of a sum."""


def vertex_scales(points: Layout, terms: Iterable[Elastic], size: float) -> Array:
    """Force [N] of terms at each owned row (n_owned,) if coordinates changed by ``size`` [m] at random."""
    scale = np.zeros(points.n_local)
    for term in terms:
        amount = np.repeat(term.force_scale(size), term.stencil.shape[1])
        scale += np.bincount(term.stencil.ravel(), amount, points.n_local)
        if term.edges is not None:
            of_edges = np.repeat(term.force_scale(size), term.edges.shape[1])
            scale += np.bincount(term.edges.ravel() // 3, of_edges, points.n_local)
    return scale[: points.n_owned]


def expected_iterations(forces: StageForces, dt: float) -> float:
    """Iterations of conjugate gradients with block Jacobi in a step of length dt [s]; collective.

    It is half the root of the largest ratio of stiffness to inertia: after scaling with the diagonal the
    spectrum reaches from the inertia to the stiffness. What holds parts together does not count: it is no
    reason against multigrid, which knows it.
    """
    n = forces.layout.n_vertices
    terms = [term for term in forces.active.elastic if not isinstance(term, HoldsTogether)]
    ratio = dt * dt * vertex_scales(forces.layout, terms, 1.0)[:n] / forces.mass[:n]
    return 0.5 * float(np.sqrt(forces.layout.global_max(float(ratio.max(initial=0.0)))[0]))


def residual_roundoff(forces: StageForces, size: float) -> float:
    """Norm [N] of the residual's round-off: 10 ε times the scale of internal forces; collective.

    ``size`` [m] is the largest coordinate; strains are differences of such numbers.
    """
    return _norm(forces.layout, vertex_scales(forces.layout, forces.active.elastic, size))


def limit_roundoff(at: Evaluation) -> float:
    """The same for terms that limit steps, whose stiffness grows without bound; collective."""
    layout, x = at.forces.layout, at.x
    scale, size = np.zeros(layout.n_local), layout.global_max(float(np.abs(x).max(initial=0.0)))[0]
    for term in at.forces.active.elastic:
        if isinstance(term, LimitsStep):
            amount = np.repeat(
                term.stiffness(x, at.frozen[term]) * term.coordinate_scale(size), term.stencil.shape[1]
            )
            scale += np.bincount(term.stencil.ravel(), amount, layout.n_local)
    return _norm(layout, scale[: layout.n_owned])


def _norm(layout: Layout, scale: Array) -> float:
    """Norm [N] of the round-off for scales (n_owned,) [N] of the forces on owned rows; collective."""
    return ROUNDOFF * float(np.sqrt(layout.global_sum(float(np.sum(scale**2)))[0]))
