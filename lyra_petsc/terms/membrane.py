"""Membrane: St. Venant-Kirchhoff energy of the constant-strain triangle.

Per triangle of rest area A, with F = ∂x/∂u (3×2) and the Green strain E = (FᵀF − I)/2::

    energy = A/2 (c11 E_uu² + 2 c12 E_uu E_vv + c22 E_vv² + c33 (2 E_uv)²)

Source: the Lyra paper, eq. 2-3; Bonet and Wood, Nonlinear Continuum Mechanics for FEA, ch. 8. Predicted
stress in the Hessian: Magisano, Leonetti & Garcea, Comput. Meth. Appl. Mech. Engng 313 (2017) 986-1005.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.block_rows.scatter import fetch_ahead
from lyra_petsc.block_rows.vectors import add_triangle
from lyra_petsc.kernel_cache import Index
from lyra_petsc.partition.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.kernel import kernel
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Elastic, Offsets

Array = NDArray[np.float64]
Stencil = NDArray[np.int32]


@kernel(inline="always")
def _deformation(x, s, e, inverse):  # type: ignore[no-untyped-def]
    """Columns fu, fv of the deformation gradient of triangle e."""
    a, b, c = Index(s[e, 0]), Index(s[e, 1]), Index(s[e, 2])
    px, py, pz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
    qx, qy, qz = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
    i00, i01, i10, i11 = inverse[e, 0, 0], inverse[e, 0, 1], inverse[e, 1, 0], inverse[e, 1, 1]
    return (
        px * i00 + qx * i10, py * i00 + qy * i10, pz * i00 + qz * i10,
        px * i01 + qx * i11, py * i01 + qy * i11, pz * i01 + qz * i11,
    )  # fmt: skip


@kernel(inline="always")
def _green_and_stress(f, c, m):  # type: ignore[no-untyped-def]
    """Green strain (E_uu, E_vv, 2 E_uv) and second Piola-Kirchhoff stress (S_uu, S_vv, S_uv) [N/m]."""
    ux, uy, uz, vx, vy, vz = f
    e0 = 0.5 * (ux * ux + uy * uy + uz * uz - 1.0)
    e1 = 0.5 * (vx * vx + vy * vy + vz * vz - 1.0)
    e2 = ux * vx + uy * vy + uz * vz
    c11, c12, c22, c33 = c[m, 0], c[m, 1], c[m, 2], c[m, 3]
    return e0, e1, e2, c11 * e0 + c12 * e1, c12 * e0 + c22 * e1, c33 * e2


@kernel()
def energies(x, s, lo, hi, inverse, area, c, law, out):  # type: ignore[no-untyped-def]
    """Energy [J] of triangles lo..hi into out (hi − lo,)."""
    for e in range(lo, hi):
        e0, e1, e2, s0, s1, s2 = _green_and_stress(_deformation(x, s, e, inverse), c, Index(law[e]))
        out[e - lo] = 0.5 * area[e] * (e0 * s0 + e1 * s1 + e2 * s2)


@kernel()
def add_gradient(x, s, inverse, area, c, law, out):  # type: ignore[no-untyped-def]
    """Add the energy's gradient [N] to out (n_local, 3)."""
    for e in range(s.shape[0]):
        f = _deformation(x, s, e, inverse)
        ux, uy, uz, vx, vy, vz = f
        _, _, _, s0, s1, s2 = _green_and_stress(f, c, Index(law[e]))
        # columns of the first Piola-Kirchhoff stress P = F S, times the area
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


@kernel(inline="always")
def _tensile(e0, e1, c11, c12, c22):  # type: ignore[no-untyped-def]
    """Stress (S_uu, S_vv) that extension along the material axes alone makes, none of it compressive.

    The original Lyra's choice: its geometric stiffness has these two and leaves shear out.
    """
    t0, t1 = max(e0, 0.0), max(e1, 0.0)
    return max(c11 * t0 + c12 * t1, 0.0), max(c12 * t0 + c22 * t1, 0.0)


