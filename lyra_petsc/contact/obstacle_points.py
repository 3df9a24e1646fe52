"""Points and simplices of all obstacles in one array each, and their motion in a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact import surface_shares
from lyra_petsc.contact.body_motions import BodyMotions
from lyra_petsc.contact.pairs import ActiveAt, Rows
from lyra_petsc.mesh.obstacles import Container, Solid

SHARP_ANGLE = 0.5
"""Angle [rad] between two triangles of an obstacle above which their common edge has the full gap."""


class ObstaclePositions(NamedTuple):
    """Obstacles in one step.

    Attributes
    ----------
    start, end : (m, 3)
        Points of all obstacles [m], and normals of planes, at the start and the end of the step.
    motions : BodyMotions
        Motions of the obstacles in the step.
    act : bool
        Whether contact is part of the equations of the step.
    active : ActiveAt or None
        The active pairs, where these obstacles belong to an evaluation.
    """

    start: Array
    end: Array
    motions: BodyMotions
    act: bool
    active: ActiveAt | None = None

    def part(self, begin: float, end: float) -> ObstaclePositions:
        """The obstacles between two fractions of the step, on straight lines."""
        moved = self.end - self.start
        return self._replace(start=self.start + begin * moved, end=self.start + end * moved)


class Obstacles:
    """The points of all obstacles in one array, and their simplices.

    Attributes
    ----------
    triangles, edges, points, planes, segments : (n, 5)
        Numbers of three points, number of the obstacle, and for triangles the code of `surface_shares.rings`.
        A plane is a point and a normal. The axis of a nearly flat sphere or rod is also a degenerate
        triangle.
    bodies : list of Solid or Container
        First those of the scene, then the symmetry planes.
    first_wall : int
        Number of the first symmetry plane.
    radius : (obstacles + 1,)
        Offset [m] of each; the last, 0, is that of sheets.
    moving : bool
        Whether any obstacle moves.
    places : dict
        Number of each obstacle and of its first point, by name.
    smooth_points : (n,) bool
        Which points are vertices of triangles, but not of sharp edges.
    smooth_edges : (m,) int64
        Edges of triangles that are not sharp, in ascending order: lower number × ``n_points`` + higher
        number.
    """

    def __init__(
        self,
        obstacles: Sequence[Solid | Container],
        flat: float = np.inf,
        walls: Sequence[Container] = (),
        wall_radius: float = 0.0,
    ) -> None:
        self.first_wall = len(obstacles)
        self.bodies = obstacles = [*obstacles, *walls]
        parts: dict[str, list[Ints]] = {
            kind: [] for kind in ("triangles", "edges", "points", "planes", "segments")
        }
        radius, first, begins = np.zeros(len(obstacles) + 1), 0, []
        smooth_points, smooth_edges = [np.empty(0, dtype=np.bool_)], [np.empty((0, 2), dtype=np.int64)]
        for number, obstacle in enumerate(obstacles):
            n = len(obstacle.points)
            begins.append(first)

            def rows(simplices: Ints, number: int = number, first: int = first) -> Ints:
                n, m = simplices.shape
                filled = np.concatenate([simplices, np.repeat(simplices[:, :1], 3 - m, axis=1)], axis=1)
                rings = surface_shares.rings(simplices) if m == 3 else np.zeros(n, dtype=np.int64)
                return np.column_stack([filled + first, np.full(n, number), rings])

            if isinstance(obstacle, Solid):
                radius[number] = obstacle.radius
                edges, sharp = _triangle_edges(obstacle)
                smooth_edges.append(first + edges[~sharp])
                points = np.zeros(n, dtype=np.bool_)
                points[obstacle.triangles] = True
                points[edges[sharp]] = False
                smooth_points.append(points)
                parts["triangles"].append(rows(obstacle.triangles))
                parts["edges"].append(rows(obstacle.edges))
                parts["points"].append(rows(np.arange(n)[:, None]))
                if obstacle.radius >= flat:
                    points[:] = True
                    smooth_edges.append(first + obstacle.edges)
                    axis = np.array([[0, n - 1, n - 1]])
                    parts["triangles"].append(np.column_stack([axis + first, [number], [0]]))
            elif obstacle.kind == "planes":
                parts["planes"].append(rows(np.column_stack([np.arange(n), np.arange(n, 2 * n)])))
                n *= 2
            else:
                radius[number] = -obstacle.radius
                parts["segments"].append(rows(np.array([[0, n - 1]])))
            if not isinstance(obstacle, Solid):
                smooth_points.append(np.zeros(n, dtype=np.bool_))
            first += n
        radius[self.first_wall : -1] = wall_radius
        smooth = np.concatenate(smooth_edges)
        self.smooth_points = np.concatenate(smooth_points)
        self.smooth_edges = np.sort(smooth[:, 0] * first + smooth[:, 1])
        empty = np.empty((0, 5), dtype=np.int64)
        self.triangles, self.edges, self.points, self.planes, self.segments = (
            np.concatenate([empty, *part]).astype(np.int64) for part in parts.values()
        )
        self.radius, self.n_points = radius, first
        self.moving = any(obstacle.moves for obstacle in obstacles)
        deforming = (n for n, obstacle in enumerate(obstacles) if obstacle.deformation is not None)
        self._deforming = tuple(deforming)
        self._triangle_of = np.zeros((first, 3), dtype=np.int64)
        for corner in range(3 if self._deforming else 0):
            self._triangle_of[self.triangles[:, corner]] = self.triangles[:, :3]
        self._first = np.array(begins, dtype=np.int64)
        self.places = {body.name: (number, begins[number]) for number, body in enumerate(obstacles)}
        self._at_rest = [(np.eye(3), np.zeros(3))] * len(obstacles)
        self._fixed_positions: Array | None = None
        if not self.moving:
            self._fixed_positions = self.positions(0.0)

    def positions(self, time: float) -> Array:
        """Points and normals (m, 3) at a time [s]."""
        if self._fixed_positions is not None:
            return self._fixed_positions
        rows = [np.empty((0, 3))]
        for body in self.bodies:
            rows.append(body.positions(time))
            if isinstance(body, Container) and body.kind == "planes":
                rows.append(body.normals_at(time))
        return np.concatenate(rows)

    def in_step(self, start: float, end: float, *, act: bool) -> ObstaclePositions:
        """The obstacles in a step between two times [s]."""
        return ObstaclePositions(self.positions(start), self.positions(end), self.motions(start, end), act)

    def bounding_boxes(self, x: Array) -> tuple[Array, Array]:
        """Low and high corners (obstacles, 3) [m] of each obstacle over k positions x (k, m, 3) [m]."""
        low, high = x.min(axis=0), x.max(axis=0)
        return np.minimum.reduceat(low, self._first), np.maximum.reduceat(high, self._first)

    def path_deviations(self, start: float, end: float) -> Array:
        """Largest deviation [m] of each obstacle's paths from straight lines between two times [s],
        (obstacles,).
        """
        times, out = np.linspace(start, end, 9), np.zeros(len(self.bodies))
        for number, body in enumerate(self.bodies):
            if body.moves:
                first, *between, last = (body.positions(time) for time in times)
                chord = last - first
                square = np.maximum(np.sum(chord * chord, axis=1, keepdims=True), np.finfo(float).tiny)
                for x in between:
                    t = np.clip(np.sum((x - first) * chord, axis=1, keepdims=True) / square, 0.0, 1.0)
                    deviation = np.linalg.norm(x - first - t * chord, axis=1).max(initial=0.0)
                    out[number] = max(out[number], float(deviation))
        return out

    def motions(self, start: float, end: float) -> BodyMotions:
        """The motions of all obstacles from one time [s] to another."""
        if not self.moving:
            points = self.positions(start)
            return BodyMotions(self._at_rest, (), points, points, self._triangle_of)
        motions = []
        for body in self.bodies:
            (r0, t0), (r1, t1) = body.rigid_motion(start), body.rigid_motion(end)
            rotation = r1 @ r0.T
            motions.append((rotation, t1 - rotation @ t0))
        positions = self.positions(start), self.positions(end)
        return BodyMotions(motions, self._deforming, *positions, self._triangle_of)

    def contact_displacements(
        self,
        x: Array,
        points: Rows,
        beta: Array,
        obstacle: Ints,
        simplices: Ints,
        motions: BodyMotions,
    ) -> Array:
        """Displacements (m, 3) [m] of obstacles at their contacts, times Σ β_i of the sheet's points.

        ``points``, ``beta`` (m, 4) and ``obstacle`` (m,) are the pairs at positions x (n_local, 3) after the
        ``motions``, and ``simplices`` (m, 4) the obstacle's points, as `BodyMotions.carried` takes them; 0
        for pairs between sheets, whose obstacle is −1.
        """
        out = np.zeros((len(points), 3))
        for number in range(len(self.bodies) if self.moving else 0):
            rows = np.flatnonzero(obstacle == number)
            sheet_beta = np.where(points[rows] >= 0, beta[rows], 0.0)
            side = sheet_beta.sum(axis=1, keepdims=True)
            contact = np.einsum("ei,eik->ek", sheet_beta, x[np.maximum(points[rows], 0)]) / side
            out[rows] = side * motions.displacements(number, contact, simplices[rows])
        return out

    def contact_velocities(
        self,
        x: Array,
        v: Array,
        points: Ints,
        beta: Array,
        obstacle: Ints,
        simplices: Ints,
        last: tuple[float, float],
    ) -> Array:
        """Mean velocities (m, 3) [m/s] of obstacles at their contacts between the times ``last`` [s], times Σ
        β_i; positions x and velocities v (n_local, 3) are those at the end.

        They are means for the points of the obstacle that are at the contact before and after: chords of its
        rotation have components along the normal, even if the distance does not change.
        """
        if not self.moving:
            return np.zeros((len(points), 3))
        duration = last[1] - last[0]
        moved, back = (
            self.contact_displacements(at, points, beta, obstacle, simplices, self.motions(*times))
            for at, times in ((x, last), (x - duration * v, last[::-1]))
        )
        return 0.5 * (moved - back) / duration


def obstacle_loads(
    x: Array, rows: Rows, beta: Array, obstacle: Ints, force: Array, sizes: Array
) -> tuple[Ints, Array]:
    """Numbers of obstacles and loads (m, 8) on them by forces β times ``force`` (E, 3) [N] on vertices in
    local rows (E, 4): force [N], torque [N m] about the origin, and the two ``sizes`` (E, 2) [N].

    Pairs between sheets, whose obstacle (E,) is −1, have none.
    """
    on = np.flatnonzero(obstacle >= 0)
    side = beta[on].sum(axis=1, keepdims=True)
    place, load = np.einsum("ei,eik->ek", beta[on], x[rows[on]]) / side, -side * force[on]
    return obstacle[on], np.hstack([load, np.cross(place, load), sizes[on]])


def _triangle_edges(obstacle: Solid) -> tuple[Ints, NDArray[np.bool_]]:
    """Edges (n, 2) of an obstacle's triangles, lower numbers first, and whether they are sharp: at the
    boundary, or with an angle above `SHARP_ANGLE`.
    """
    triangles = obstacle.triangles.astype(np.int64).reshape(-1, 3)
    a, b, c = (obstacle.points[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    sign = np.where(sides[:, :1] < sides[:, 1:], 1.0, -1.0)
    edges, number, count = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(edges), 3))
    np.add.at(sums, number.ravel(), sign * np.tile(normal, (3, 1)))  # n − n′ of equally oriented triangles
    difference = np.linalg.norm(sums, axis=1)
    return edges, (count != 2) | (difference > 2.0 * np.sin(0.5 * SHARP_ANGLE))
