"""Motions of obstacles between two times, as they are at places of contact."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints

TINY = np.finfo(float).tiny


class BodyMotions(NamedTuple):
    """Motions of all obstacles from one time to another.

    A body that deforms moves at each place of contact as the triangle, edge or point that is there, and
    turns as a triangle there.

    Attributes
    ----------
    rigid : list of (3, 3) and (3,)
        Rotation and translation [m] of each obstacle; those of bodies that deform do not count.
    deforming : tuple of int
        Numbers of the obstacles that deform.
    start, end : (m, 3)
        Points of all obstacles [m] at both times.
    triangle_of : (m, 3)
        A triangle with each point, of bodies that deform.
    """

    rigid: list[tuple[Array, Array]]
    deforming: tuple[int, ...]
    start: Array
    end: Array
    triangle_of: Ints

    def carried(self, obstacle: int, places: Array, simplices: Ints) -> tuple[Array, Array]:
        """Places (n, 3) [m] on an obstacle after its motion, and rotations (n, 3, 3) there.

        ``simplices`` (n, 4) hold ~numbers of the obstacle's points at each place, other entries are not
        negative.
        """
        if obstacle in self.deforming:
            return self._carried(places, simplices, self.start, self.end)
        rotation, translation = self.rigid[obstacle]
        return places @ rotation.T + translation, np.broadcast_to(rotation, (len(places), 3, 3))

    def displacements(self, obstacle: int, places: Array, simplices: Ints) -> Array:
        """Displacements (n, 3) [m] of an obstacle at ``places`` after its motion; see `carried`."""
        if obstacle in self.deforming:
            return places - self._carried(places, simplices, self.end, self.start)[0]
        rotation, translation = self.rigid[obstacle]
        return places - (places - translation) @ rotation

    def _carried(self, places: Array, simplices: Ints, before: Array, after: Array) -> tuple[Array, Array]:
        """As `carried`, from points ``before`` to ``after``, (m, 3) each."""
        # points of the obstacle first; a corner that is missing is the first one again
        order = np.argsort(simplices >= 0, axis=1, kind="stable")[:, :3]
        corners = np.take_along_axis(simplices, order, axis=1)
        corners = np.where(corners < 0, ~corners, ~corners[:, :1])
        old, new = before[corners], after[corners]
        sides, sides_after = old[:, 1:] - old[:, :1], new[:, 1:] - new[:, :1]
        offset = places - old[:, 0]
        square = sides @ sides.transpose(0, 2, 1)
        part = np.einsum("eij,ejk,ek->ei", np.linalg.pinv(square), sides, offset)
        above = offset - np.einsum("ei,eik->ek", part, sides)
        triangles = self.triangle_of[corners[:, 0]]
        rotation = _frames(after, triangles).transpose(0, 2, 1) @ _frames(before, triangles)
        moved = new[:, 0] + np.einsum("ei,eik->ek", part, sides_after)
        return moved + np.einsum("eij,ej->ei", rotation, above), rotation

    def work(self, obstacle: int, x: Array, force: Array, on_points: Array) -> float:
        """Work [J] of an obstacle on the sheets in its motion, by constant forces: ``force`` (n, 3) [N] on it
        at vertices x (n, 3), or, if it deforms, the gradient ``on_points`` (m, 3) [N] by its points.
        """
        if obstacle in self.deforming:
            return float(np.vdot(on_points, self.end - self.start))
        rotation, translation = self.rigid[obstacle]
        return -float(np.vdot(force, x @ rotation.T + translation - x))

    def moves(self, obstacle: int) -> bool:
        """Whether an obstacle is elsewhere at the end."""
        if obstacle in self.deforming:
            return True
        rotation, translation = self.rigid[obstacle]
        return bool(translation.any() or (rotation != np.eye(3)).any())


def _frames(x: Array, triangles: Ints) -> Array:
    """Orthonormal frames (n, 3, 3) of triangles (n, 3) with corners in x (m, 3), row by row."""
    a, b, c = (x[triangles[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    lengths = (np.maximum(np.linalg.norm(v, axis=1, keepdims=True), TINY) for v in (b - a, normal))
    along, normal = (v / length for v, length in zip((b - a, normal), lengths, strict=True))
    return np.stack([along, np.cross(normal, along), normal], axis=1)
