"""Search for the pairs of sheets with themselves, each other and obstacles that may come near."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact.contact_setup import AREA_UNITS, MAX_NARROWING, Barrier
from lyra_petsc.contact.joined import JoinedVertices
from lyra_petsc.contact.obstacle_points import Obstacles
from lyra_petsc.contact.obstacle_search import ObstacleSearch
from lyra_petsc.contact.pair_distances import EDGE_EDGE
from lyra_petsc.contact.pairs import NearPairs, no_near_pairs
from lyra_petsc.contact.sheet_search import SheetSearch
from lyra_petsc.mesh.obstacles import Container, Solid

EDGE_GAP = 0.3
"""Part of the gap below which two edges repel each other, except for sharp edges of obstacles. Sheets that
lie on each other are kept apart by pairs of vertices and triangles, two for each vertex; pairs of edges, of
which there are ten times as many, are needed only for what these miss. The same holds for edges and points of
obstacles' smooth surfaces, so that forces on the vertices of a sheet do not depend on the obstacle's mesh."""

OF_THREAD = 0.5
"""Gap between two parts that an open seam is to join, over the length of its thread, where this is less than
the gap: they close without passing each other, as contact leaves them out only then."""

SKIN = 0.5
"""Distance over the gap by which points may approach each other between two searches."""

MAX_PAIRS, MAX_PAIRS_PER_VERTEX = 500_000, 100
"""If a search finds more pairs than both (the second per vertex), it is repeated with shorter displacements:
a Newton increment may lead through all of a crumpled sheet, but only a small part of it will be possible. Not
in a static analysis, whose first load step may lead far while nothing holds the sheet."""


class ContactSearch:
    """Finds near pairs of one rank.

    Parameters
    ----------
    surface : (F, 3)
        Triangles of this rank, in local rows.
    uv : (F, 3, 2)
        Material coordinates [m] of their corners.
    marks : (F, 8 + walls)
        Code of the triangles' surroundings (`surface_shares.rings`), and of their corners the `area_factors`,
        the `narrowing`, a code of their symmetry planes, and for each of `Barrier.walls` bits i: whether it
        acts on corner i.

    Attributes
    ----------
    obstacles : Obstacles
    skin : float
        Distance [m] by which points may approach each other between two searches.
    distance : float
        Distance [m] within which pairs are found, the skin included.
    approach_limit : float
        Distance [m] by which two points that were not found may approach each other.
    outdated : bool
        Whether pairs must be searched again, since obstacles are elsewhere, or threads of seams shorter.
    """

    def __init__(self, surface: NDArray[np.int32], uv: Array, marks: Ints) -> None:
        self.surface: NDArray[np.int32] = np.ascontiguousarray(surface, dtype=np.int32)
        self.marks = marks
        self._sheets = SheetSearch(surface.astype(np.int64), uv)
        self.obstacles, self.outdated = Obstacles([]), False
        self._obstacle_search = ObstacleSearch(self.obstacles, self._sheets, 0.0)
        self._searched: Ints | None = None  # triangles that the search has
        self._vertex_units = np.empty(0, dtype=np.int64)  # of the stiffness, by vertex
        self._narrowing = np.empty(0, dtype=np.int64)  # in the same units, by vertex
        self._on_planes = np.empty((0, 3), dtype=np.bool_)  # symmetry planes normal to each axis, by vertex
        self._walled = np.empty((0, 0), dtype=np.bool_)  # walls that act on each vertex

    def set_up(
        self, barrier: Barrier, obstacles: Sequence[Solid | Container], joined: JoinedVertices
    ) -> None:
        """Take the data that are the same on all ranks; must be called first."""
        self._joined = joined
        walls = barrier.walls, -0.5 * barrier.thickness  # at half of the distance of a vertex from its image
        self.obstacles, self._gap = Obstacles(obstacles, barrier.flat, *walls), barrier.gap
        self._of_sheets, self._static = barrier.of_sheets, barrier.static
        self.skin = SKIN * barrier.gap
        self.distance = barrier.thickness + barrier.gap + self.skin
        self.approach_limit = (EDGE_GAP if barrier.of_sheets else 1.0) * barrier.gap + self.skin
        self._obstacle_search = ObstacleSearch(self.obstacles, self._sheets, self.distance)
        self._next_obstacle_x = self._obstacle_search.x

    @property
    def obstacle_x(self) -> Array:
        """Points of the obstacles (2, m, 3) [m] of the last search."""
        return self._obstacle_search.x

    @property
    def path_deviations(self) -> Array:
        """Largest deviation [m] of each obstacle's paths in the step from straight lines."""
        return self._obstacle_search.deviations

    def expect(self, start: float, end: float) -> None:
        """Take the motion of the obstacles, and the threads of seams, in a step between two times [s]."""
        self.outdated = self._joined.expect(end, self._gap / OF_THREAD)
        if not self.obstacles.moving:
            return
        self._next_obstacle_x = np.stack([self.obstacles.positions(time) for time in (start, end)])
        largest = np.linalg.norm(self._next_obstacle_x - self.obstacle_x, axis=-1).max(initial=0.0)
        planes = (self.obstacles.planes[:, 3] < self.obstacles.first_wall).any()
        self.outdated |= bool(largest > 0.5 * self.skin or (largest > 0.0 and planes))
        self._obstacle_search.deviations = self.obstacles.path_deviations(start, end)

    def near_pairs(self, x: Array, dx: Array, numbers: Ints, triangles: Ints) -> NearPairs | None:
        """The pairs that may come nearer than `distance` along straight displacements dx (N, 3) [m]
        of points x (N, 3) [m]; None if there are too many, so that shorter ones must be searched.

        ``numbers`` (N,) are the points' global numbers, ``triangles`` (F, 3 + m) near triangles with their
        marks. Ranks that see the same points find the same pairs.
        """
        if self.obstacles.moving:
            self._obstacle_search.move(self._next_obstacle_x)
        self.outdated = False
        if triangles is not self._searched:
            self._sheets.set_triangles(x, numbers, triangles[:, :3], triangles[:, 3])
            self._vertex_units = np.full(len(x) + 1, AREA_UNITS)  # the last one for other pairs
            self._vertex_units[triangles[:, :3]] = triangles[:, 4:7]
            self._narrowing = np.full(len(x), AREA_UNITS)
            self._narrowing[triangles[:, :3]] = triangles[:, 7:10]
            self._on_planes = np.zeros((len(x), 3), dtype=np.bool_)
            codes = triangles[:, 10, None] >> np.arange(9)
            self._on_planes[triangles[:, :3]] = (codes & 1).astype(np.bool_).reshape(-1, 3, 3)
            codes = triangles[:, None, 11:] >> np.arange(3)[:, None]
            self._walled = np.zeros((len(x), codes.shape[2]), dtype=np.bool_)
            self._walled[triangles[:, :3]] = (codes & 1).astype(np.bool_)
            self._searched = triangles
        limit = np.inf
        if dx.any() and not self._static:
            limit = max(MAX_PAIRS, MAX_PAIRS_PER_VERTEX * len(x))
        boxes = self._sheets.boxes(x, dx)
        parts, narrowed = [np.empty((0, 7), dtype=np.int64)], np.empty(0, dtype=np.int64)
        if self.obstacles.bodies:
            parts += self._obstacle_search.pairs(x, dx, boxes, self._walled)
        if self._of_sheets:
            radius = self.distance
            edge_radius = radius - (1.0 - EDGE_GAP) * self._gap
            pairs = self._sheets.pairs(x, dx, numbers, radius, edge_radius, boxes, limit)
            if pairs is None:
                return None
            pairs, narrowed = self._without_seams(pairs, numbers)
            parts.append(pairs)
        every = np.concatenate(parts)
        if len(every) > limit:
            return None
        if not len(every):
            return no_near_pairs()
        kind, obstacle, points = every[:, 0], every[:, 1], every[:, 2:6]
        sheet = points >= 0
        first = points[np.arange(len(points)), sheet.argmax(axis=1)]
        vertex = np.where((kind != EDGE_EDGE) & sheet[:, 0], points[:, 0], -1)
        units = self._vertex_units[vertex]
        if self._on_planes.any():
            edges = np.flatnonzero(kind == EDGE_EDGE)
            units[edges] >>= self._symmetry_planes(x, points[edges])
        narrowing = np.where(obstacle < 0, self._narrowing[np.maximum(points, 0)].max(axis=1), AREA_UNITS)
        if len(narrowed):
            narrowing[-len(narrowed) :] = np.maximum(narrowing[-len(narrowed) :], narrowed)
        vertices = numbers[np.where(sheet, points, first[:, None])]
        obstacle_points = np.where(sheet, 0, points)
        return NearPairs(vertices, kind, obstacle, obstacle_points, every[:, 6], units, narrowing)

    def _without_seams(self, pairs: Ints, numbers: Ints) -> tuple[Ints, Ints]:
        """The rows of `SheetSearch.pairs` without those between parts that a closed seam holds together, and
        the narrowing of the others by seams; none where there are no seams.
        """
        if not self._joined:
            return pairs, np.empty(0, dtype=np.int64)
        narrowing = np.full(len(pairs), AREA_UNITS)
        points = numbers[pairs[:, 2:6]]
        rows = self._joined.concern(points)
        lengths = self._joined.lengths(points[rows], points[rows])
        of_edges, of_vertex = lengths[:, :2, 2:].min(axis=(1, 2)), lengths[:, 0, 1:].min(axis=1)
        length = np.where(pairs[rows, 0] == EDGE_EDGE, of_edges, of_vertex)
        closed = length * MAX_NARROWING <= self._gap
        least = np.maximum(length[~closed] * OF_THREAD, self._gap / MAX_NARROWING)
        narrowing[rows[~closed]] = np.rint(AREA_UNITS * np.maximum(self._gap / least, 1.0))
        return np.delete(pairs, rows[closed], axis=0), np.delete(narrowing, rows[closed])

    def _symmetry_planes(self, x: Array, points: Ints) -> Ints:
        """Number of symmetry planes in which all vertices of pairs of edges ``points`` (m, 4) lie, (m,)."""
        at, sheet = np.maximum(points, 0), points >= 0
        on_planes, place = self._on_planes[at] | ~sheet[:, :, None], x[np.where(sheet, at, at[:, :1])]
        # no edge between two planes is shorter than the gap
        in_one = np.ptp(place, axis=1) < 0.5 * self._gap
        return (on_planes.all(axis=1) & in_one).sum(axis=1)
