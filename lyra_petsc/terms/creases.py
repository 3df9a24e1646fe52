"""Creases: edges with a rest angle and a stiffness of their own.

Per edge of rest length l with dihedral angle θ::

    energy = ½ k l (θ − θ̄(t))²

It replaces what the sheet's bending has at the edge: hinges have none there, and triangles that bend by
``midedge`` end there as at a free edge. As that of hinges it fades out with the area of a triangle.

Angles are those of ``dihedral_angle``, minus the angles of the scene, which are positive towards the normals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.element import inlined, kernel
from lyra_petsc.kernels.vector3 import point
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.crease_block import Crease
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.time_curve import TimeCurve, is_curve
from lyra_petsc.terms.bending.dihedral_angle import angle
from lyra_petsc.terms.bending.hinge_energy import (
    fading_limit,
    hinge_energy,
    hinge_gradient,
    hinge_hessian,
    hinge_weight,
)
from lyra_petsc.terms.protocols import MovingTargets
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import UpcomingStep


@inlined()
def points_of(x, s, h):  # type: ignore[no-untyped-def]
    """The four points of hinge h of s (E, 4)."""
    return point(x, s[h, 0]), point(x, s[h, 1]), point(x, s[h, 2]), point(x, s[h, 3])


@kernel()
def energies(x, s, k, rest, limit, out):  # type: ignore[no-untyped-def]
    """Write the energy [J] of the first hinges of s (E, 4) to out (n,)."""
    for h in range(out.shape[0]):
        x0, x1, x2, x3 = points_of(x, s, h)
        theta, square1, square2 = angle(x0, x1, x2, x3)
        out[h] = hinge_energy(theta, square1, square2, k[h], rest[h], (limit[h, 0], limit[h, 1]))


@kernel()
def moments(x, s, k, rest, limit, out):  # type: ignore[no-untyped-def]
    """Write the derivative [N·m] of the energy of the first hinges by their rest angles to out (n,)."""
    for h in range(out.shape[0]):
        x0, x1, x2, x3 = points_of(x, s, h)
        theta, square1, square2 = angle(x0, x1, x2, x3)
        weight = hinge_weight(square1, square2, limit[h, 0], limit[h, 1])
        out[h] = -2.0 * k[h] * (theta - rest[h]) * weight


@kernel()
def add_gradient(x, s, k, rest, limit, out):  # type: ignore[no-untyped-def]
    """Add the energy's gradient [N] to out (n_local, 3)."""
    g = np.empty((4, 3))
    for h in range(s.shape[0]):
        x0, x1, x2, x3 = points_of(x, s, h)
        theta, _, _ = angle(x0, x1, x2, x3)
        moment = hinge_gradient(x0, x1, x2, x3, theta, k[h], rest[h], (limit[h, 0], limit[h, 1]), g)
        for a in range(4):
            for i in range(3):
                out[s[h, a], i] += moment * g[a, i]


@kernel()
def hessians(x, s, k, rest, limit, convexity, out):  # type: ignore[no-untyped-def]
    """Write the Hessians [N/m] to out (E, 4, 4, 3, 3)."""
    g = np.empty((4, 3))
    for h in range(s.shape[0]):
        x0, x1, x2, x3 = points_of(x, s, h)
        theta, _, _ = angle(x0, x1, x2, x3)
        limits = limit[h, 0], limit[h, 1]
        hinge_hessian(x0, x1, x2, x3, theta, k[h], rest[h], limits, convexity, g, out[h])


class RestAngles(NamedTuple):
    """Frozen data: the rest angles (E,) [rad]."""

    angle: Array


