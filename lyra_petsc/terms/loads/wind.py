"""Wind on each triangle, with the geometry frozen at the start of the step.

With v_rel = wind − mean velocity of the vertices, its component v_n along the unit normal n, its tangential
part v_t, and the rest area A::

    force = ρ A |v_n| v_n n + drag A v_t        one third on each vertex
    potential = ρ A |v_n|³ / 3 + drag A |v_t|² / 2

(as in the original Lyra: rest area and no ½, so that ρ stands for ½ c_d ρ_air). The potential is convex,
hence the implicit force is stable for any wind and step length.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.element import inlined, kernel
from lyra_petsc.kernels.scatter import fetch_ahead
from lyra_petsc.kernels.vector3 import area_normal, dot, scaled
from lyra_petsc.kernels.vectors import add_outers
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.time_curve import TimeCurve, is_curve
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Offsets, UpcomingStep, Viscous


@kernel()
def normals(x, s, out):  # type: ignore[no-untyped-def]
    """Write unit normals of triangles into out (E, 3); 0 for collapsed ones."""
    for e in range(s.shape[0]):
        n = area_normal(x, s, e)
        length = np.sqrt(dot(n, n))
        out[e, 0], out[e, 1], out[e, 2] = scaled(1.0 / length if length > 0.0 else 0.0, n)


@inlined()
def _relative(v, s, e, n, wind):  # type: ignore[no-untyped-def]
    """v_rel and its normal component v_n of triangle e."""
    a, b, c = s[e, 0], s[e, 1], s[e, 2]
    third = 1.0 / 3.0
    rx = wind[0] - third * (v[a, 0] + v[b, 0] + v[c, 0])
    ry = wind[1] - third * (v[a, 1] + v[b, 1] + v[c, 1])
    rz = wind[2] - third * (v[a, 2] + v[b, 2] + v[c, 2])
    return rx, ry, rz, rx * n[e, 0] + ry * n[e, 1] + rz * n[e, 2]


@kernel()
def potentials(v, s, area, n, wind, density, drag, out):  # type: ignore[no-untyped-def]
    """Write the potential [W] of the first len(out) triangles."""
    for e in range(out.shape[0]):
        rx, ry, rz, vn = _relative(v, s, e, n, wind)
        tangential = rx * rx + ry * ry + rz * rz - vn * vn
        out[e] = area[e] * (density * abs(vn) ** 3 / 3.0 + 0.5 * drag * tangential)


@kernel()
def add_gradient(v, s, area, n, wind, density, drag, out):  # type: ignore[no-untyped-def]
    """Subtract the force [N] from out (n_local, 3)."""
    for e in range(s.shape[0]):
        rx, ry, rz, vn = _relative(v, s, e, n, wind)
        w = area[e] / 3.0
        along = w * (density * abs(vn) - drag) * vn
        fx, fy, fz = (
            along * n[e, 0] + w * drag * rx,
            along * n[e, 1] + w * drag * ry,
            along * n[e, 2] + w * drag * rz,
        )
        for k in range(3):
            i = s[e, k]
            out[i, 0] -= fx
            out[i, 1] -= fy
            out[i, 2] -= fz


@inlined()
def _hessian_factors(v, s, e, area, n, wind, density, drag):  # type: ignore[no-untyped-def]
    """Factors of n nᵀ and of the identity in each block of the Hessian of triangle e."""
    _, _, _, vn = _relative(v, s, e, n, wind)
    w = area[e] / 9.0
    return w * (2.0 * density * abs(vn) - drag), w * drag


@kernel()
def add_hessian(v, s, area, n, wind, density, drag, offsets, values):  # type: ignore[no-untyped-def]
    """Add the Hessian blocks [N s/m] to block rows at ``offsets`` (E, 6)."""
    for e in range(s.shape[0]):
        fetch_ahead(e, offsets, values, 6)
        along, across = _hessian_factors(v, s, e, area, n, wind, density, drag)
        right = n[e, 0], n[e, 1], n[e, 2]
        left = along * right[0], along * right[1], along * right[2]
        for pair in range(6):
            add_outers(values, offsets[e, pair], across, ((left, right),))


class Air(NamedTuple):
    """The air in a step, and the sheet's unit normals (E, 3).

    ``velocity`` (3,) [m/s], ``density`` [kg/m³], ``drag`` [kg/(m² s)].
    """

    normals: Array
    velocity: Array
    density: float
    drag: float


class Wind(Viscous):
    """Wind on all triangles.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 3); data ``area`` (E,) [m²].
    velocity : TimeCurve
        (3,) [m/s].
    density, drag : TimeCurve
        [kg/m³], [kg/(m² s)].
    """

    def __init__(self, elements: Elements, velocity: TimeCurve, density: TimeCurve, drag: TimeCurve) -> None:
        super().__init__(elements)
        self._area = elements.data["area"]
        self._velocity, self._density, self._drag = velocity, density, drag
        self.varies = velocity.varies

    def freeze(self, step: UpcomingStep) -> Air:
        out, time = np.empty((self.n_elements, 3)), step.target_time
        normals(step.x, self.stencil, out)
        return Air(out, self._velocity.at(time), float(self._density.at(time)), float(self._drag.at(time)))

    def potentials(self, v: Array, frozen: Air) -> Array:
        out = np.empty(self.n_owned)
        potentials(v, self.stencil, self._area, *frozen, out)
        return out

    def add_gradient(self, v: Array, frozen: Air, out: Array) -> None:
        add_gradient(v, self.stencil, self._area, *frozen, out)

    def add_hessian(self, v: Array, frozen: Air, offsets: Mapping[str, Offsets], values: Array) -> None:
        add_hessian(v, self.stencil, self._area, *frozen, offsets[self.name], values)


def elements(rest: RestShape) -> Elements:
    """All triangles with their rest areas (rank 0)."""
    return Elements(rest.mesh.triangles, {"area": rest.area})


def make(elements: Elements, scene: Scene, mass: Array) -> Wind:
    """The term on one rank; in a static analysis the force of a constant wind grows with the load factor."""
    assert scene.wind is not None
    wind, grows = scene.wind, scene.time.static and not is_curve(scene.wind.velocity)
    law = [TimeCurve.of(value, grows=grows) for value in (wind.density, wind.drag)]
    return Wind(elements, TimeCurve.of(wind.velocity), *law)
