"""Heights of parts of sheets above layers and obstacles, by which starts that cross are taken apart."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.contact.crossings import mutual_crossings
from lyra_petsc.contact.enclosed import enclosed_sheets
from lyra_petsc.contact.joined import JoinedVertices, crossings_beside_seams
from lyra_petsc.contact.layer_pairs import Surfaces, find_layer_pairs, unit, wanted_sides
from lyra_petsc.contact.overlaps import inside_ball
from lyra_petsc.contact.start_crossings import PlacedScene
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.mesh.symmetry import symmetry_walls
from lyra_petsc.mesh.topology import connected_pieces

SAMPLES = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6.0
"""Points of a triangle (barycentric) that are kept out of round obstacles."""


ROUNDING = 1e-6
"""Part of the gap up to which sides of seams that coincide may pass each other."""


class Heights(NamedTuple):
    """Heights of parts above others, each a product of a direction with a weighted sum of positions.

    Attributes
    ----------
    points : (n, 4) int64
    weights : (n, 4) float64
    directions : (n, 3) float64
        Unit vectors, towards the right side.
    now, start : (n,) float64
        Heights [m] at the present positions, and with the same weights at those of the start.
    wrong : (n,) bool
        Whether the part is on the wrong side.
    slope : (n,) float64
        Distance over height.
    """

    points: Ints
    weights: Array
    directions: Array
    now: Array
    start: Array
    wrong: Mask
    slope: Array

    def chosen(self, rows: Mask) -> Heights:
        """The rows (n,) of all arrays for which ``rows`` is true."""
        return _heights([array[rows] for array in self])

    def changes(self, y: Array) -> Array:
        """Changes (n,) [m] of the heights by displacements y (V, 3) [m]."""
        return np.einsum("ni,nk,nki->n", self.directions, self.weights, y[self.points], optimize=True)


class PartHeights:
    """The heights of the parts of a scene with contact.

    Parameters
    ----------
    placed : PlacedScene
    gap : float
        Of contact [m].

    Attributes
    ----------
    surfaces : Surfaces
        Of sheets and obstacles with triangles.
    start : (V, 3) float64
        Their points [m].
    """

    def __init__(self, placed: PlacedScene, gap: float) -> None:
        scene, mesh, positions, obstacles, time = placed
        assert scene.contact is not None
        self._self, self._sheets = scene.contact.self, mesh.triangles
        self._tied, self._joined = mesh.tied, JoinedVertices(mesh.tied)
        self._time, self._n, self._gap, self._thickness = time, len(positions), gap, scene.contact.thickness
        points, triangles, self._bodies = [positions], [mesh.triangles.astype(np.int64)], []
        for body in obstacles:
            if isinstance(body, Solid) and len(body.triangles):
                triangles.append(body.triangles + sum(map(len, points)))
                points.append(body.positions(time))
                begin = sum(map(len, triangles[:-1]))
                self._bodies.append(slice(begin, begin + len(body.triangles)))
        self.start = np.concatenate(points)
        self.surfaces = Surfaces.build(self.start, np.concatenate(triangles), len(mesh.triangles))
        self._round = [one for one in obstacles if isinstance(one, Solid) and not len(one.triangles)]
        whole = np.arange(self._n)
        self._containers = [(one, whole) for one in obstacles if isinstance(one, Container)]
        self._containers += [(wall.container, wall.vertices) for wall in symmetry_walls(scene, mesh)]

    def at(self, x: Array) -> tuple[Heights, bool]:
        """The heights at positions x (V, 3) [m], and whether anything crosses or is inside of a body."""
        crossings, enclosed = self._crossings(x)
        parts = [self._of_layers(x, crossings, enclosed), *self._in_containers(x), *self._above_round(x)]
        heights = _heights([np.concatenate(arrays) for arrays in zip(*parts, strict=True)])
        return heights, bool(len(crossings) or len(enclosed))

    def _crossings(self, x: Array) -> tuple[Ints, Ints]:
        """Pairs (n, 2) of triangles that cross, not both of obstacles, and of sheets only with self-contact;
        and pieces (m, 2), of a sheet and of an obstacle around it.
        """
        sheets, piece, every = self._sheets, self.surfaces.piece, self.surfaces.triangles
        pairs, around = [np.empty((0, 2), np.int64)], [np.empty((0, 2), np.int64)]
        if self._self:
            pairs.append(crossings_beside_seams(x[: self._n], sheets, self._tied))
        of_sheet = piece[sheets[:, 0]]
        for body in self._bodies:
            theirs = every[body]
            crossing = mutual_crossings(x[: self._n], sheets, x, theirs)
            inside, number = enclosed_sheets(x[: self._n], sheets, of_sheet, x, theirs, crossing)
            sheet, closed = np.nonzero(inside)
            around.append(np.column_stack([sheet, piece[theirs[np.searchsorted(number, closed), 0]]]))
            pairs.append(crossing + np.array([0, body.start]))
        return np.concatenate(pairs), np.concatenate(around)

    def _of_layers(self, x: Array, crossings: Ints, enclosed: Ints) -> Heights:
        """Heights of layers above each other, for the right order."""
        surfaces = self.surfaces
        piece = surfaces.piece[surfaces.triangles[crossings, 0]]
        within = np.zeros(int(surfaces.piece.max()) + 1, dtype=bool)
        within[piece[piece[:, 0] == piece[:, 1], 0]] = True
        pairs = find_layer_pairs(surfaces, x, within)
        side, wrong = wanted_sides(surfaces, x, pairs, crossings, enclosed)
        own = surfaces.piece[pairs.points[:, [0, 3]]]
        kept = wrong | (own[:, 0] != own[:, 1])
        if not self._self:
            kept &= (own >= surfaces.n_sheets).any(axis=1)
        directions = side[:, None] * pairs.directions
        now, start = side * pairs.heights(x), side * pairs.heights(self.start)
        # seams may hold parts together that have not crossed
        kept &= wrong | (start < -ROUNDING * self._gap) | ~pairs.at_seams(self._joined)
        return Heights(pairs.points, pairs.weights, directions, now, start, wrong, pairs.slope).chosen(kept)

    def _in_containers(self, x: Array) -> Iterator[Heights]:
        """Heights of vertices above planes, and above the inside of round containers."""
        for container, vertices in self._containers:
            points, here = container.positions(self._time), x[vertices]
            if container.kind == "planes":
                normals = container.normals_at(self._time)
                sides = [(n, (here - p) @ n) for p, n in zip(points, normals, strict=True)]
                sides = [(np.broadcast_to(n, here.shape), height) for n, height in sides]
            else:
                offset = nearest_on_segment(here, points) - here
                distance = np.linalg.norm(offset, axis=1)
                inwards = offset / np.maximum(distance, 1e-300)[:, None]
                sides = [(inwards, container.radius - distance)]
            for directions, height in sides:
                near = height < self.surfaces.reach
                yield self._of_points(
                    x, vertices[near][:, None], np.ones((1, 1)), directions[near], height[near]
                )

    def _above_round(self, x: Array) -> Iterator[Heights]:
        """Heights of points of triangles above spheres and capsules.

        Near the surface directions are radial; towards the axis they turn into the mean one of the overlap,
        as the sheet is to leave the body on one side.
        """
        triangles = self._sheets
        for body in self._round:
            axis = body.positions(self._time)
            inside = inside_ball(
                x[: self._n], triangles, axis, body.radius + self._thickness + self._gap
            ).triangles
            if not len(inside):
                continue
            corners = np.repeat(triangles[inside], len(SAMPLES), axis=0)
            weights = np.tile(SAMPLES, (len(inside), 1))
            points = np.einsum("nk,nki->ni", weights, x[corners])
            offset = points - nearest_on_segment(points, axis)
            distance = np.linalg.norm(offset, axis=1)
            radial = offset / np.maximum(distance, 1e-300)[:, None]
            group = np.repeat(connected_pieces(triangles[inside]), len(SAMPLES))
            depth = np.maximum(body.radius - distance, 0.0)
            mean: Array = np.stack([np.bincount(group, depth * radial[:, k]) for k in range(3)], axis=1)
            part = np.minimum(distance / body.radius, 1.0)[:, None] ** 2
            directions = part * radial + (1.0 - part) * unit(mean)[group]
            directions = unit(np.where((distance > 0.0)[:, None], directions, mean[group]))
            height = -way_out(points, axis, body.radius, directions)
            height = np.where(distance > body.radius, distance - body.radius, height)
            yield self._of_points(x, corners, weights, directions, height)

    def _of_points(self, x: Array, points: Ints, weights: Array, directions: Array, height: Array) -> Heights:
        """Heights (n,) [m] of weighted sums of vertices (n, k) above an obstacle."""
        n, k = points.shape
        every = np.zeros((n, 4))
        every[:, :k] = weights
        points = np.concatenate([points, np.repeat(points[:, :1], 4 - k, axis=1)], axis=1)
        heights = Heights(points, every, directions, height, height, height < 0.0, np.ones(n))
        return heights._replace(start=height - heights.changes(x - self.start))


def _heights(arrays: list[Any]) -> Heights:
    return Heights(*arrays)


def nearest_on_segment(points: Array, ends: Array) -> Array:
    """The nearest points (n, 3) of a segment between the first and last of ``ends`` (m, 3) [m]."""
    along = ends[-1] - ends[0]
    part = np.clip((points - ends[0]) @ along / max(float(along @ along), 1e-300), 0.0, 1.0)
    return np.asarray(ends[0] + part[:, None] * along)


def way_out(points: Array, ends: Array, radius: float, directions: Array) -> Array:
    """Distances (n,) [m] along directions (n, 3) at which points leave a sphere or capsule, by bisection."""
    low = np.zeros(len(points))
    high = np.full(len(points), 2.0 * radius + float(np.linalg.norm(ends[-1] - ends[0])))
    for _ in range(60):
        middle = 0.5 * (low + high)
        moved = points + middle[:, None] * directions
        inside = np.linalg.norm(moved - nearest_on_segment(moved, ends), axis=1) < radius
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return high
