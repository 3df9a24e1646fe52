"""Plastic bending with directors on edges: what a triangle does beyond its yield curvature.

A material with the hardening h bends elastically with the stiffness h D (``midedge``), beside which act
elements of the stiffness (1 − h) D with a bounded moment, those of ``midedge_friction``, in the norm of their
energy::

    |u|² = uᵀ D u / D_s,   u = κ − κ_p,   yield at |u| = κ_y

with the stiffness D_s = 1 / (D⁻¹)_11 of a strip along the warp with free edges, which so yields at κ_y. An
isotropic strip does in every direction, a wide sheet (κ22 = 0) at κ_y √(1 − ν²). In an orthotropic sheet all
directions yield at the same energy. The norm being that of the energy, the return to the yield surface is
radial and keeps the direction of moments. The curvature that remains without moments is (1 − h) κ_p.

Sources: J. C. Simo, T. J. R. Hughes, Computational Inelasticity, Springer 1998, ch. 1 to 3; kinematic
hardening as an elastic element beside a perfectly plastic one: J. F. Besseling, Journal of Applied Mechanics
25 (1958) 529-536.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.bending.hinge import whole_hinges
from lyra_petsc.terms.bending.hinge_plasticity import yielding
from lyra_petsc.terms.bending.midedge_friction import MidEdgeFriction, sliding_elements
from lyra_petsc.terms.bending.midedge_geometry import areas, curvatures_of_tangents
from lyra_petsc.terms.rest import RestShape


class MidEdgePlasticity(MidEdgeFriction):
    """The triangles that may yield.

    Parameters
    ----------
    elements : Elements
        As of `MidEdgeFriction`; data ``slid_share`` (E,) fraction of the stiffness that yields, ``damping``
        and ``material`` as of `MidEdge`.
    """

    @property
    def areas(self) -> Array:
        """Rest areas of the triangles, (E,) [m²]."""
        return areas(self.elements.data["material"])

    @property
    def plastic_curvatures(self) -> Array:
        """κ11, κ22, 2 κ12 (E, 3) [1/m], less those of rest, that remain where no moments act."""
        data = self.elements.data
        of_tangents = curvatures_of_tangents(data["material"])
        slid = data["slid_share"][:, None] * (self.bent - data["rest"])
        return np.asarray(np.einsum("eki,ei->ek", of_tangents, slid))


def elements(rest: RestShape) -> Elements:
    """The triangles that bend by this model and yield (rank 0)."""
    stiffness, limit = np.zeros((len(rest.shells), 3, 3)), np.zeros(len(rest.shells))
    for number, shell in enumerate(rest.shells):
        if shell.bends_with("midedge") and np.isfinite(shell.yield_curvature):
            share = 1.0 - shell.elastic_share
            stiffness[number] = share * np.array(shell.plate_matrix)
            limit[number] = share * shell.strip_stiffness * shell.yield_curvature**2
    triangles = sliding_elements(rest, stiffness, limit, "damping", "material")
    shares = 1.0 - rest.per_triangle("elastic_share")[triangles.data["triangle"].astype(np.int64)]
    return replace(triangles, data={**triangles.data, "slid_share": shares})


def coarse_elements(rest: RestShape) -> Elements:
    """Hinges between the same triangles, which bend like them before they yield."""
    hinges, triangle = whole_hinges(rest, "midedge")
    return yielding(hinges, triangle, rest, hinges.data["rest_height"])


def make(elements: Elements, scene: Scene, mass: Array) -> MidEdgePlasticity:
    """The term on one rank."""
    return MidEdgePlasticity(elements)
