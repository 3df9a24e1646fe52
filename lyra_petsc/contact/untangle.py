"""Starts that cross are taken apart before the first step (rank 0).

Each overlap is resolved by displacements y of the sheets' vertices from the start that minimise
½ Σ_edges |y_i − y_j|² + ½ Σ |y_i|² / L² while every part that the overlap has moved to the wrong side of a
layer (`layer_pairs`), or into an obstacle, returns to a small distance on the right side. The pairs are found
anew at the solution until none crosses. Which side is right is decided as in the global intersection analysis
of Baraff, Witkin & Kass (Untangling cloth, SIGGRAPH 2003): a contour of crossings divides a surface, and
the smaller part is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact.least_displacements import LeastDisplacements
from lyra_petsc.contact.part_heights import Heights, PartHeights
from lyra_petsc.contact.start_crossings import PlacedScene, StartCrossings, find_start_crossings
from lyra_petsc.errors import MarkedError
from lyra_petsc.mesh.seams import sewn_curves

MAX_ROUNDS = 30
"""Largest number of searches for pairs."""

MAX_SOLVES = 10
"""Largest number of solves with other active constraints for the same pairs."""

LARGEST_DISPLACEMENT = 3.0
"""Bound of displacements over the depth of the overlap."""

LEAST_CLEARANCE = 0.02
"""Distance beside ``thickness`` that parts keep after the shallowest overlaps, over the gap; after an overlap
deeper than two gaps it is the gap itself."""

SLACK = 0.1
"""Part of the distance to be kept by which a solve may miss it."""

PULL, RELEASING = 1e-3, 6
"""Part of the distance to be kept above which a part is pulled down by its spring, and number of solves in
which such parts are released."""

ENOUGH = 0.5
"""Part of the distance to be kept with which a solution is accepted."""

STEEPEST = 3.0
"""Bound of the height over the distance that is to be kept."""


class Untangled(NamedTuple):
    """Positions without crossings.

    Attributes
    ----------
    positions : (V, 3) float64
        [m]
    pairs : int
        Number of crossings of the start: pairs of triangles, and triangles in obstacles.
    depth : float
        Depth [m] of the overlap: the largest distance on the wrong side, and ``thickness``.
    largest : float
        Largest displacement [m].
    """

    positions: Array
    pairs: int
    depth: float
    largest: float

    @property
    def content(self) -> dict[str, float]:
        """Entry of summary.json."""
        return {"pairs": self.pairs, "depth": self.depth, "largest_displacement": self.largest}

    @property
    def note(self) -> str:
        """For the user."""
        return (
            f"untangled the start: {self.pairs} crossings up to {self.depth:.3g} m deep, by displacements of "
            f"up to {self.largest:.3g} m"
        )


class Distances(NamedTuple):
    """What parts are to keep.

    Attributes
    ----------
    thickness, clearance : float
        Their sum is the distance [m].
    """

    thickness: float
    clearance: float

    @classmethod
    def after(cls, depth: float, thickness: float, gap: float) -> Distances:
        """After parts have been ``depth`` [m] on the wrong side."""
        return cls(thickness, float(np.clip(0.5 * depth, LEAST_CLEARANCE * gap, gap)))

    @property
    def whole(self) -> float:
        """[m]"""
        return self.thickness + self.clearance

    def targets(self, heights: Heights) -> Array:
        """Heights (n,) [m] that parts are to have: those that were nearer at the start keep that distance."""
        full = self.whole * np.minimum(1.0 / heights.slope, STEEPEST)
        near = heights.wrong | (heights.start <= self.thickness)
        return np.where(near, full, np.minimum(full, heights.start))

    def are_kept(self, heights: Heights) -> bool:
        """Whether all parts are on the right side, and those that were not keep enough of the distance."""
        enough = self.thickness + ENOUGH * (self.targets(heights) - self.thickness)
        least = np.where(heights.start <= self.thickness, enough, 0.0)
        return not (heights.wrong | (heights.now < least)).any()


def untangle(
    placed: PlacedScene, crossings: StartCrossings, gap: float, held: Mapping[int, Ints]
) -> Untangled:
    """A start without its crossings.

    Parameters
    ----------
    placed : PlacedScene
        At the start.
    crossings : StartCrossings
        From `find_start_crossings`.
    gap : float
        Of contact [m].
    held : mapping of int to (n,) int64
        Vertices of handles, which keep the coordinates that these hold.

    Raises
    ------
    MarkedError
        If crossings are left, or displacements are too large; the message says which.
    """
    scene, mesh, positions = placed[:3]
    assert scene.contact is not None
    parts = PartHeights(placed, gap)
    free = np.zeros(parts.start.shape, dtype=bool)
    free[: len(positions)] = True
    for number, vertices in held.items():
        for axis in scene.handles[number].axis_numbers:
            free[vertices, axis] = False
    heights, _ = parts.at(parts.start)
    height = float(-(heights.now * heights.slope)[heights.wrong].min(initial=0.0))
    distances = Distances.after(height, scene.contact.thickness, gap)
    closed = [
        sewn.ties
        for sewn in sewn_curves(scene, mesh)
        if np.linalg.norm(sewn.ties.gaps(positions), axis=1).max(initial=0.0) <= gap
    ]
    displacements = LeastDisplacements(parts.surfaces, closed, free)
    y = np.zeros_like(parts.start)
    for _ in range(MAX_ROUNDS):
        before, y = y, _lifted(displacements, heights, distances, y)
        heights, cross = parts.at(parts.start + y)
        if (not cross and distances.are_kept(heights)) or np.array_equal(before, y):
            break
    x = positions + y[: len(positions)]
    left = find_start_crossings(placed._replace(positions=x))
    stay = ", or leave out contact.untangle if sheets are to stay inside" if left.enclosed else ""
    left.refuse("after contact.untangle", f"move them apart{stay}", enclosed=True)
    count = sum(len(one.triangles) for one in (*crossings.crossings, *crossings.enclosed))
    depth = max(height, LEAST_CLEARANCE * gap) + distances.thickness
    largest = float(np.linalg.norm(y, axis=1).max())
    if largest > LARGEST_DISPLACEMENT * depth:
        raise MarkedError(
            f"at the start {count} crossings up to {depth:.3g} m deep are only resolved by displacements of "
            f"up to {largest:.3g} m, more than {LARGEST_DISPLACEMENT:g} times as large; move them apart",
            crossings,
            file=scene.source,
            key="contact.untangle",
        )
    return Untangled(x, count, depth, largest)


def _lifted(displacements: LeastDisplacements, heights: Heights, distances: Distances, y: Array) -> Array:
    """Displacements (V, 3) [m] to the heights, from an estimate y that chooses which are too low."""
    targets = distances.targets(heights)
    least = targets - heights.start
    active = np.zeros(len(least), dtype=bool)
    for number in range(MAX_SOLVES):
        lack = least - heights.changes(y)
        pulled_down = active & (lack < -PULL * targets) & (number < RELEASING)
        if (lack <= SLACK * targets).all() and not pulled_down.any():
            break
        active = lack > 0.0
        y = displacements.lifted(heights.chosen(active), least[active], y)
    return y
