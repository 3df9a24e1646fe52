"""Clamped edges: half a hinge between the triangle of each held boundary edge and its plane at the start.

Per held boundary edge of rest length l, with a triangle of rest area A that is rotated by φ about the edge::

    energy = ½ B l² (2φ − 2φ̄)² / (2 · 2A) = k (φ − φ̄)²,   k = B l² / (2 A)

This is half the energy of a hinge between the triangle and its mirror image at the start, which moves with
the handle. φ̄ follows from the material's rest curvature. The energy fades out as the triangle loses the last
tenth of its rest area, see ``hinge_energy``. Half hinges of moving handles are not damped, as D v has no
velocity of the mirror image.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.element import kernel, subkernel
from lyra_petsc.kernels.vector3 import point
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.mesh.topology import boundary_edges
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.bending.dihedral_angle import angle
from lyra_petsc.terms.bending.hinge import edge_in_material, mirrored_angles
from lyra_petsc.terms.bending.hinge_energy import fading_limit, hinge_energy, hinge_gradient, hinge_hessian
from lyra_petsc.terms.handles.motion import Motion, Window, motion_of
from lyra_petsc.terms.protocols import FollowsHandles, MovingTargets
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import UpcomingStep


@kernel()
def energies(x, s, mirror, k, rest, limit, out):  # type: ignore[no-untyped-def]
    """Write the energy [J] of the first len(out) edges; the mirror image is rigid and never fades."""
    for e in range(out.shape[0]):
        x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(mirror, e)
        theta, square1, square2 = angle(x0, x1, x2, x3)
        out[e] = hinge_energy(theta, square1, square2, k[e], rest[e], (limit[e], 0.0))


@subkernel()
def _gradient(x, s, mirror, k, rest, limit, e, g):  # type: ignore[no-untyped-def]
    """Write g (4, 3) [1/m] and return a moment [N·m]; their product is the gradient [N] of the energy of
    edge e by its three vertices and the mirror image.
    """
    x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(mirror, e)
    theta = angle(x0, x1, x2, x3)[0]
    return hinge_gradient(x0, x1, x2, x3, theta, k[e], rest[e], (limit[e], 0.0), g)


@kernel()
def add_gradient(x, s, mirror, k, rest, limit, out):  # type: ignore[no-untyped-def]
    """Add the energy's gradient [N] to out (n_local, 3)."""
    g = np.empty((4, 3))
    for e in range(s.shape[0]):
        moment = _gradient(x, s, mirror, k, rest, limit, e, g)
        for a in range(3):
            for i in range(3):
                out[s[e, a], i] += moment * g[a, i]


@kernel()
def hessians(x, s, lo, hi, convexity, mirror, k, rest, limit, out):  # type: ignore[no-untyped-def]
    """Write the Hessian blocks [N/m] of edges lo..hi into out (hi − lo, 3, 3, 3, 3)."""
    g, o = np.empty((4, 3)), np.empty((4, 4, 3, 3))
    for e in range(lo, hi):
        x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(mirror, e)
        theta = angle(x0, x1, x2, x3)[0]
        hinge_hessian(x0, x1, x2, x3, theta, k[e], rest[e], (limit[e], 0.0), convexity, g, o)
        out[e - lo] = o[:3, :3]


@kernel()
def mirror_gradients(x, s, mirror, k, rest, limit, out):  # type: ignore[no-untyped-def]
    """Write the energy's gradient [N] by the mirror images of the first len(out) edges into out (n, 3)."""
    g = np.empty((4, 3))
    for e in range(out.shape[0]):
        moment = _gradient(x, s, mirror, k, rest, limit, e, g)
        for i in range(3):
            out[e, i] = moment * g[3, i]


class Mirrors(NamedTuple):
    """Targets of the clamps in one step.

    Attributes
    ----------
    mirror : (E, 3)
        Mirror images of the opposite vertices [m].
    k : (E,)
        Stiffness [N·m]; 0 for handles that are not active.
    """

    mirror: Array
    k: Array


def _mirrored(tail: Array, head: Array, opposite: Array) -> Array:
    """Mirror images (E, 3) [m] of the opposite vertices about the edges."""
    edge = head - tail
    square = (edge * edge).sum(axis=1)
    along = ((opposite - tail) * edge).sum(axis=1) / np.where(square > 0.0, square, 1.0)
    return 2.0 * (tail + along[:, None] * edge) - opposite