@kernel(inline="always")
def _linearised(f, g, c, m):  # type: ignore[no-untyped-def]
    """Strains and stress as in `_green_and_stress`, linear in the way from deformation gradient g to f."""
    ux, uy, uz, vx, vy, vz = f
    ax, ay, az, bx, by, bz = g
    px, py, pz, qx, qy, qz = ux - ax, uy - ay, uz - az, vx - bx, vy - by, vz - bz
    e0, e1, e2, _, _, _ = _green_and_stress(f, c, m)
    e0 -= 0.5 * (px * px + py * py + pz * pz)
    e1 -= 0.5 * (qx * qx + qy * qy + qz * qz)
    e2 -= px * qx + py * qy + pz * qz
    c11, c12, c22, c33 = c[m, 0], c[m, 1], c[m, 2], c[m, 3]
    return e0, e1, e2, c11 * e0 + c12 * e1, c12 * e0 + c22 * e1, c33 * e2


@kernel(inline="always")
def _prepared(x, y, s, e, blend, inverse, w, c, m):  # type: ignore[no-untyped-def]
    """What the Hessian of triangle e with law m is made of.

    Deformation gradient; stress and law times w; gradients (∂/∂u, ∂/∂v) of the corners' shape functions.
    """
    f = _deformation(x, s, e, inverse)
    e0, e1, _, s0, s1, s2 = _linearised(f, _deformation(y, s, e, inverse), c, m)
    if blend > 0.0:
        p0, p1 = _tensile(e0, e1, c[m, 0], c[m, 1], c[m, 2])
        s0, s1, s2 = s0 + blend * (p0 - s0), s1 + blend * (p1 - s1), s2 - blend * s2
    one, two = (inverse[e, 0, 0], inverse[e, 0, 1]), (inverse[e, 1, 0], inverse[e, 1, 1])
    gradients = (-one[0] - two[0], -one[1] - two[1]), one, two
    return f, (w * s0, w * s1, w * s2), (w * c[m, 0], w * c[m, 1], w * c[m, 2], w * c[m, 3]), gradients


@kernel(inline="always")
def _factors(stress, stiff, ga, gb):  # type: ignore[no-untyped-def]
    """Of block (a, b) = uu fu fuᵀ + uv fu fvᵀ + vu fv fuᵀ + vv fv fvᵀ + geometric I."""
    (au, av), (bu, bv) = ga, gb
    c11, c12, c22, c33 = stiff
    uu, vv = au * bu, av * bv
    uv, vu = au * bv, av * bu
    geometric = stress[0] * uu + stress[1] * vv + stress[2] * (uv + vu)
    return c11 * uu + c33 * vv, c12 * uv + c33 * vu, c12 * vu + c33 * uv, c22 * vv + c33 * uu, geometric


@kernel(inline="always")
def _sides(f, uu, uv, vu, vv):  # type: ignore[no-untyped-def]
    """Vectors left and right whose Σ left rightᵀ a block is but for its geometric part."""
    ux, uy, uz, vx, vy, vz = f
    one = uu * ux + uv * vx, uu * uy + uv * vy, uu * uz + uv * vz
    two = vu * ux + vv * vx, vu * uy + vv * vy, vu * uz + vv * vz
    return ((ux, uy, uz), (vx, vy, vz)), (one, two)


@kernel()
def hessians(x, y, s, lo, hi, blend, inverse, area, c, law, out):  # type: ignore[no-untyped-def]
    """Hessian blocks [N/m] of triangles lo..hi into out (hi − lo, 3, 3, 3, 3): [e, a, b, i, j].

    Their geometric part has the stress that the linearised strain predicted at x from y; y = x: exact.
    """
    for e in range(lo, hi):
        f, stress, stiff, g = _prepared(x, y, s, e, blend, inverse, area[e], c, Index(law[e]))
        for a in range(3):
            for b in range(3):
                uu, uv, vu, vv, geometric = _factors(stress, stiff, g[a], g[b])
                left, right = _sides(f, uu, uv, vu, vv)
                for i in range(3):
                    for j in range(3):
                        out[e - lo, a, b, i, j] = left[0][i] * right[0][j] + left[1][i] * right[1][j]
                    out[e - lo, a, b, i, i] += geometric


@kernel()
def add_hessians(x, y, s, blend, inverse, area, c, law, weight, offsets, values):  # type: ignore[no-untyped-def]
    """Add weight (E,) times the blocks of ``hessians`` to the block rows, where ``offsets`` say.

    A translation does nothing, so that three blocks are enough.
    """
    for e in range(s.shape[0]):
        fetch_ahead(e, offsets, values, 6)
        f, stress, stiff, g = _prepared(x, y, s, e, blend, inverse, weight[e] * area[e], c, Index(law[e]))
        one, two = _factors(stress, stiff, g[1], g[1]), _factors(stress, stiff, g[1], g[2])
        three = _factors(stress, stiff, g[2], g[2])
        add_triangle(values, offsets, e, ((f[0], f[1], f[2]), (f[3], f[4], f[5])), (one, two, three))


