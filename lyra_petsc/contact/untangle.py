"""Starts that cross are taken apart before the first step (rank 0).

Each overlap is resolved by displacements y of the sheets' vertices from the start that minimise
½ Σ_edges |y_i − y_j|² + ½ Σ |y_i|² / L² while every part that the overlap has moved to the wrong side of a
layer (`layer_pairs`), or into an obstacle, returns to a small distance on the right side. The pairs are found
anew at the solution until none crosses. Which side is right is decided as in the global intersection analysis
of Baraff, Witkin & Kass (Untangling cloth, SIGGRAPH 2003): a contour of crossings divides a surface, and
the smaller part is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.contact.crossings import self_crossings
from lyra_petsc.contact.layer_pairs import Surfaces, find_layer_pairs, unit, wanted_sides
from lyra_petsc.contact.overlaps import inside_ball
from lyra_petsc.contact.start_crossings import find_start_crossings, refuse
from lyra_petsc.errors import MarkedError
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.mesh.symmetry import symmetry_walls
from lyra_petsc.mesh.topology import connected_pieces
from lyra_petsc.scene.schema import Scene

SMOOTH = 6.0
"""Length L, in edges, over which displacements spread."""

PENALTY = 200.0
"""Stiffness of a constraint over that of an edge."""

MAX_ROUNDS = 30
"""Largest number of searches for pairs."""

RESIDUAL, MAX_ITERATIONS = 1e-6, 1000
"""Relative residual of the linear solves, and largest number of their iterations."""

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

SAMPLES = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6.0
"""Points of a triangle (barycentric) that are kept out of round obstacles."""


class Untangled(NamedTuple):
    """Positions without crossings.

    Attributes
    ----------
    positions : (V, 3) float64
        [m]
    pairs : int
        Number of crossings of the start: pairs of triangles, and triangles in obstacles.
    depth : float
        Depth [m] of the overlap: the largest distance on the wrong side, with that which is to be kept.
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
        return Heights(
            self.points[rows],
            self.weights[rows],
            self.directions[rows],
            self.now[rows],
            self.start[rows],
            self.wrong[rows],
            self.slope[rows],
        )


def untangle(
    scene: Scene,
    mesh: Mesh,
    positions: Array,
    obstacles: Sequence[Solid | Container],
    gap: float,
    held: Mapping[int, Ints],
) -> Untangled | None:
    """The start without its crossings; None if it has none.

    Parameters
    ----------
    scene : Scene
        A scene with ``contact``.
    mesh : Mesh
    positions : (V, 3) float64
        Start positions [m].
    obstacles : sequence of Solid or Container
    gap : float
        Of contact [m].
    held : mapping of int to (n,) int64
        Vertices of handles, which keep the coordinates that these hold.

    Raises
    ------
    MarkedError
        If crossings are left, or displacements are too large; the message says which.
    """
    start = find_start_crossings(scene, mesh, positions, obstacles)
    if not start.crossings:
        return None
    count = sum(len(crossing.triangles) for crossing in start.crossings)
    work = _Untangling(scene, mesh, positions, obstacles, gap, held)
    x = work.run()
    left = find_start_crossings(scene, mesh, x, obstacles)
    refuse(left, "at the start contact.untangle leaves", "move them apart")
    largest = float(np.linalg.norm(x - positions, axis=1).max())
    if largest > LARGEST_DISPLACEMENT * work.depth:
        raise MarkedError(
            f"at the start {count} crossings up to {work.depth:.3g} m deep are only resolved by "
            f"displacements of up to {largest:.3g} m, more than {LARGEST_DISPLACEMENT:g} times as large; "
            "move them apart",
            start,
            file=scene.source,
            key="contact.untangle",
        )
    return Untangled(x, count, work.depth, largest)