class Clamp(FollowsHandles, MovingTargets):
    """Half hinges of all clamped handles.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 3): tail and head of the edge, opposite vertex; data ``k`` (E,) [N·m], ``rest_angle`` (E,)
        [rad], ``height`` (E,) [m], ``limit`` (E,) of |n|² [m⁴], ``handle`` (E,) number of the handle,
        ``damping`` (E,) [s].
    handles : mapping of handle number → (Motion, Window)
    """

    def __init__(self, elements: Elements, handles: dict[int, tuple[Motion, Window]]) -> None:
        super().__init__(elements)
        self._handle = elements.data["handle"].astype(np.int64)
        self._handles = handles
        self._limit = elements.data["limit"]

    @property
    def reference_rows(self) -> NDArray[np.int64]:
        return self.stencil.ravel().astype(np.int64)

    def freeze(self, step: UpcomingStep) -> Mirrors:
        mirror, k = np.zeros((self.n_elements, 3)), np.zeros(self.n_elements)
        for number, (motion, window) in self._handles.items():
            mine = self._handle == number
            if window.holds(step.start, step.end):
                k[mine] = self.elements.data["k"][mine]
            corners = self.stencil[mine].astype(np.int64)
            tail, head, opposite = step.reference(window.start, corners.T.ravel()).reshape(3, -1, 3)
            # also for inactive handles, since 0 times an undefined angle is NaN
            mirror[mine] = motion.moved(_mirrored(tail, head, opposite), window.start, step.target_time)
        return Mirrors(mirror, k)

    def law(self, x: Array, frozen: Mirrors, convexity: float | None = None) -> tuple[Array, Array]:
        """k (E,) and φ̄ (E,) of the half hinges at positions x, as `Bending.law`."""
        return frozen.k, self.elements.data["rest_angle"]

    def energies(self, x: Array, frozen: Mirrors) -> Array:
        out = np.empty(self.n_owned)
        energies(x, self.stencil, frozen.mirror, *self.law(x, frozen), self._limit, out)
        return np.where(frozen.k[: self.n_owned] > 0.0, out, 0.0)

    def add_gradient(self, x: Array, frozen: Mirrors, out: Array) -> None:
        held, (k, rest) = frozen.k > 0.0, self.law(x, frozen)
        constants = frozen.mirror[held], k[held], rest[held], self._limit[held]
        add_gradient(x, self.stencil[held], *constants, out)

    def hessians(self, x: Array, frozen: Mirrors, lo: int, hi: int, convexity: float, out: Array) -> None:
        law = self.law(x, frozen, convexity)
        hessians(x, self.stencil, lo, hi, convexity, frozen.mirror, *law, self._limit, out)
        out[frozen.k[lo:hi] == 0.0] = 0.0

    def targets(self, x: Array, frozen: Mirrors) -> tuple[Array, Array]:
        out = np.empty((self.n_owned, 3))
        mirror_gradients(x, self.stencil, frozen.mirror, *self.law(x, frozen), self._limit, out)
        out[frozen.k[: self.n_owned] == 0.0] = 0.0
        return frozen.mirror[: self.n_owned], out

    def force_scale(self, size: float) -> Array:
        # not ``frozen.k``, since the scale is needed before the first step
        return self.elements.data["k"] * size / self.elements.data["height"] ** 2


def whole_clamps(rest: RestShape) -> tuple[Elements, NDArray[np.int64]]:
    """The boundary edges whose two ends are held by a handle with ``clamp``, with the constants of elastic
    bending, and their triangles (E,) (rank 0).
    """
    edges, faces, opposite = boundary_edges(rest.mesh.triangles)
    vector, b = edge_in_material(rest, faces, edges[:, 0], edges[:, 1])
    squared = (vector**2).sum(axis=1)
    rows, numbers, damped = [], [], []
    for number, handle in enumerate(rest.scene.handles):
        if not handle.clamp:
            continue
        chosen = select_vertices(rest.mesh, handle, key=f"handles[{number}]", file=rest.scene.source)
        held = np.isin(edges, chosen).all(axis=1) & (b > 0.0)
        rows.append(np.flatnonzero(held))
        numbers.append(np.full(len(rows[-1]), float(number)))
        damped.append(np.full(len(rows[-1]), rest.scene.handles[number].motion is None))
    row = np.concatenate(rows)
    area = rest.area[faces[row]]
    data = {
        "k": b[row] * squared[row] / (2.0 * area),
        "rest_angle": mirrored_angles(rest, np.column_stack([edges[row], opposite[row]]), faces[row]),
        "height": 2.0 * area / np.sqrt(squared[row]),
        "limit": fading_limit(area),
        "handle": np.concatenate(numbers),
        "damping": rest.per_triangle("damping")[faces[row]] * np.concatenate(damped),
    }
    return Elements(np.column_stack([edges[row], opposite[row]]), data), faces[row]


def elements(rest: RestShape) -> Elements:
    """Those of `whole_clamps` with the part of their stiffness that never yields (rank 0)."""
    clamps, triangle = whole_clamps(rest)
    k = clamps.data["k"] * rest.per_triangle("elastic_share")[triangle]
    return replace(clamps, data={**clamps.data, "k": k})


def clamping_handles(scene: Scene) -> dict[int, tuple[Motion, Window]]:
    """Motion and window of the handles with ``clamp``, by their numbers."""
    return {
        number: (motion_of(scene, number), Window.of(handle))
        for number, handle in enumerate(scene.handles)
        if handle.clamp
    }


def make(elements: Elements, scene: Scene, mass: Array) -> Clamp:
    """The term on one rank."""
    return Clamp(elements, clamping_handles(scene))
