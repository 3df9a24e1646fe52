"""Dry friction in shear between warp and weft, which gives a fabric's hysteresis; see ``coulomb``.

For each triangle of rest area A with the shear strain γ = 2 E_uv of ``membrane``: A times the energy of
``coulomb``, with the limit F_f [N/m] and the yield strain `YIELD_SHEAR`.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.coulomb import FrictionLimits
from lyra_petsc.terms.protocols import Place, TermState, Yields
from lyra_petsc.terms.rest import RestShape

YIELD_SHEAR = 0.002
"""γ_y: change of shear at which friction reaches its limit."""


class ShearFriction(Yields):
    """Shear friction of all triangles.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 3); data ``shape`` (E, 3, 2) gradients of the corners' barycentric coordinates in material
        axes [1/m], ``area`` (E,) [m²], ``friction`` (E,) F_f [N/m].

    Attributes
    ----------
    sheared : (E,)
        Shear to which the triangles have slid.
    """

    def __init__(self, elements: Elements) -> None:
        super().__init__(elements)
        data = elements.data
        self._shape, area = data["shape"], data["area"]
        self._friction = FrictionLimits(area * data["friction"], np.full(self.n_elements, YIELD_SHEAR))
        self.sheared: Array = np.zeros(self.n_elements)

    def _shear(self, x: Array, rows: slice = slice(None)) -> tuple[Array, Array]:
        """γ (e,) and its gradient (e, 3, 3) [1/m] of some triangles."""
        shape = self._shape[rows]
        f = np.einsum("eci,eck->eik", x[self.stencil[rows]], shape)
        slope = shape[:, :, :1] * f[:, None, :, 1] + shape[:, :, 1:] * f[:, None, :, 0]
        return np.einsum("ei,ei->e", f[:, :, 0], f[:, :, 1]), slope

    def energies(self, x: Array, frozen: Any = None) -> Array:
        k, change = self._friction.parabola(self._shear(x)[0] - self.sheared)
        return (k * change**2)[: self.n_owned]

    def add_gradient(self, x: Array, frozen: Any, out: Array) -> None:
        shear, slope = self._shear(x)
        k, change = self._friction.parabola(shear - self.sheared)
        pull = (2.0 * k * change)[:, None, None] * slope
        for i in range(3):
            out[:, i] += np.bincount(self.stencil.ravel(), pull[:, :, i].ravel(), len(out))

    def hessians(self, x: Array, frozen: Any, lo: int, hi: int, convexity: float, out: Array) -> None:
        rows = slice(lo, hi)
        shear, slope = self._shear(x, rows)
        friction = FrictionLimits(*(values[rows] for values in self._friction))
        k, change = friction.tangent(shear - self.sheared[rows], convexity)
        u, v = self._shape[rows, :, 0], self._shape[rows, :, 1]
        np.einsum("e,eai,ebj->eabij", 2.0 * k, slope, slope, out=out)
        bent = (1.0 - convexity) * 2.0 * k * change
        turned = np.einsum("e,ea,eb->eab", bent, u, v)
        out += (turned + turned.transpose(0, 2, 1))[..., None, None] * np.eye(3)

    def force_scale(self, size: float) -> Array:
        stiffness = self._friction.limit / self._friction.yield_strain
        return stiffness * size * np.sum(self._shape**2, axis=(1, 2))

    def at_limits(self, *, yields: bool) -> ShearFriction:
        other = copy(self)
        other._friction = self._friction.moved(yields=yields)
        return other

    # -- state -------------------------------------------------------------------------------------

    def initialise(self, x: Array) -> None:
        self.accept(x)

    def accept(self, x: Array, frozen: Any = None) -> None:
        self.sheared = self.sheared + self._friction.slid(self._shear(x)[0] - self.sheared)

    def heat(self, x: Array, frozen: Any = None) -> float:
        slid = self._friction.slid(self._shear(x)[0] - self.sheared)
        return float(np.sum((self._friction.limit * np.abs(slid))[: self.n_owned]))

    def state(self) -> dict[str, TermState]:
        return {"sheared": TermState(Place.ELEMENT, self.sheared[:, None])}

    def restore(self, values: Mapping[str, Array], x: Array) -> None:
        self.sheared = values["sheared"][:, 0].copy()


def elements(rest: RestShape) -> Elements:
    """The triangles with friction (rank 0)."""
    friction = rest.per_triangle("friction_force")
    rubs = friction > 0.0
    inverse = rest.inverse[rubs]
    shape = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    data = {"shape": shape, "area": rest.area[rubs], "friction": friction[rubs]}
    return Elements(rest.mesh.triangles[rubs], data)


def make(elements: Elements, scene: Scene, mass: Array) -> ShearFriction:
    """The term on one rank."""
    return ShearFriction(elements)
