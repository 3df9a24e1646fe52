"""Membrane: an energy of the Green strain of constant-strain triangles, with a law of ``membrane_laws``.

Per triangle of rest area A, with F = ∂x/∂u (3×2) and the Green strain E = (FᵀF − I)/2::

    energy = A W(E_uu, E_vv, 2 E_uv),   S = ∂W/∂E,   C = ∂²W/∂E²

Source: the Lyra paper, eq. 2-3; Bonet and Wood, Nonlinear Continuum Mechanics for FEA, ch. 8. Predicted
stress in the Hessian: Magisano, Leonetti & Garcea, Comput. Meth. Appl. Mech. Engng 313 (2017) 986-1005.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from itertools import zip_longest
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import inlined, kernel
from lyra_petsc.kernels.scatter import fetch_ahead
from lyra_petsc.kernels.vectors import add_triangle
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.materials.library import ShellMaterial, resolve_material
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.membrane_laws import law_of
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Assembly, Elastic

Stencil = NDArray[np.int32]


@inlined()
def _deformation(x, s, e, inverse):  # type: ignore[no-untyped-def]
    """Columns fu and fv of the deformation gradient of triangle e, six numbers."""
    a, b, c = Index(s[e, 0]), Index(s[e, 1]), Index(s[e, 2])
    px, py, pz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
    qx, qy, qz = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
    i00, i01, i10, i11 = inverse[e, 0, 0], inverse[e, 0, 1], inverse[e, 1, 0], inverse[e, 1, 1]
    return (
        px * i00 + qx * i10, py * i00 + qy * i10, pz * i00 + qz * i10,
        px * i01 + qx * i11, py * i01 + qy * i11, pz * i01 + qz * i11,
    )  # fmt: skip


@inlined()
def _green(f):  # type: ignore[no-untyped-def]
    """Green strain (E_uu, E_vv, 2 E_uv) of a deformation gradient."""
    ux, uy, uz, vx, vy, vz = f
    return (
        0.5 * (ux * ux + uy * uy + uz * uz - 1.0),
        0.5 * (vx * vx + vy * vy + vz * vz - 1.0),
        ux * vx + uy * vy + uz * vz,
    )


@inlined()
def _linearised_green(f, g):  # type: ignore[no-untyped-def]
    """Green strain of deformation gradient f, linearised at g: without the terms quadratic in f − g."""
    ux, uy, uz, vx, vy, vz = f
    ax, ay, az, bx, by, bz = g
    px, py, pz, qx, qy, qz = ux - ax, uy - ay, uz - az, vx - bx, vy - by, vz - bz
    e0, e1, e2 = _green(f)
    e0 -= 0.5 * (px * px + py * py + pz * pz)
    e1 -= 0.5 * (qx * qx + qy * qy + qz * qz)
    e2 -= px * qx + py * qy + pz * qz
    return e0, e1, e2


@inlined()
def _factors(s, c, ga, gb):  # type: ignore[no-untyped-def]
    """Factors (uu, uv, vu, vv, geometric) of a Hessian block of two vertices with gradients ga and gb.

    The block is uu fu fuᵀ + uv fu fvᵀ + vu fv fuᵀ + vv fv fvᵀ + geometric I.
    """
    (au, av), (bu, bv) = ga, gb
    c11, c12, c22, c33, c13, c23 = c
    uu, vv = au * bu, av * bv
    uv, vu = au * bv, av * bu
    geometric = s[0] * uu + s[1] * vv + s[2] * (uv + vu)
    mixed = c13 * uu + c23 * vv
    return (
        c11 * uu + c33 * vv + c13 * (uv + vu),
        c12 * uv + c33 * vu + mixed,
        c12 * vu + c33 * uv + mixed,
        c22 * vv + c33 * uu + c23 * (uv + vu),
        geometric,
    )


class Kernels(NamedTuple):
    """The compiled functions of a membrane law."""

    energies: Callable[..., None]
    add_gradient: Callable[..., None]
    add_hessian: Callable[..., None]
    strain_and_stress: Callable[..., None]


@cache
def kernels_of(law: str) -> Kernels:
    """The kernels of a law, compiled at their first call."""
    module = law_of(law)
    density, stress, tangent = module.energy, module.stress, module.tangent

    @kernel()
    def energies(x, s, lo, hi, inverse, area, c, law, out):  # type: ignore[no-untyped-def]
        """Write the energy [J] of triangles lo..hi into out (hi − lo,)."""
        for e in range(lo, hi):
            e0, e1, e2 = _green(_deformation(x, s, e, inverse))
            out[e - lo] = area[e] * density(e0, e1, e2, c, Index(law[e]))

    @kernel()
    def add_gradient(x, s, inverse, area, c, law, out):  # type: ignore[no-untyped-def]
        """Add the energy's gradient [N] to out (n_local, 3)."""
        for e in range(s.shape[0]):
            f = _deformation(x, s, e, inverse)
            ux, uy, uz, vx, vy, vz = f
            e0, e1, e2 = _green(f)
            s0, s1, s2 = stress(e0, e1, e2, c, Index(law[e]))
            # columns of the first Piola-Kirchhoff stress P = F S times the area
            w = area[e]
            pux, puy, puz = w * (ux * s0 + vx * s2), w * (uy * s0 + vy * s2), w * (uz * s0 + vz * s2)
            pvx, pvy, pvz = w * (ux * s2 + vx * s1), w * (uy * s2 + vy * s1), w * (uz * s2 + vz * s1)
            i00, i01, i10, i11 = inverse[e, 0, 0], inverse[e, 0, 1], inverse[e, 1, 0], inverse[e, 1, 1]
            bx, by, bz = pux * i00 + pvx * i01, puy * i00 + pvy * i01, puz * i00 + pvz * i01
            cx, cy, cz = pux * i10 + pvx * i11, puy * i10 + pvy * i11, puz * i10 + pvz * i11
            ia, ib, ic = Index(s[e, 0]), Index(s[e, 1]), Index(s[e, 2])
            out[ia, 0] -= bx + cx
            out[ia, 1] -= by + cy
            out[ia, 2] -= bz + cz
            out[ib, 0] += bx
            out[ib, 1] += by
            out[ib, 2] += bz
            out[ic, 0] += cx
            out[ic, 1] += cy
            out[ic, 2] += cz

    @kernel()
    def add_hessian(  # type: ignore[no-untyped-def]
        x, y, z, linearised, s, convexity, inverse, area, c, law, weight, offsets, values
    ):
        """Add weight (E,) times the Hessian blocks [N/m] to block rows at ``offsets`` (E, 6).

        The geometric part contains the stress of the strain at z linearised at y, or of that at x if not
        ``linearised``. The regularised Hessian replaces this stress by the tensile part of the stress of
        extensions along the material axes, as the original Lyra. Three blocks are computed; those with the
        first vertex follow from invariance under translation.
        """
        for e in range(s.shape[0]):
            fetch_ahead(e, offsets, values, 6)
            m, w = Index(law[e]), weight[e] * area[e]
            f = _deformation(x, s, e, inverse)
            if linearised:
                e0, e1, e2 = _linearised_green(_deformation(z, s, e, inverse), _deformation(y, s, e, inverse))
            else:
                e0, e1, e2 = _green(f)
            s0, s1, s2 = stress(e0, e1, e2, c, m)
            c11, c12, c22, c33, c13, c23 = tangent(e0, e1, e2, c, m)
            if convexity > 0.0:
                p0, p1, _ = stress(max(e0, 0.0), max(e1, 0.0), 0.0, c, m)
                s0, s1, s2 = (
                    s0 + convexity * (max(p0, 0.0) - s0),
                    s1 + convexity * (max(p1, 0.0) - s1),
                    s2 - convexity * s2,
                )
            t = w * s0, w * s1, w * s2
            stiff = w * c11, w * c12, w * c22, w * c33, w * c13, w * c23
            one, two = (inverse[e, 0, 0], inverse[e, 0, 1]), (inverse[e, 1, 0], inverse[e, 1, 1])
            three = _factors(t, stiff, one, one), _factors(t, stiff, one, two), _factors(t, stiff, two, two)
            add_triangle(values, offsets, e, ((f[0], f[1], f[2]), (f[3], f[4], f[5])), three)

    @kernel()
    def strain_and_stress(x, s, inverse, c, law, strain, out):  # type: ignore[no-untyped-def]
        """Write Green strain (E_uu, E_vv, E_uv) and 2nd Piola-Kirchhoff stress [N/m] into (E, 3) arrays."""
        for e in range(s.shape[0]):
            e0, e1, e2 = _green(_deformation(x, s, e, inverse))
            strain[e, 0], strain[e, 1], strain[e, 2] = e0, e1, 0.5 * e2
            out[e, 0], out[e, 1], out[e, 2] = stress(e0, e1, e2, c, Index(law[e]))

    return Kernels(energies, add_gradient, add_hessian, strain_and_stress)


