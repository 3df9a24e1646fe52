"""Bending across seams whose sides are not one edge, or with a stiffness of its own.

Per edge of the tied side of a seam, with rest length l and heights h of its triangle and of that on the other
side::

    energy = c(t) B l / (h0 + h1) (θ − θ̄)²

as of the sheet's hinges (``hinge``). θ is the dihedral angle between the edge's triangle and the one from the
edge to the opposite vertex on the other side, which is in the plane of the other triangle once the seam is
closed. While threads of length L(t) close it, c = max(0, 1 − L / (h0 + h1))².
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.seam_block import Seam
from lyra_petsc.terms.bending.hinge import edge_in_material
from lyra_petsc.terms.bending.hinge_energy import fading_limit
from lyra_petsc.terms.creases import add_gradient, energies, hessians
from lyra_petsc.terms.protocols import MovingTargets
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.seam import closed_part
from lyra_petsc.terms.term import UpcomingStep

MODELS = ("hinge", "midedge")


class BendingParts(NamedTuple):
    """Frozen data: c (E,), which part of the hinges' stiffness acts."""

    part: Array


class SeamBending(MovingTargets):
    """The hinges across all seams.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 4) as in ``dihedral_angle``; data ``seam`` (E,) its number, ``k`` (E,) [N·m],
        ``rest_angle`` (E,) [rad], ``rest_height`` (E,) sum of the two heights on the edge [m], ``limit``
        (E, 2) of |n|² of both triangles [m⁴], ``gap`` (E,) at the start [m], ``damping`` (E,) [s].
    seams : sequence of Seam
        Of the scene.
    """

    def __init__(self, elements: Elements, seams: Sequence[Seam]) -> None:
        super().__init__(elements)
        data = elements.data
        self._k, self._rest, self._limit = data["k"], data["rest_angle"], data["limit"]
        self._seam, self._seams = data["seam"].astype(np.int64), seams

    def freeze(self, step: UpcomingStep) -> BendingParts:
        opened = np.array([1.0 - closed_part(seam, step.target_time) for seam in self._seams])
        length = opened[self._seam] * self.elements.data["gap"]
        return BendingParts(np.maximum(1.0 - length / self.elements.data["rest_height"], 0.0) ** 2)

    def _energies(self, x: Array, k: Array) -> Array:
        out = np.empty(self.n_owned)
        energies(x, self.stencil, k, self._rest, self._limit, out)
        return out

    def energies(self, x: Array, frozen: BendingParts) -> Array:
        return self._energies(x, frozen.part * self._k)

    def add_gradient(self, x: Array, frozen: BendingParts, out: Array) -> None:
        add_gradient(x, self.stencil, frozen.part * self._k, self._rest, self._limit, out)

    def hessians(
        self, x: Array, frozen: BendingParts, lo: int, hi: int, convexity: float, out: Array
    ) -> None:
        rows = slice(lo, hi)
        law = (frozen.part * self._k)[rows], self._rest[rows], self._limit[rows]
        hessians(x, self.stencil[rows], *law, convexity, out)

    def targets(self, x: Array, frozen: BendingParts) -> tuple[Array, Array]:
        """c (n_owned,), and the energy's derivatives by that [J]."""
        return frozen.part[: self.n_owned], self._energies(x, self._k)

    def force_scale(self, size: float) -> Array:
        return self._k * size / self.elements.data["rest_height"] ** 2


def elements(rest: RestShape) -> Elements:
    """The hinges of all seams but those at which the sheet bends itself (rank 0)."""
    sewn, angle, seams = rest.seam_hinges, rest.sewn_angles, rest.scene.seams
    row = np.arange(len(sewn.seam))
    # of the sheets, by the edge's direction in either
    stiffness = np.full(len(row), np.inf)
    for side in range(2):
        corners = rest.mesh.triangles[sewn.triangles[:, side]]
        opposite = np.argmax(corners == sewn.stencil[:, 2 + side, None], axis=1)
        tail, head = (corners[row, (opposite + k) % 3] for k in (1, 2))
        face = sewn.triangles[:, side]
        by_model = [edge_in_material(rest, face, tail, head, model)[1] for model in MODELS]
        stiffness = np.minimum(stiffness, np.sum(by_model, axis=0))
    for number, seam in enumerate(seams):
        mine = sewn.seam == number
        if seam.bending is not None:
            stiffness[mine] = seam.bending
        if seam.angle != "free":
            degrees = -np.degrees(angle[mine]).round(9)
            rest.notes.append(f"seam {seam.label}: {_text(degrees, stiffness[mine])}")
    as_sheet = np.array([seam.bends_as_sheet for seam in seams])[sewn.seam] & (sewn.hinge >= 0)
    chosen = ~np.isnan(angle) & ~as_sheet & (stiffness > 0.0)
    faces, length, heights = sewn.triangles[chosen], sewn.length[chosen], sewn.heights[chosen]
    height = heights.sum(axis=1)
    data = {
        "seam": sewn.seam[chosen].astype(np.float64),
        "k": stiffness[chosen] * length / height,
        "rest_angle": angle[chosen],
        "rest_height": height,
        "limit": fading_limit(0.5 * length[:, None] * heights),
        "gap": sewn.start_gap[chosen],
        "damping": rest.per_triangle("damping")[faces].mean(axis=1),
    }
    return Elements(sewn.stencil[chosen], data)


def _text(angles: Array, stiffness: Array) -> str:
    """What ``check`` says of angles (n,) [°] and stiffnesses (n,) [N·m]."""
    spans = []
    for values in (angles, stiffness):
        span = sorted({f"{values.min() + 0.0:.4g}", f"{values.max() + 0.0:.4g}"}, key=float)
        spans.append(" to ".join(span))
    return f"bends towards {spans[0]}° from flat with {spans[1]} N m"


def make(elements: Elements, scene: Scene, mass: Array) -> SeamBending:
    """The term on one rank."""
    return SeamBending(elements, scene.seams)
