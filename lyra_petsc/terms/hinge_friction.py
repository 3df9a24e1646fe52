"""Dry friction in bending, at hinges: a fabric's hysteresis and lasting folds, see ``coulomb``.

Of a hinge with rest edge length l and rest areas A0 and A1 the moment is limited to M = M_f l, and it slides
from the angle κ_y (A0 + A1)/l on, that of a sheet bent to the curvature `GIVE`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms import bending
from lyra_petsc.terms.bending import Bending, Bent, edge_in_material
from lyra_petsc.terms.coulomb import Friction
from lyra_petsc.terms.rest import RestShape

Array = NDArray[np.float64]

GIVE = 2.0
"""κ_y [1/m]: change of curvature at which friction is at its limit."""


class HingeFriction(Bending):
    """Friction of all hinges.

    Parameters
    ----------
    elements : Elements
        As of `Bending`, with k [N·m] while nothing slides, and data ``friction`` (E,) [N·m], M.

    Attributes
    ----------
    bent : (E,)
        θ_p, the angles [rad] to which hinges have slid.
    """

    def __init__(self, elements: Elements) -> None:
        super().__init__(elements)
        limit = elements.data["friction"]
        self._friction = Friction(limit, 0.5 * limit / elements.data["k"])
        self.bent: Array = elements.data["rest_angle"].copy()

    def law(self, angles: Array) -> tuple[Array, Array]:
        k, change = self._friction.parabola(angles - self.bent)
        return k, angles - change

    def law_of_hessian(self, bent: Bent, blend: float) -> tuple[Array, Array]:
        angles, size = bent.angles, bent.triangles[:, 6]
        k, change = self._friction.tangent(angles - self.bent, blend)
        fades = (size[self._triangles.sides[:-1] >> 2] == 0.0).any(axis=1)
        if fades.any():  # whose blocks need the energy, too
            plain, way = self._friction.parabola(angles - self.bent)
            k, change = np.where(fades, plain, k), np.where(fades, way, change)
        return k, angles - change

    # -- state -------------------------------------------------------------------------------------

    def begin(self, x: Array) -> None:
        self.accept(x)

    def accept(self, x: Array, frozen: None = None) -> None:
        self.bent = self.bent + self._friction.slid(self.angles(x) - self.bent)

    def heat(self, x: Array, frozen: None = None) -> float:
        slid = np.abs(self._friction.slid(self.angles(x) - self.bent))[: self.n_owned]
        if not slid.any():
            return 0.0
        return float(np.sum(self._friction.limit[: self.n_owned] * slid * self.weights(x)[: self.n_owned]))

    def element_values(self) -> Array:
        return self.bent[:, None]

    def restore_values(self, values: Array) -> None:
        self.bent = values[:, 0].copy()


def elements(rest: RestShape, model: str = "hinge") -> Elements:
    """The hinges between triangles with friction, of materials of a bending model (rank 0)."""
    quad, faces = rest.hinges.vertices, rest.hinges.triangles
    moments = np.array([shell.friction_moment for shell in rest.shells])
    limit, bends = np.full(len(quad), np.inf), np.ones(len(quad), dtype=bool)
    for side in range(2):
        edge, stiffness = edge_in_material(rest, faces[:, side], quad[:, 0], quad[:, 1], model)
        across = edge[:, ::-1] ** 2 / np.sum(edge * edge, axis=1, keepdims=True)
        limit = np.minimum(limit, np.sum(across * moments[rest.shell_of[faces[:, side]]], axis=1))
        bends &= stiffness > 0.0
    found, limit = bending.elements(rest, model), limit[bends]
    rubs, data = limit > 0.0, dict(found.data)
    data["friction"] = limit * data["length"]
    data["k"] = data["friction"] / (GIVE * data["rest_height"])
    return Elements(found.stencil[rubs], {name: values[rubs] for name, values in data.items()})


def make(elements: Elements, scene: Scene, mass: Array) -> HingeFriction:
    """The term on one rank."""
    return HingeFriction(elements)
