"""A term of the tests with one unknown on every interior edge: a hinge of two springs in series.

Per interior edge with the dihedral angle θ and the unknown φ: energy = ½ k₁ (φ − θ)² + ½ k₂ φ². In
equilibrium it is a hinge of k₁ k₂/(k₁ + k₂), which here is the one of ``terms.bending``. φ is stored times
the rest length of the edge, as all unknowns are lengths.
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.element import kernel
from lyra_petsc.kernels.vector3 import point
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.bending import hinge
from lyra_petsc.terms.bending.dihedral_angle import add_angle_hessian, angle, angle_gradients
from lyra_petsc.terms.registry import REGISTRY, Registration, Role
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Elastic

FIRST, SECOND = 3.0, 1.5
"""k₁ and k₂ over the stiffness of the hinge: 1/3 + 1/1.5 = 1."""


@kernel()
def angles(x, s, theta, slopes):  # type: ignore[no-untyped-def]
    """Dihedral angles (E,) and their gradients (E, 4, 3)."""
    for e in range(s.shape[0]):
        x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(x, s[e, 3])
        theta[e] = angle(x0, x1, x2, x3)[0]
        gradient = angle_gradients(x0, x1, x2, x3)[0]
        for a in range(4):
            slopes[e, a, 0], slopes[e, a, 1], slopes[e, a, 2] = gradient[a]


@kernel()
def bent(x, s, scale, out):  # type: ignore[no-untyped-def]
    """scale (E,) times the Hessians of the angles, into out (E, 4, 4, 3, 3)."""
    out[:] = 0.0
    for e in range(s.shape[0]):
        x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(x, s[e, 3])
        add_angle_hessian(x0, x1, x2, x3, scale[e], out[e])


class EdgeAngle(Elastic):
    """Parameters: elements with stencil (E, 4), edges (E, 1); data ``k``, ``length``, ``height`` (E,)."""

    def _shape(self, x: Array) -> tuple[Array, Array, Array]:
        """θ and φ (E,), and ∇θ (E, 4, 3)."""
        theta, slopes = np.empty(self.n_elements), np.empty((self.n_elements, 4, 3))
        angles(x, self.stencil, theta, slopes)
        assert self.edges is not None
        return theta, x.ravel()[self.edges[:, 0]] / self.elements.data["length"], slopes

    def energies(self, x: Array, frozen: None) -> Array:
        theta, phi, _ = self._shape(x)
        energy: Array = 0.5 * self.elements.data["k"] * (FIRST * (phi - theta) ** 2 + SECOND * phi**2)
        return energy[: self.n_owned]

    def add_gradient(self, x: Array, frozen: None, out: Array) -> None:
        theta, phi, slopes = self._shape(x)
        k, length = self.elements.data["k"], self.elements.data["length"]
        np.add.at(out, self.stencil, (-k * FIRST * (phi - theta))[:, None, None] * slopes)
        assert self.edges is not None
        np.add.at(out.ravel(), self.edges[:, 0], k * (FIRST * (phi - theta) + SECOND * phi) / length)

    def hessians(self, x: Array, frozen: None, lo: int, hi: int, blend: float, out: Array) -> None:
        theta, phi, slopes = (part[lo:hi] for part in self._shape(x))
        k, length = self.elements.data["k"][lo:hi], self.elements.data["length"][lo:hi]
        n, flat = hi - lo, slopes.reshape(-1, 12)
        curved = np.empty((n, 4, 4, 3, 3))
        bent(x, self.stencil[lo:hi], -(1.0 - blend) * k * FIRST * (phi - theta), curved)
        out[:, :12, :12] = curved.transpose(0, 1, 3, 2, 4).reshape(n, 12, 12)
        out[:, :12, :12] += (FIRST * k)[:, None, None] * flat[:, :, None] * flat[:, None, :]
        out[:, :12, 12] = out[:, 12, :12] = -(FIRST * k / length)[:, None] * flat
        out[:, 12, 12] = (FIRST + SECOND) * k / length**2

    def force_scale(self, size: float) -> Array:
        return (FIRST + SECOND) * self.elements.data["k"] * size / self.elements.data["height"] ** 2


def elements(rest: RestShape) -> Elements:
    """The hinges of ``terms.bending``, each with the number of its edge among all edges."""
    hinges = hinge.elements(rest)
    ends, n = np.sort(hinges.stencil[:, :2], axis=1), rest.mesh.n_vertices
    number = np.searchsorted(rest.edges[:, 0] * n + rest.edges[:, 1], ends[:, 0] * n + ends[:, 1])
    data = {
        "k": 2.0 * hinges.data["k"],
        "length": hinges.data["length"],
        "height": hinges.data["rest_height"],
    }
    return Elements(hinges.stencil, data, edges=number[:, None])


def make(elements: Elements, scene: Scene, mass: Array) -> EdgeAngle:
    return EdgeAngle(elements)


EDGE_ANGLE = Registration(
    "edge-angle", lambda scene, shells: True, Role.ELASTIC, "angle_energy", bends=True, module_name=__name__
)

IN_PLACE_OF_HINGES = [entry for entry in REGISTRY if entry.name != "bending"] + [EDGE_ANGLE]
"""All terms except plain hinges."""