class _Untangling:
    """The state of the iteration; see `untangle` for parameters."""

    def __init__(
        self,
        scene: Scene,
        mesh: Mesh,
        positions: Array,
        obstacles: Sequence[Solid | Container],
        gap: float,
        held: Mapping[int, Ints],
    ) -> None:
        assert scene.contact is not None
        self._n, self._gap, self._thickness = len(positions), gap, scene.contact.thickness
        self._self = scene.contact.self
        bodies = [one for one in obstacles if isinstance(one, Solid) and len(one.triangles)]
        points, triangles = [positions], [mesh.triangles.astype(np.int64)]
        for body in bodies:
            triangles.append(body.triangles + sum(map(len, points)))
            points.append(body.positions(0.0))
        self._start = np.concatenate(points)
        self._sheet_triangles = mesh.triangles
        every = np.concatenate(triangles)
        self.surfaces = Surfaces.build(self._start, every, len(mesh.triangles))
        self._round = [one for one in obstacles if isinstance(one, Solid) and not len(one.triangles)]
        whole = np.arange(self._n)
        containers = [one for one in obstacles if isinstance(one, Container)]
        self._containers = [(one, whole) for one in containers]
        self._containers += [(wall.container, wall.vertices) for wall in symmetry_walls(scene, mesh)]
        self._free = np.zeros((len(self._start), 3), dtype=bool)
        self._free[: self._n] = True
        for number, vertices in held.items():
            for axis in scene.handles[number].axis_numbers:
                self._free[vertices, axis] = False
        self._clearance = 0.0
        self.depth = 0.0

    def run(self) -> Array:
        """Positions (V, 3) [m] of the last round."""
        x = self._start.copy()
        for _ in range(MAX_ROUNDS):
            crossings = self._crossings(x)
            parts = [self._layer_heights(x, crossings), *self._container_heights(x), *self._round_heights(x)]
            heights = joined(parts)
            if not self.depth:
                depths = -(heights.now * heights.slope)[heights.wrong]
                self._take_depth(float(depths.max(initial=0.0)))
            if not len(crossings) and not (heights.wrong | (heights.now < self._least(heights))).any():
                break
            y = self._solve(heights, x - self._start)
            if np.array_equal(x, self._start + y):
                break
            x = self._start + y
        return x[: self._n]

    def _crossings(self, x: Array) -> Ints:
        """Pairs of triangles that cross, not both of obstacles, and of sheets only with self-contact."""
        pairs = self_crossings(x, self.surfaces.triangles)
        sheets = (pairs < len(self._sheet_triangles)).sum(axis=1)
        return pairs[(sheets == 1) | ((sheets == 2) & self._self)]

    def _take_depth(self, height: float) -> None:
        """Set clearance and depth by the largest height [m] on a wrong side."""
        self._clearance = float(np.clip(0.5 * height, LEAST_CLEARANCE * self._gap, self._gap))
        self.depth = height + self._thickness + self._clearance

    def _targets(self, heights: Heights) -> Array:
        """Heights (n,) [m] that parts are to have: those that were nearer at the start keep that distance."""
        full = (self._thickness + self._clearance) * np.minimum(1.0 / heights.slope, STEEPEST)
        near = heights.wrong | (heights.start <= self._thickness)
        return np.where(near, full, np.minimum(full, heights.start))

    def _least(self, heights: Heights) -> Array:
        """Heights (n,) [m] with which a start is accepted."""
        enough = self._thickness + ENOUGH * (self._targets(heights) - self._thickness)
        return np.where(heights.start <= self._thickness, enough, 0.0)

    def _layer_heights(self, x: Array, crossings: Ints) -> Heights:
        """Heights of layers above each other, for the right order."""
        surfaces = self.surfaces
        piece = surfaces.piece[surfaces.triangles[crossings, 0]]
        within = np.zeros(int(surfaces.piece.max()) + 1, dtype=bool)
        within[piece[piece[:, 0] == piece[:, 1], 0]] = True
        pairs = find_layer_pairs(surfaces, x, within)
        side, wrong = wanted_sides(surfaces, x, pairs, crossings)
        own = surfaces.piece[pairs.points[:, [0, 3]]]
        kept = wrong | (own[:, 0] != own[:, 1])
        if not self._self:
            kept &= (own >= surfaces.n_sheets).any(axis=1)
        directions = side[:, None] * pairs.directions
        now, start = side * pairs.heights(x), side * pairs.heights(self._start)
        return Heights(pairs.points, pairs.weights, directions, now, start, wrong, pairs.slope).chosen(kept)

    def _container_heights(self, x: Array) -> list[Heights]:
        """Heights of vertices above planes, and above the inside of round containers."""
        parts = []
        for container, vertices in self._containers:
            points, here = container.positions(0.0), x[vertices]
            if container.kind == "planes":
                normals = container.normals_at(0.0)
                found = [(n, (here - p) @ n) for p, n in zip(points, normals, strict=True)]
                found = [(np.broadcast_to(n, here.shape), height) for n, height in found]
            else:
                offset = nearest_on_segment(here, points) - here
                distance = np.linalg.norm(offset, axis=1)
                found = [(offset / np.maximum(distance, 1e-300)[:, None], container.radius - distance)]
            for directions, height in found:
                near = height < self.surfaces.reach
                parts.append(
                    self._of_points(x, vertices[near][:, None], None, directions[near], height[near])
                )
        return parts

    def _round_heights(self, x: Array) -> list[Heights]:
        """Heights of points of triangles above spheres and capsules.

        Near the surface directions are radial; towards the axis they turn into the mean one of the overlap,
        as the sheet is to leave the body on one side.
        """
        parts, triangles = [], self._sheet_triangles
        for body in self._round:
            axis, near = body.positions(0.0), body.radius + self._thickness + self._gap
            inside = inside_ball(x[: self._n], triangles, axis, near).triangles
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
            parts.append(self._of_points(x, corners, weights, directions, height))
        return parts

    def _of_points(
        self, x: Array, points: Ints, weights: Array | None, directions: Array, height: Array
    ) -> Heights:
        """Heights (n,) [m] of vertices, or weighted sums of vertices (n, k), above an obstacle."""
        n, k = points.shape
        every = np.zeros((n, 4))
        every[:, :k] = 1.0 if weights is None else weights
        points = np.concatenate([points, np.repeat(points[:, :1], 4 - k, axis=1)], axis=1)
        moved = np.einsum("nk,nki->ni", every, (x - self._start)[points])
        start = height - np.einsum("ni,ni->n", directions, moved)
        return Heights(points, every, directions, height, start, height < 0.0, np.ones(n))

    def _solve(self, heights: Heights, y: Array) -> Array:
        """Displacements (V, 3) [m] to the heights, from an estimate y that chooses which are too low."""
        targets = self._targets(heights)
        least = targets - heights.start
        active = np.zeros(len(least), dtype=bool)
        for number in range(MAX_SOLVES):
            sums = np.einsum("nk,nki->ni", heights.weights, y[heights.points])
            lack = least - np.einsum("ni,ni->n", heights.directions, sums)
            pulled_down = active & (lack < -PULL * targets) & (number < RELEASING)
            if (lack <= SLACK * targets).all() and not pulled_down.any():
                break
            active = lack > 0.0
            y = self._minimum(heights.chosen(active), least[active])
        return y

    def _minimum(self, heights: Heights, least: Array) -> Array:
        """Displacements (V, 3) [m] that minimise the energy with springs that lift parts by ``least``
        (n,) [m].
        """
        edges = self.surfaces.edges
        edges = edges[(edges < self._n).all(axis=1)]
        number = np.full(self._free.shape, -1)
        moved = np.zeros(len(self._start), dtype=bool)
        pieces = np.unique(self.surfaces.piece[heights.points])
        moved[np.isin(self.surfaces.piece, pieces)] = True
        free = self._free & moved[:, None]
        n = int(free.sum())
        y = np.zeros_like(self._start)
        if n == 0 or not len(least):
            return y
        number[free] = np.arange(n)
        rows, columns, values = [np.arange(n)], [np.arange(n)], [np.full(n, SMOOTH**-2)]
        for i, j, value in ((0, 0, 1.0), (1, 1, 1.0), (0, 1, -1.0), (1, 0, -1.0)):
            for axis in range(3):
                one, two = number[edges[:, i], axis], number[edges[:, j], axis]
                known = (one >= 0) & (two >= 0)
                rows.append(one[known])
                columns.append(two[known])
                values.append(np.full(known.sum(), value))
        m = len(least)
        gradient = (heights.weights[:, :, None] * heights.directions[:, None, :]).reshape(m, 12)
        unknowns = number[heights.points].reshape(m, 12)
        right = np.zeros(n)
        for i in range(12):
            known = unknowns[:, i] >= 0
            force = PENALTY * gradient[:, i] * least
            right += np.bincount(unknowns[known, i], force[known], n)
            for j in range(12):
                both = known & (unknowns[:, j] >= 0)
                rows.append(unknowns[both, i])
                columns.append(unknowns[both, j])
                values.append(PENALTY * (gradient[:, i] * gradient[:, j])[both])
        y[free] = _solution(n, np.concatenate(rows), np.concatenate(columns), np.concatenate(values), right)
        return y


def joined(parts: Sequence[Heights]) -> Heights:
    """All heights of several parts."""
    return Heights(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


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


def _solution(n: int, rows: Ints, columns: Ints, values: Array, right: Array) -> Array:
    """Solution (n,) of a sparse symmetric positive-definite system, whose entries are summed up."""
    keys, place = np.unique(rows * n + columns, return_inverse=True)
    entries = np.bincount(place.ravel(), values, len(keys))
    at, column = np.divmod(keys, n)
    begins = np.searchsorted(at, np.arange(n + 1))
    indices = [array.astype(PETSc.IntType) for array in (begins, column)]
    matrix = PETSc.Mat().createAIJ((n, n), csr=(*indices, entries), comm=PETSc.COMM_SELF)
    solver = PETSc.KSP().create(PETSc.COMM_SELF)
    solver.setOptionsPrefix("untangle_")
    solver.setType("cg")
    solver.getPC().setType("sor")
    solver.setTolerances(rtol=RESIDUAL, max_it=MAX_ITERATIONS)
    solver.setOperators(matrix)
    b, y = matrix.createVecs()
    b.setArray(right)
    solver.solve(b, y)
    solution = y.getArray().copy()
    for one in (solver, matrix, b, y):
        one.destroy()
    return solution
