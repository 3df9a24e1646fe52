"""Search for the pairs of sheets and obstacles that may come near each other in a step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact import pair_distances
from lyra_petsc.contact.near import overlapping_pairs, swept_boxes
from lyra_petsc.contact.obstacle_points import Obstacles
from lyra_petsc.contact.pair_distances import EDGE_EDGE, VERTEX_INSIDE, VERTEX_PLANE, VERTEX_TRIANGLE
from lyra_petsc.contact.sheet_search import SheetSearch, Simplices


class ObstacleSearch:
    """Pairs of the sheets of a `SheetSearch` and obstacles.

    Parameters
    ----------
    obstacles : Obstacles
    sheets : SheetSearch
    distance : float
        Largest distance less offset [m] of the pairs.

    Attributes
    ----------
    x : (2, m, 3)
        Points of the obstacles [m] at the start and the end of the step.
    deviations : (obstacles,) or (1,)
        Largest deviation [m] of each obstacle's paths in the step from straight lines.
    """

    def __init__(self, obstacles: Obstacles, sheets: SheetSearch, distance: float) -> None:
        self._obstacles, self._sheets, self._distance = obstacles, sheets, distance
        self.x = np.stack([obstacles.positions(0.0)] * 2)
        self.deviations = np.zeros(1)
        self._boxes: tuple[Array, Array] | None = None  # of obstacles at ``x``

    def move(self, x: Array) -> None:
        """Take the points x (2, m, 3) [m] of the present step."""
        self.x, self._boxes = x, None

    def _within_radius(
        self, x: Array, dx: Array, kind: int, obstacle: Ints, points: Ints, rings: Ints
    ) -> Ints:
        """Rows (m, 7) of the pairs that may come within the search distance on displacements dx (N, 3)."""
        points, bounds = points.astype(np.int64), np.empty(len(points))
        kinds = np.full(len(points), kind)
        radius = self._distance + self._obstacles.radius[obstacle] + self.deviations.max()
        start, end = self.x
        pair_distances.swept_distance_bounds(x, start, dx, end - start, kinds, points, radius, bounds)
        return np.column_stack([kinds, obstacle, points, rings])[bounds < radius]

    def pairs(self, x: Array, dx: Array, boxes: Array, walled: NDArray[np.bool_]) -> list[Ints]:
        """Pairs of sheets and obstacles anywhere on their displacements in the step.

        ``boxes`` are those of the patches of sheets (`SheetSearch.boxes`), ``walled`` (N, walls) says which
        symmetry planes act on each vertex.
        """
        obstacles, sheets = self._obstacles, self._sheets
        patches = np.minimum(boxes[0], boxes[2]), np.maximum(boxes[1], boxes[3])
        if not len(patches[0]):
            return []
        low, high = patches[0].min(axis=0), patches[1].max(axis=0)
        radius = self._distance + self.deviations.max()
        obstacle_x = self.x if self._obstacles.moving else self.x[:1]
        parts = self._container_pairs(x, dx, patches, obstacle_x, radius, walled)
        if self._boxes is None:
            self._boxes = obstacles.bounding_boxes(obstacle_x)
        margin = (radius + obstacles.radius[:-1])[:, None]
        lowest, highest = self._boxes
        is_near = ((lowest - margin <= high) & (highest + margin >= low)).all(axis=1)
        if not is_near.any():
            return parts

        def add_pairs(kind: int, sheet: Simplices, others: Ints, size: int, *, sheet_first: bool) -> None:
            others = others[is_near[others[:, 3]]]
            if not len(others):
                return
            corners = np.ascontiguousarray(others[:, :size])
            lower, upper = swept_boxes(obstacle_x[0], obstacle_x[-1] - obstacle_x[0], corners)
            margin = (radius + obstacles.radius[others[:, 3]])[:, None]
            boxes = lower - margin, upper + margin
            kept = ((boxes[0] <= high) & (boxes[1] >= low)).all(axis=1)
            others, boxes = others[kept], (boxes[0][kept], boxes[1][kept])
            near_patches = overlapping_pairs(patches, boxes)
            if not len(near_patches):
                return
            corners = sheet.corners_of(np.unique(near_patches[:, 0]))
            pairs = overlapping_pairs(swept_boxes(x, dx, corners), boxes)
            own, theirs = corners[pairs[:, 0]], ~others[pairs[:, 1], :size]
            points = np.concatenate([own, theirs] if sheet_first else [theirs, own], axis=1)
            rings = others[pairs[:, 1], 4] if sheet_first else np.zeros(len(points), dtype=np.int64)
            parts.append(self._within_radius(x, dx, kind, others[pairs[:, 1], 3], points, rings))

        add_pairs(VERTEX_TRIANGLE, sheets.vertices, obstacles.triangles, 3, sheet_first=True)
        add_pairs(VERTEX_TRIANGLE, sheets.triangles, obstacles.points, 1, sheet_first=False)
        add_pairs(EDGE_EDGE, sheets.edges, obstacles.edges, 2, sheet_first=True)
        return parts

    def _container_pairs(
        self,
        x: Array,
        dx: Array,
        patches: tuple[Array, Array],
        obstacle_x: Array,
        radius: float,
        walled: NDArray[np.bool_],
    ) -> list[Ints]:
        """Pairs of vertices and planes, and of vertices in balls and capsules and the axis segments."""
        parts, obstacles = [], self._obstacles
        for kind, others in ((VERTEX_PLANE, obstacles.planes), (VERTEX_INSIDE, obstacles.segments)):
            if not len(others):
                continue
            low, high = patches[0].min(axis=0, keepdims=True), patches[1].max(axis=0, keepdims=True)
            # distances of two points from a plane or segment differ at most by the points' distance
            for lower, upper in ((low, high), patches):
                half_diagonal = 0.5 * np.linalg.norm(upper - lower, axis=1)
                close = self._is_close(
                    0.5 * (lower + upper), kind, others, obstacle_x, radius + half_diagonal
                )
                others = others[close.any(axis=0)]
                if not len(others):
                    break
            else:
                single = self._sheets.vertices.corners_of(np.flatnonzero(close.any(axis=1)))[:, 0]
                close = np.zeros((len(single), len(others)), dtype=np.bool_)
                for end in (x, x + dx):  # on straight paths the distance is lowest at an end
                    close |= self._is_close(end[single], kind, others, obstacle_x, radius)
                walls = np.flatnonzero(others[:, 3] >= obstacles.first_wall)
                close[:, walls] &= walled[single][:, others[walls, 3] - obstacles.first_wall]
                number, plane = np.nonzero(close)
                points = np.column_stack([single[number], ~others[plane, :3]])
                zeros = np.zeros(len(points), dtype=np.int64)
                parts.append(np.column_stack([zeros + kind, others[plane, 3], points, zeros]))
        return parts

    def _is_close(
        self, points: Array, kind: int, others: Ints, obstacle_x: Array, radius: float | Array
    ) -> NDArray[np.bool_]:
        """Whether points (n, 3) [m] are within radius [m] of planes or segments (m, 5), (n, m)."""
        n, m = len(points), len(others)
        pairs = np.column_stack([np.repeat(np.arange(n), m), np.tile(~others[:, :3], (n, 1))])
        kinds, out, smallest = np.full(n * m, kind), np.empty(n * m), np.full((n, m), np.inf)
        for positions in obstacle_x:
            pair_distances.distances(points, positions, kinds, pairs, out)
            smallest = np.minimum(smallest, out.reshape(n, m))
        smallest -= self._obstacles.radius[others[:, 3]]
        return smallest < np.reshape(radius, (-1, 1))
