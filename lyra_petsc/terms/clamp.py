"""Clamped edges: half a hinge between each held boundary edge's triangle and its plane at the start.

Per held boundary edge of rest length l with a triangle of rest area A, φ its rotation about the edge::

    energy = ½ B l² (2φ − 2φ̄)² / (2 · 2A) = k (φ − φ̄)²,   k = B l² / (2 A)

that is, half a hinge against the mirror image of the triangle, which moves with the handle; φ̄ comes from
the material's rest curvature. Below a tenth of its rest area a triangle's energy fades out, see
``hinge_energy``; the rigid mirror image does not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.handles.motion import Motion, Window, motion_of
from lyra_petsc.meshing.select import select_vertices
from lyra_petsc.meshing.topology import boundary_edges
from lyra_petsc.partition.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.bending import edge_in_material, mirrored_angles
from lyra_petsc.terms.hinge import angle, point
from lyra_petsc.terms.hinge_energy import fading_limit, hinge_energy, hinge_gradient, hinge_hessian
from lyra_petsc.terms.kernel import kernel
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Elastic

Array = NDArray[np.float64]


NO_LIMIT = 0.0
"""Of the mirror image, which is rigid."""


@kernel()
def energies(x, s, mirror, k, rest, limit, out):  # type: ignore[no-untyped-def]
    """Energy [J] of the first len(out) edges."""
    for e in range(out.shape[0]):
        x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(mirror, e)
        theta, square1, square2 = angle(x0, x1, x2, x3)
        out[e] = hinge_energy(theta, square1, square2, k[e], rest[e], (limit[e], NO_LIMIT))


@kernel()
def add_gradient(x, s, mirror, k, rest, limit, out):  # type: ignore[no-untyped-def]
    """Add the energy's gradient [N] to out (n_local, 3)."""
    g = np.empty((4, 3))
    for e in range(s.shape[0]):
        x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(mirror, e)
        theta = angle(x0, x1, x2, x3)[0]
        moment = hinge_gradient(x0, x1, x2, x3, theta, k[e], rest[e], (limit[e], NO_LIMIT), g)
        for a in range(3):
            for i in range(3):
                out[s[e, a], i] += moment * g[a, i]


@kernel()
def hessians(x, s, lo, hi, blend, mirror, k, rest, limit, out):  # type: ignore[no-untyped-def]
    """Hessian blocks [N/m] of edges lo..hi into out (hi − lo, 3, 3, 3, 3)."""
    g, o = np.empty((4, 3)), np.empty((4, 4, 3, 3))
    for e in range(lo, hi):
        x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(mirror, e)
        theta = angle(x0, x1, x2, x3)[0]
        hinge_hessian(x0, x1, x2, x3, theta, k[e], rest[e], (limit[e], NO_LIMIT), blend, g, o)
        out[e - lo] = o[:3, :3]


class Clamp(Elastic):
    """Half hinges of all clamped handles.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 3): edge's tail and head, opposite vertex; data ``k`` (E,) [N·m], ``rest_angle`` (E,)
        [rad], ``height`` (E,) [m], ``limit`` (E,) of |n|² [m⁴], ``handle`` (E,) number of the handle,
        ``damping`` (E,) [s].
    handles : mapping of handle number → (Motion, Window)
    """

    name = "clamp"

    def __init__(self, elements: Elements, handles: dict[int, tuple[Motion, Window]]) -> None:
        super().__init__(elements)
        self._handle = elements.data["handle"].astype(np.int64)
        self._handles = handles
        self._start = np.zeros((self.n_elements, 3))
        self._mirror = np.zeros((self.n_elements, 3))
        self._k = np.zeros(self.n_elements)
        self._rest, self._limit = elements.data["rest_angle"], elements.data["limit"]

    def begin(self, time: float, x: Array) -> None:
        for number, (_, window) in self._handles.items():
            if window.start != time:
                continue
            mine = self._handle == number
            tail, head, opposite = x[self.stencil[mine].T]
            edge = head - tail
            square = (edge * edge).sum(axis=1)
            along = ((opposite - tail) * edge).sum(axis=1) / np.where(square > 0.0, square, 1.0)
            self._start[mine] = 2.0 * (tail + along[:, None] * edge) - opposite

    def prepare(self, t0: float, t1: float, at: float) -> None:
        for number, (motion, window) in self._handles.items():
            mine = self._handle == number
            holds = window.holds(t0, t1)
            self._k[mine] = self.elements.data["k"][mine] if holds else 0.0
            # also while it does not hold: the angle of k = 0 must stay a number
            self._mirror[mine] = motion.carried(self._start[mine], window.start, at)

    def energies(self, x: Array) -> Array:
        out = np.empty(self.n_owned)
        energies(x, self.stencil, self._mirror, self._k, self._rest, self._limit, out)
        return np.where(self._k[: self.n_owned] > 0.0, out, 0.0)

    def add_gradient(self, x: Array, out: Array) -> None:
        held = self._k > 0.0
        constants = self._mirror[held], self._k[held], self._rest[held], self._limit[held]
        add_gradient(x, self.stencil[held], *constants, out)

    def hessians(self, x: Array, lo: int, hi: int, blend: float, out: Array) -> None:
        constants = self._mirror, self._k, self._rest, self._limit
        hessians(x, self.stencil, lo, hi, blend, *constants, out)
        out[self._k[lo:hi] == 0.0] = 0.0

    def force_scale(self, size: float) -> Array:
        # of the full stiffness: the scale is asked for before the first step
        scale: Array = self.elements.data["k"] * size / self.elements.data["height"] ** 2
        return scale


def elements(rest: RestShape) -> Elements:
    """The held boundary edges of all handles with ``clamp`` (rank 0)."""
    edges, faces, opposite = boundary_edges(rest.mesh.triangles)
    vector, b = edge_in_material(rest, faces, edges[:, 0], edges[:, 1])
    squared = (vector**2).sum(axis=1)
    rows, numbers = [], []
    for number, handle in enumerate(rest.scene.handles):
        if not handle.clamp:
            continue
        chosen = select_vertices(rest.mesh, handle, key=f"handles[{number}]", file=rest.scene.source)
        held = np.isin(edges, chosen).all(axis=1) & (b > 0.0)
        rows.append(np.flatnonzero(held))
        numbers.append(np.full(len(rows[-1]), float(number)))
    row = np.concatenate(rows)
    area = rest.area[faces[row]]
    data = {
        "k": b[row] * squared[row] / (2.0 * area),
        "rest_angle": mirrored_angles(rest, np.column_stack([edges[row], opposite[row]]), faces[row]),
        "height": 2.0 * area / np.sqrt(squared[row]),
        "limit": fading_limit(area),
        "handle": np.concatenate(numbers),
        "damping": rest.per_triangle("damping")[faces[row]],
    }
    return Elements(np.column_stack([edges[row], opposite[row]]), data)


def make(elements: Elements, scene: Scene, mass: Array) -> Clamp:
    """The term on one rank."""
    handles = {
        number: (motion_of(scene, number), Window.of(handle))
        for number, handle in enumerate(scene.handles)
        if handle.clamp
    }
    return Clamp(elements, handles)