@kernel()
def strain_and_stress(x, s, inverse, c, law, strain, stress):  # type: ignore[no-untyped-def]
    """Green strain (E_uu, E_vv, E_uv) and second Piola-Kirchhoff stress [N/m] into (E, 3) arrays."""
    for e in range(s.shape[0]):
        e0, e1, e2, s0, s1, s2 = _green_and_stress(_deformation(x, s, e, inverse), c, Index(law[e]))
        strain[e, 0], strain[e, 1], strain[e, 2] = e0, e1, 0.5 * e2
        stress[e, 0], stress[e, 1], stress[e, 2] = s0, s1, s2


class Membrane(Elastic):
    """The membrane energy of all triangles.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 3); data ``inverse`` (E, 2, 2) inverse rest matrix [1/m], ``area`` (E,) [m²],
        ``stiffness`` (E, 4) c11, c12, c22, c33 [N/m], ``damping`` (E,) [s].

    Attributes
    ----------
    laws : (n, 4) [N/m], (E,) int32
        The different stiffnesses, and which of them each triangle has.
    """

    name = "membrane"

    def __init__(self, elements: Elements) -> None:
        data = elements.data
        super().__init__(elements.without("stiffness"))
        self.laws = _distinct(data["stiffness"])
        self._before: Array | None = None
        self._inverse, self._area = data["inverse"], data["area"]

    def energies(self, x: Array) -> Array:
        out = np.empty(self.n_owned)
        energies(x, self.stencil, 0, self.n_owned, self._inverse, self._area, *self.laws, out)
        return out

    def add_gradient(self, x: Array, out: Array) -> None:
        add_gradient(x, self.stencil, self._inverse, self._area, *self.laws, out)

    def linearise_from(self, y: Array | None) -> None:
        self._before = y

    def hessians(self, x: Array, lo: int, hi: int, blend: float, out: Array) -> None:
        y = x if self._before is None else self._before
        hessians(x, y, self.stencil, lo, hi, blend, self._inverse, self._area, *self.laws, out)

    def add_hessians(
        self, x: Array, blend: float, weight: Array, offsets: Mapping[str, Offsets], values: Array
    ) -> bool:
        y = x if self._before is None else self._before
        constants = self._inverse, self._area, *self.laws
        add_hessians(x, y, self.stencil, blend, *constants, weight, offsets[self.name], values)
        return True

    def force_scale(self, size: float) -> Array:
        laws, law = self.laws
        stiffest: Array = np.abs(laws).max(axis=1)[law]
        steepest = np.abs(self._inverse).max(axis=(1, 2))
        scale: Array = stiffest * self._area * steepest**2 * size
        return scale

    def strain_and_stress(self, x: Array) -> tuple[Array, Array]:
        """Green strain (E_uu, E_vv, E_uv) and stress (S_uu, S_vv, S_uv) [N/m], each (E, 3)."""
        strain, stress = np.empty((self.n_elements, 3)), np.empty((self.n_elements, 3))
        strain_and_stress(x, self.stencil, self._inverse, *self.laws, strain, stress)
        return strain, stress


def _distinct(stiffness: Array) -> tuple[Array, NDArray[np.int32]]:
    """The laws (n, 4) of triangles (E, 4), each once, and which of them each triangle has."""
    if len(stiffness) and (stiffness == stiffness[0]).all():
        return stiffness[:1].copy(), np.zeros(len(stiffness), dtype=np.int32)
    laws, law = np.unique(stiffness, axis=0, return_inverse=True)
    return laws, law.astype(np.int32)


def elements(rest: RestShape) -> Elements:
    """All triangles with their constants (rank 0)."""
    stiffness = np.array([[m.c11, m.c12, m.c22, m.c33] for m in rest.shells])
    data = {
        "inverse": rest.inverse,
        "area": rest.area,
        "stiffness": stiffness[rest.shell_of],
        "damping": rest.per_triangle("damping"),
    }
    return Elements(rest.mesh.triangles, data)


def make(elements: Elements, scene: Scene, mass: Array) -> Membrane:
    """The term on one rank."""
    return Membrane(elements)