class Membrane(Elastic):
    """The membrane energy of all triangles.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 3); data ``inverse`` (E, 2, 2) inverse rest matrix [1/m], ``area`` (E,) [m²],
        ``material`` (E,) index of the scene's material, ``damping`` (E,) [s].
    shells : sequence of ShellMaterial
        The scene's materials, all with the same law.

    Attributes
    ----------
    laws : (m, n), (E,) int32
        Parameters of the m materials, and the index of each triangle's material.
    softens : bool
        Whether the law softens under compression.
    """

    def __init__(self, elements: Elements, shells: Sequence[ShellMaterial]) -> None:
        data, law = elements.data, law_of(shells[0].law)
        super().__init__(elements.without("material"))
        rows = list(zip_longest(*map(law.parameters, shells), fillvalue=0.0))
        self.laws = np.ascontiguousarray(np.array(rows).T), data["material"].astype(np.int32)
        self._kernels, self._stiffest, self.softens = kernels_of(shells[0].law), law.stiffest, law.SOFTENS
        self._inverse, self._area = data["inverse"], data["area"]

    def energies(self, x: Array, frozen: Any = None) -> Array:
        out = np.empty(self.n_owned)
        constants = self._inverse, self._area, *self.laws
        self._kernels.energies(x, self.stencil, 0, self.n_owned, *constants, out)
        return out

    def add_gradient(self, x: Array, frozen: Any, out: Array) -> None:
        self._kernels.add_gradient(x, self.stencil, self._inverse, self._area, *self.laws, out)

    def add_hessian(self, x: Array, frozen: Any, into: Assembly) -> None:
        positions, linearised = (x, *(into.predicted or (x, x))), into.predicted is not None
        constants = self._inverse, self._area, *self.laws
        law, to = (into.convexity, *constants), (into.weight, into.offsets[self.name], into.values)
        self._kernels.add_hessian(*positions, linearised, self.stencil, *law, *to)

    def force_scale(self, size: float) -> Array:
        parameters, law = self.laws
        steepest = np.abs(self._inverse).max(axis=(1, 2))
        return self._stiffest(parameters)[law] * self._area * steepest**2 * size

    def strain_and_stress(self, x: Array) -> tuple[Array, Array]:
        """Green strain (E_uu, E_vv, E_uv) and stress (S_uu, S_vv, S_uv) [N/m], each (E, 3)."""
        strain, stress = np.empty((self.n_elements, 3)), np.empty((self.n_elements, 3))
        self._kernels.strain_and_stress(x, self.stencil, self._inverse, *self.laws, strain, stress)
        return strain, stress


def elements(rest: RestShape) -> Elements:
    """All triangles with their constants (rank 0).

    Raises
    ------
    InputError
        If materials have different laws.
    """
    laws = sorted({shell.law for shell in rest.shells})
    if len(laws) > 1:
        raise InputError(
            f"all materials of a scene share one membrane law, not {' and '.join(laws)}; give each the same",
            file=rest.scene.source,
            key=f"material[{next(n for n, s in enumerate(rest.shells) if s.law != rest.shells[0].law)}].law",
        )
    data = {
        "inverse": rest.inverse,
        "area": rest.area,
        "material": rest.shell_of.astype(np.float64),
        "damping": rest.per_triangle("damping"),
    }
    return Elements(rest.mesh.triangles, data)


def make(elements: Elements, scene: Scene, mass: Array) -> Membrane:
    """The term on one rank."""
    return Membrane(elements, [resolve_material(block, file=scene.source)[0] for block in scene.material])
