"""A limit of the stretch in every direction: one-sided barriers on both principal stretches of each triangle.

Per triangle of rest area A with the principal stretches λ₁ ≥ λ₂ (singular values of F = ∂x/∂u, 3 × 2) and the
limit λ_m, barriers begin at λ_0 = (1 + λ_m)/2::

    energy = A k d² (w(s₁) + w(s₂)),   s_i = (λ_i − λ_0)/d,   d = λ_m − λ_0
    w(s) = s³/(1 − s) for 0 < s < 1,   0 for s ≤ 0,   infinite for s ≥ 1

k is the largest stiffness of the material at rest [N/m]. With t = 1 − s the slope is w′ = 1/t² − 3 + 2 t. As
w is convex and nowhere falls, the energy is a convex function of F: its Hessian needs no regularisation.

Sources: the inverse barrier Nocedal & Wright, Numerical Optimization, 2nd ed., ch. 19; Hessians of functions
of singular values B. Smith, F. de Goes & T. Kim, ACM TOG 38 (2019) 3.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.protocols import KEPT_FRACTION, LimitsStep
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.stretch import principal_stretches
from lyra_petsc.terms.term import Assembly

SECANTS = 12
"""Secants by which the fraction of a displacement is found that the bound of a triangle allows."""


class Stretched(NamedTuple):
    """Triangles in which barriers act.

    Attributes
    ----------
    rows : (n,)
        Their numbers.
    along : (n, 3, 2)
        Gradients of the corners' barycentric coordinates along both principal directions [1/m].
    direction : (n, 3, 2)
        Unit vectors of the principal directions in space; zero where the triangle has no extent.
    stretch, part : (n, 2)
        Principal stretches λ, and t = 1 − s, at most 1.
    """

    rows: Ints
    along: Array
    direction: Array
    stretch: Array
    part: Array


class StretchLimit(LimitsStep):
    """The barriers of all triangles of materials with a limit.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 3); data ``inverse`` (E, 2, 2) inverse rest matrix [1/m], ``area`` (E,) [m²], ``limit``
        (E,) λ_m, ``stiffness`` (E,) k [N/m], ``triangle`` (E,) numbers in the mesh.
    """

    def __init__(self, elements: Elements) -> None:
        super().__init__(elements)
        data = elements.data
        self._inverse, self._area, self._limit = data["inverse"], data["area"], data["limit"]
        self._stiffness, self._width = data["stiffness"], 0.5 * (data["limit"] - 1.0)  # d

    def _largest(self, x: Array) -> Array:
        """λ₁ of each triangle, (E,)."""
        return principal_stretches(x, self.stencil, self._inverse, self.n_elements)[:, 1]

    def _stretched(self, x: Array, n: int | None = None) -> Stretched:
        """Those of the first n triangles (default: all) in which barriers act."""
        rows = np.flatnonzero((self._largest(x) > self._limit - self._width)[:n])
        inverse = self._inverse[rows]
        gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
        f = np.einsum("eci,eck->eik", x[self.stencil[rows]], gradients)
        uu, vv, uv = (np.sum(f[:, :, i] * f[:, :, k], axis=1) for i, k in ((0, 0), (1, 1), (0, 1)))
        angle = 0.5 * np.arctan2(2.0 * uv, uu - vv)
        cosine, sine = np.cos(angle), np.sin(angle)
        axes = np.stack([np.stack([cosine, sine], axis=1), np.stack([-sine, cosine], axis=1)], axis=2)
        g = f @ axes
        stretch = np.linalg.norm(g, axis=1)
        direction = np.divide(g, stretch[:, None], out=np.zeros_like(g), where=stretch[:, None] > 0.0)
        part = np.minimum((self._limit[rows, None] - stretch) / self._width[rows, None], 1.0)
        return Stretched(rows, gradients @ axes, direction, stretch, part)

    def energies(self, x: Array, frozen: Any = None) -> Array:
        out, at = np.zeros(self.n_owned), self._stretched(x, self.n_owned)
        scale = self._area[at.rows] * self._stiffness[at.rows] * self._width[at.rows] ** 2
        with np.errstate(divide="ignore"):
            barrier = np.where(at.part > 0.0, (1.0 - at.part) ** 3 / at.part, np.inf)
        out[at.rows] = scale * barrier.sum(axis=1)
        return out

    def _slopes(self, at: Stretched) -> Array:
        """Derivatives (n, 2) [N/m] of the energy per area by the principal stretches."""
        scale, t = (self._stiffness * self._width)[at.rows, None], at.part
        with np.errstate(divide="ignore"):
            return np.where(t > 0.0, scale * (t**-2 - 3.0 + 2.0 * t), np.inf)

    def add_gradient(self, x: Array, frozen: Any, out: Array) -> None:
        at = self._stretched(x)
        pull = self._area[at.rows, None] * self._slopes(at)
        with np.errstate(invalid="ignore"):  # beyond the limit there is no force
            np.add.at(out, self.stencil[at.rows], np.einsum("ek,eck,eik->eci", pull, at.along, at.direction))

    def add_hessian(self, x: Array, frozen: Any, into: Assembly) -> None:
        at = self._stretched(x)
        area, k = self._area[at.rows], self._stiffness[at.rows]
        (p, q), (t, r) = self._slopes(at).T, at.part.T
        (one, other), both = at.stretch.T, t * r
        # quotient of differences of slopes, without cancellation where both barriers act
        with np.errstate(divide="ignore", invalid="ignore"):
            shear = np.where(r < 1.0, k * ((t + r) / both**2 - 2.0), (p - q) / (one - other))
            across = np.where(q > 0.0, q / other, 0.0)
        turn = (p + q) / (one + other)
        n, m = at.direction[..., 0], at.direction[..., 1]
        nn, mm, mn = (np.einsum("ei,ej->eij", a, b) for a, b in ((n, n), (m, m), (m, n)))
        normal = np.eye(3) - nn - mm

        def sum_of(*pairs: tuple[Array, Array]) -> Array:
            return np.asarray(sum((area * factor)[:, None, None] * of for factor, of in pairs))

        mean, half = 0.5 * (shear + turn), 0.5 * (shear - turn)
        first = sum_of((k * 2.0 * (t**-3 - 1.0), nn), (mean, mm), (p / one, normal))
        second = sum_of((k * 2.0 * (r**-3 - 1.0), mm), (mean, nn), (across, normal))
        mixed = sum_of((half, mn))
        stiff = np.stack([first, mixed, mixed.transpose(0, 2, 1), second], axis=1).reshape(-1, 2, 2, 3, 3)

        def fill(lo: int, hi: int, blocks: Array) -> None:
            along = at.along[lo:hi]
            np.einsum("eak,ebl,eklij->eabij", along, along, stiff[lo:hi], out=blocks)

        self._add_hessians(fill, into, at.rows)

    def force_scale(self, size: float) -> Array:
        return self._stiffness * self._area * np.abs(self._inverse).max(axis=(1, 2)) ** 2 * size

    def stiffness(self, x: Array, frozen: Any) -> Array:
        out = self.force_scale(1.0)
        t = np.maximum((self._limit - self._largest(x)) / self._width, np.finfo(float).eps)
        return np.asarray(out * np.maximum(2.0 * (t**-3 - 1.0), 1.0))

    def largest_step(self, x: Array, dx: Array, frozen: Any = None) -> float:
        before, after = self._largest(x), self._largest(x + dx)
        # from beyond the limit every displacement leads back that ends within it
        bound = self._limit - KEPT_FRACTION * np.maximum(self._limit - before, 0.0)
        rows = np.flatnonzero(~(after <= bound))
        if not len(rows):
            return 1.0
        # λ₁ is a convex function of the fraction: where a secant reaches the bound it is not yet reached
        stencil, inverse = self.stencil[rows], self._inverse[rows]
        done, low, high, bound = np.zeros(len(rows)), before[rows], after[rows], bound[rows]
        corners, moves = x[stencil], dx[stencil]
        numbers = np.arange(3 * len(rows), dtype=np.int32).reshape(-1, 3)
        for _ in range(SECANTS):
            done += (1.0 - done) * np.maximum(bound - low, 0.0) / np.maximum(high - low, np.finfo(float).tiny)
            at = (corners + done[:, None, None] * moves).reshape(-1, 3)
            low = principal_stretches(at, numbers, inverse, len(rows))[:, 1]
        return float(done.min())

    def overrun(self, x: Array, frozen: Any = None) -> tuple[float, str]:
        beyond = self._largest(x) / self._limit - 1.0
        if not (beyond >= 0.0).any():
            return 0.0, ""
        worst = int(beyond.argmax())
        number, limit = self.elements.data["triangle"][worst], self._limit[worst]
        text = f"triangle {number} is stretched to {(1.0 + beyond[worst]) * limit:.4g} times its rest shape"
        return float(beyond[worst]), f"{text}, beyond stretch_limit {limit:g}"


def elements(rest: RestShape) -> Elements:
    """The triangles of materials with a limit (rank 0)."""
    limit = rest.per_triangle("stretch_limit")
    chosen = np.flatnonzero(np.isfinite(limit))
    stiffness = np.array([max(shell.c11, shell.c22, shell.c33) for shell in rest.shells])
    data = {
        "inverse": rest.inverse[chosen],
        "area": rest.area[chosen],
        "limit": limit[chosen],
        "stiffness": stiffness[rest.shell_of[chosen]],
        "triangle": chosen.astype(np.int32),
    }
    return Elements(rest.mesh.triangles[chosen], data)


def make(elements: Elements, scene: Scene, mass: Array) -> StretchLimit:
    """The term on one rank."""
    return StretchLimit(elements)
