"""Symmetry planes as walls: a sheet that passed through one would pass through its mirror image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.measures import SAME_PLACE
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.obstacles import Container
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.mesh.topology import connected_pieces
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.values import AXES


class Wall(NamedTuple):
    """One side of a symmetry plane.

    Attributes
    ----------
    handle : int
        Number of the first handle in the plane.
    axis : int
        Of the normal.
    position : float
        Coordinate of the plane along the axis [m].
    side : float
        1 or −1: direction along the axis to the side of the sheets.
    vertices : (n,) int64
        Vertices of sheets on this side that are not in the plane, ascending.
    """

    handle: int
    axis: int
    position: float
    side: float
    vertices: Ints

    @property
    def container(self) -> Container:
        """The wall as an obstacle without friction."""
        axis = np.eye(3)[[self.axis]]
        name = f"symmetry plane {AXES[self.axis]} = {self.position:.6g}"
        name += "" if self.side > 0.0 else " (lower side)"
        return Container(name, "planes", self.position * axis, self.side * axis, 0.0, (0.0, 0.0))

    def passed(self, x: Array) -> Ints:
        """The vertices that are on the other side at positions x (V, 3) [m]."""
        return self.vertices[self.side * (x[self.vertices, self.axis] - self.position) < 0.0]


def symmetry_walls(scene: Scene, mesh: Mesh) -> list[Wall]:
    """The walls of a scene; none without self-contact.

    A sheet that a handle holds in the plane is on the side of its triangles there, any other sheet on the
    side to which it reaches farther. A sheet with such triangles on both sides has no image, and no wall.
    """
    if scene.contact is None or not scene.contact.self:
        return []
    x, triangles = mesh.positions, mesh.triangles
    tolerance = SAME_PLACE * float(np.ptp(x, axis=0).max())
    planes: list[tuple[int, int, float, Ints]] = []
    for number, handle in enumerate(scene.handles):
        if handle.symmetry is None:
            continue
        held = select_vertices(mesh, handle, key=f"handles[{number}]", file=scene.source)
        axis = AXES.index(handle.symmetry)
        position = float(np.median(x[held, axis]))
        for place, (first, other, at, before) in enumerate(planes):
            if axis == other and abs(position - at) <= tolerance:
                planes[place] = first, axis, at, np.union1d(before, held)
                break
        else:
            planes.append((number, axis, position, held))
    if not planes:
        return []
    sheet = np.zeros(len(x), dtype=np.int64)
    sheet[triangles] = connected_pieces(triangles)[:, None]
    walls = []
    for number, axis, position, held in planes:
        above = x[:, axis] - position
        at_plane = np.unique(triangles[np.isin(triangles, held).any(axis=1)])
        low, high = _extents(above, sheet, np.arange(len(x)))
        held_low, held_high = _extents(above, sheet, at_plane)
        has_image = ~((held_low < -tolerance) & (held_high > tolerance))
        is_held = held_low <= held_high
        upper = np.where(is_held, held_low, low) > -np.where(is_held, held_high, high)
        walled = has_image[sheet] & (np.abs(above) > tolerance)
        for side, is_there in ((1.0, upper), (-1.0, ~upper)):
            if len(vertices := np.flatnonzero(walled & is_there[sheet])):
                walls.append(Wall(number, axis, position, side, vertices))
    return walls


def _extents(above: Array, sheet: Ints, vertices: Ints) -> tuple[Array, Array]:
    """Lowest and highest value of some ``vertices`` for each sheet; ∞ and −∞ for a sheet without any."""
    low = np.full(int(sheet.max()) + 1, np.inf)
    high = -low
    np.minimum.at(low, sheet[vertices], above[vertices])
    np.maximum.at(high, sheet[vertices], above[vertices])
    return low, high