class Creases(MovingTargets):
    """All creases of a scene.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 4) as in ``dihedral_angle``; data ``crease`` (E,) its number, ``k`` (E,) ½ k l [N·m],
        ``start`` (E,) angle [rad] at the start, ``rest_height`` (E,) sum of the two heights on the edge [m],
        ``limit`` (E, 2) of |n|² of both triangles [m⁴], ``damping`` (E,) [s].
    blocks : sequence of Crease
        Those of the scene.
    static : bool
        Whether angles that are numbers are reached in proportion to the load factor.
    """

    def __init__(self, elements: Elements, blocks: Sequence[Crease], *, static: bool) -> None:
        super().__init__(elements)
        data = elements.data
        self._crease = data["crease"].astype(np.int64)
        self._start, self._k, self._limit = data["start"], data["k"], data["limit"]
        self._curves = [TimeCurve.of(block.angle) for block in blocks]
        grows = [static and not is_curve(block.angle) for block in blocks]
        self._grows = np.array(grows, dtype=bool)[self._crease]

    def freeze(self, step: UpcomingStep) -> RestAngles:
        time = step.target_time
        angles = -np.radians([float(curve.at(time)) for curve in self._curves])[self._crease]
        return RestAngles(np.where(self._grows, self._start + time * (angles - self._start), angles))

    def energies(self, x: Array, frozen: RestAngles) -> Array:
        out = np.empty(self.n_owned)
        energies(x, self.stencil, self._k, frozen.angle, self._limit, out)
        return out

    def add_gradient(self, x: Array, frozen: RestAngles, out: Array) -> None:
        add_gradient(x, self.stencil, self._k, frozen.angle, self._limit, out)

    def hessians(self, x: Array, frozen: RestAngles, lo: int, hi: int, convexity: float, out: Array) -> None:
        chosen = slice(lo, hi)
        law = self._k[chosen], frozen.angle[chosen], self._limit[chosen]
        hessians(x, self.stencil[chosen], *law, convexity, out)

    def targets(self, x: Array, frozen: RestAngles) -> tuple[Array, Array]:
        """The rest angles (n_owned,) [rad], and the energy's derivatives by them [N·m]."""
        out = np.empty(self.n_owned)
        moments(x, self.stencil, self._k, frozen.angle, self._limit, out)
        return frozen.angle[: self.n_owned], out

    def force_scale(self, size: float) -> Array:
        return self._k * size / self.elements.data["rest_height"] ** 2


def start_angles(rest: RestShape, chosen: Ints) -> Array:
    """Dihedral angles (n,) [rad] at the start of the hinges ``chosen`` (n,) of the rest shape."""
    x, quad = rest.mesh.positions, rest.hinges.vertices[chosen]
    return np.array([angle(*(tuple(x[vertex]) for vertex in corners))[0] for corners in quad])


def lengths(rest: RestShape, chosen: Ints) -> Array:
    """Rest lengths (n,) [m] of hinges ``chosen`` (n,), means over their two triangles."""
    quad, faces = rest.hinges.vertices[chosen], rest.hinges.triangles[chosen]
    sides = []
    for side in range(2):
        corners, uv = rest.mesh.triangles[faces[:, side]], rest.mesh.triangle_uv[faces[:, side]]
        row = np.arange(len(quad))
        tail, head = (np.argmax(corners == quad[:, k, None], axis=1) for k in (0, 1))
        sides.append(np.linalg.norm(uv[row, head] - uv[row, tail], axis=1))
    return np.asarray(0.5 * (sides[0] + sides[1]))


def elements(rest: RestShape) -> Elements:
    """The edges of all creases (rank 0)."""
    chosen = np.flatnonzero(rest.crease_of >= 0)
    crease, faces = rest.crease_of[chosen], rest.hinges.triangles[chosen]
    length, areas = lengths(rest, chosen), rest.area[faces]
    stiffness = np.array([block.stiffness for block in rest.scene.creases])
    for number, block in enumerate(rest.scene.creases):
        if not (crease == number).any():
            rest.notes.append(
                f"creases[{number}]: no edge between two triangles in group '{block.group}', so that nothing "
                "is folded there"
            )
    data = {
        "crease": crease.astype(np.float64),
        "k": 0.5 * stiffness[crease] * length,
        "start": start_angles(rest, chosen),
        "rest_height": 2.0 * areas.sum(axis=1) / length,
        "limit": fading_limit(areas),
        "damping": rest.per_triangle("damping")[faces].mean(axis=1),
    }
    return Elements(rest.hinges.vertices[chosen], data)


def plan(rest: RestShape) -> list[tuple[str, str]]:
    """For ``check``: for each crease its name, and its size, angles and stiffness."""
    rows = []
    for number, block in enumerate(rest.scene.creases):
        chosen = np.flatnonzero(rest.crease_of == number)
        curve, parts = TimeCurve.of(block.angle), [f"{len(chosen)} edges"]
        if len(chosen):
            start = -np.degrees(start_angles(rest, chosen)) + 0.0
            span = sorted({f"{start.min():.4g}", f"{start.max():.4g}"}, key=float)
            parts += [f"{lengths(rest, chosen).sum():.4g} m", f"{' to '.join(span)}° at the start"]
        if is_curve(block.angle):
            span = [f"{curve.at(t):.4g}" for t in (curve.times[0], curve.times[-1])]
            parts.append(f"rest angle from {span[0]}° to {span[1]}°")
        else:
            parts.append(f"rest angle {float(curve.at(0.0)):.4g}°")
        rows.append((f"crease {block.group}", ", ".join([*parts, f"{block.stiffness:.4g} N m/m/rad"])))
    return rows


def make(elements: Elements, scene: Scene, mass: Array) -> Creases:
    """The creases on one rank."""
    return Creases(elements, scene.creases, static=scene.time.static)
