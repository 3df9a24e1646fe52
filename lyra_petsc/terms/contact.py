"""Contact of sheets with themselves, each other and obstacles: a barrier on the distances of simplices.

Pairs of a vertex and a triangle and of two edges that have no vertex in common and are nearer than ``gap``
(beside ``thickness`` and the radius of an obstacle) repel each other (``contact_pairs``). The barrier's
stiffness k is such that halfway through the gap b″ is the sheet's membrane stiffness, that is about the
diagonal of its Jacobian.

Nothing passes through: no Newton iteration goes farther than continuous collision detection allows, and none
moves points so far that pairs might meet which the last search did not see.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.mesh import patches
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.measures import edge_lengths
from lyra_petsc.mesh.near import near, swept_boxes
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms import contact_pairs, surface_shares
from lyra_petsc.terms.contact_pairs import EDGE_EDGE, VERTEX_INSIDE, VERTEX_PLANE, VERTEX_TRIANGLE
from lyra_petsc.terms.contact_search import SheetSearch, Simplices
from lyra_petsc.terms.one_sided import Springs
from lyra_petsc.terms.remembered import Remembered, unwritable
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Dashpots, Elastic, Offsets, Pair, StepInterval, UpcomingStep

KEPT = 0.2
"""Part of its distance, or of the gap where it is farther, that a pair keeps in a Newton iteration."""

TOUCHES = 0.7
"""Part of the gap at which pairs that meet in a Newton iteration shall be after it."""

SHORT = 0.05
"""Part of the gap that they, and those which touch, may lack there."""

PARALLEL = 1e-3
"""Squared sine of the angle of two edges below which they count as nearly parallel."""

BULGE = 0.1
"""How far, over the gap, what turns near a sheet may leave the straight way that it is taken to go."""

HALFWAY = 14.0
"""b″ / k in the middle of the gap."""

EDGES = 0.3
"""Part of the gap below which two edges feel each other, but for sharp ones of obstacles. Sheets that lie on
each other are held by pairs of vertices and triangles, two for a vertex; edges, ten times as many, see to
what these do not. On obstacles' triangles a sheet's vertices lie, alike wherever the edges of these are.
"""

SHARP = 0.5
"""Angle [rad] between triangles of an obstacle above which the edge between them is felt as they are."""

SKIN = 0.5
"""Over the gap, how far points may come nearer to each other between two searches."""

SAG = 0.01
"""Part of the gap by which edges of a sheet sag, at most, over spheres and rods that its vertices feel, as
they feel planes; triangles and edges do only as two edges feel each other. On what is nearly flat nearest
points are anywhere."""

MANY, MANY_PER_VERTEX = 500_000, 100
"""Pairs above both of which shorter ways are looked at: a step of Newton's method may lead through all of a
crumpled sheet, and none of that is gone at once. Not in a static analysis, whose first load step may lead far
where nothing holds the sheet yet."""

STRAIN = 0.01
"""Least strain of an edge under the force k · gap: by a softer barrier a small force would close a small gap,
which takes Newton's method many iterations."""


PARTS = 1_000_000_000
"""Vertices have so many parts of k as their area asks for: whole numbers, which go from rank to rank with the
triangles."""

LEAST, MOST = 1e-3, 1e3
"""Of the stiffness that pairs of a vertex have, for its area."""


class Barrier(NamedTuple):
    """Numbers of the barrier, the same on all ranks.

    Attributes
    ----------
    gap, thickness : float [m]
    stiffness : float [N/m]
        k inside of a regular mesh.
    parallel : float
        Squared sine of the angle of edges below which their energy fades.
    flat : float
        Radius [m] of spheres and rods from which on a sheet's edges sag less than `SAG` over them.
    """

    gap: float
    thickness: float
    stiffness: float
    parallel: float
    flat: float = np.inf


class Places(NamedTuple):
    """Where the obstacles' points stand, and normals of planes after them.

    Attributes
    ----------
    before, now, after : (m, 3)
        At the start of a step, at its stage and at its end.
    moved, moved_on : list of (3, 3) and (3,)
        Rotation and translation [m] of each obstacle up to the stage, and to the end.
    """

    before: Array
    now: Array
    after: Array
    moved: list[tuple[Array, Array]]
    moved_on: list[tuple[Array, Array]]


class Meeting(NamedTuple):
    """Pairs nearer than the gap, of those whose nearest points are on the same vertices one.

    Attributes
    ----------
    least : (E,)
        What the distance of each pair less its offset [m] is not below.
    at, weight, counted, beta, energy, felt : (m, …)
        Of those found, as `contact_pairs.meeting` gives them.
    """

    least: Array
    at: Ints
    weight: Array
    counted: Array
    beta: Array
    energy: Array
    felt: Array

    @property
    def square(self) -> Array:
        """|g|² [m²], (m,)."""
        found: Array = np.einsum("mk,mk->m", self.felt[:, :3], self.felt[:, :3])
        return found

    @property
    def stiffness(self) -> Array:
        """b″ times the square of the distance's gradient [N/m], (m,)."""
        return self.felt[:, 4] * self.square


_NONE = np.empty(0)
NOTHING = Meeting(
    *unwritable(_NONE, np.empty(0, dtype=np.int64), _NONE, _NONE, np.empty((0, 4)), _NONE, np.empty((0, 5)))
)
"""Where there are no pairs."""


class Obstacles:
    """The points of all obstacles in one array, and the simplices that they make.

    Attributes
    ----------
    triangles, edges, points, planes, segments : (n, 5)
        Numbers of the points, that of the obstacle, what is around a triangle (`surface_shares.rings`).
        Planes are a point and a normal. Of spheres and rods that are nearly flat the axis is a triangle, too.
    radius : (obstacles + 1,)
        Offset [m] of each; the last, 0, is that of sheets.
    moving : bool
        Whether any of them does.
    smooth_points : (n,) bool
        Of all points: those at which triangles make no sharp edge.
    smooth_edges : (m,) int64
        Edges at which they make none, in order: the lower number of a point times ``n_points``, and the
        higher.
    """

    def __init__(self, obstacles: Sequence[Solid | Container], flat: float = np.inf) -> None:
        self.each = list(obstacles)
        parts: dict[str, list[Ints]] = {
            kind: [] for kind in ("triangles", "edges", "points", "planes", "segments")
        }
        radius, first, begins = np.zeros(len(obstacles) + 1), 0, []
        smooth_points, smooth_edges = [np.empty(0, dtype=np.bool_)], [np.empty((0, 2), dtype=np.int64)]
        for number, obstacle in enumerate(obstacles):
            n = len(obstacle.points)
            begins.append(first)

            def rows(of: Ints, number: int = number, first: int = first) -> Ints:
                filled = np.concatenate([of, np.repeat(of[:, :1], 3 - of.shape[1], axis=1)], axis=1)
                rings = surface_shares.rings(of) if of.shape[1] == 3 else np.zeros(len(of), dtype=np.int64)
                return np.column_stack([filled + first, np.full(len(of), number), rings])

            if isinstance(obstacle, Solid):
                radius[number] = obstacle.radius
                edges, sharp = _edges_of(obstacle)
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
        smooth = np.concatenate(smooth_edges)
        self.smooth_points = np.concatenate(smooth_points)
        self.smooth_edges = np.sort(smooth[:, 0] * first + smooth[:, 1])
        empty = np.empty((0, 5), dtype=np.int64)
        self.triangles, self.edges, self.points, self.planes, self.segments = (
            np.concatenate([empty, *part]).astype(np.int64) for part in parts.values()
        )
        self.radius, self.n_points = radius, first
        self.moving = any(obstacle.motion is not None for obstacle in obstacles)
        self._first = np.array(begins, dtype=np.int64)
        self._stays = [(np.eye(3), np.zeros(3))] * len(obstacles)

    def at(self, time: float) -> Array:
        """Points and normals (m, 3) at a time [s]."""
        rows = [np.empty((0, 3))]
        for obstacle in self.each:
            rows.append(obstacle.positions(time))
            if isinstance(obstacle, Container) and obstacle.kind == "planes":
                rows.append(obstacle.normals_at(time))
        return np.concatenate(rows)

    def extents(self, places: Array) -> tuple[Array, Array]:
        """Low and high corners (obstacles, 3) [m] of what is at places (k, m, 3) [m]."""
        return np.minimum.reduceat(places.min(axis=0), self._first), np.maximum.reduceat(
            places.max(axis=0), self._first
        )

    def bulges(self, start: float, end: float) -> Array:
        """How far [m] points of each leave their straight ways between two times [s], (obstacles,)."""
        times, found = np.linspace(start, end, 9), np.zeros(len(self.each))
        for number, each in enumerate(self.each):
            if each.motion is not None:
                first, *between, last = (each.positions(time) for time in times)
                way = last - first
                square = np.maximum(np.sum(way * way, axis=1, keepdims=True), np.finfo(float).tiny)
                for at in between:
                    part = np.clip(np.sum((at - first) * way, axis=1, keepdims=True) / square, 0.0, 1.0)
                    off = np.linalg.norm(at - first - part * way, axis=1).max(initial=0.0)
                    found[number] = max(found[number], float(off))
        return found

    def moved(self, start: float, end: float) -> list[tuple[Array, Array]]:
        """Rotation (3, 3) and translation (3,) [m] of each from one time [s] to another."""
        if not self.moving:
            return self._stays
        found = []
        for each in self.each:
            (turn, way), (later, there) = each.displacement(start), each.displacement(end)
            rotation = later @ turn.T
            found.append((rotation, there - rotation @ way))
        return found

    def contact_displacements(
        self, x: Array, points: Ints, beta: Array, obstacle: Ints, moved: list[tuple[Array, Array]]
    ) -> Array:
        """How far (m, 3) [m] obstacles moved where pairs with points and β (m, 4) touch them at positions x
        (n_local, 3), times Σ β_i of the sheet's points; 0 of pairs between sheets, with an obstacle −1.
        """
        out = np.zeros((len(points), 3))
        for number, (turn, way) in enumerate(moved if self.moving else []):
            mine = np.flatnonzero(obstacle == number)
            part = np.where(points[mine] >= 0, beta[mine], 0.0)
            side = part.sum(axis=1, keepdims=True)
            foot = np.einsum("ei,eik->ek", part, x[np.maximum(points[mine], 0)]) / side
            out[mine] = side * (foot - (foot - way) @ turn)  # where it is now, less where it was
        return out


class ContactBarrier(Elastic):
    """The barrier between all near pairs.

    Parameters
    ----------
    surface : (F, 3)
        Triangles of this rank, in local rows.
    uv : (F, 3, 2)
        Material coordinates [m] of their corners.
    marks : (F, 4)
        What is around them, as `surface_shares.rings` has it, and `parts` of their corners.
    """

    def __init__(self, surface: NDArray[np.int32], uv: Array, marks: Ints) -> None:
        empty = {"what": np.empty((0, 8)), "number": np.empty((0, 4))}
        self.obstacles, self.itself, self.static = Obstacles([]), True, False
        self.barrier = Barrier(0.0, 0.0, 0.0, 1.0)
        self._places, self._bulge = np.empty((3, 0, 3)), np.zeros(1)
        super().__init__(Elements(np.empty((0, 4), dtype=np.int32), empty))
        self.surface = np.ascontiguousarray(surface, dtype=np.int32)
        self.surface_marks = marks
        self._room = 0
        self._extents: tuple[Array, Array] | None = None  # of obstacles in ``_places``
        self._sheets = SheetSearch(surface.astype(np.int64), uv)
        self._taken: Ints | None = None  # triangles that the search has
        self._parts = np.empty(0, dtype=np.int64)  # of the stiffness, by vertex
        self._meeting = Remembered(self._meet)

    def set_up(
        self, barrier: Barrier, obstacles: Sequence[Solid | Container], *, itself: bool, static: bool
    ) -> None:
        """Take what all ranks know alike; before anything else is asked.

        ``itself`` says whether sheets meet sheets, ``static`` whether an equilibrium is sought.
        """
        self.barrier, self.obstacles = barrier, Obstacles(obstacles, barrier.flat)
        self.itself, self.static = itself, static
        self.skin = SKIN * barrier.gap
        self.search_distance = barrier.thickness + barrier.gap + self.skin
        self.approach_limit = (EDGES if itself else 1.0) * barrier.gap + self.skin
        self._places = self._swept = np.stack([self.obstacles.at(0.0)] * 3)
        self.stale = False
        self._bulge, self._extents = np.zeros(1), None

    def take(self, elements: Elements) -> None:
        super().take(elements)
        what = elements.data["what"].reshape(-1, 8).astype(np.int64)
        self.number = elements.data["number"].astype(np.int64)
        self.kind, self.obstacle = np.ascontiguousarray(what[:, 0]), what[:, 1]
        self.points = np.where(what[:, 2:6] < 0, what[:, 2:6], self.stencil)
        self.offset = self.barrier.thickness + self.obstacles.radius[self.obstacle]
        self.shares = surface_shares.shares(what[:, 6])
        self._k = self.barrier.stiffness / PARTS * what[:, 7]
        self.gap = np.where(self._between_others(), EDGES, 1.0) * self.barrier.gap
        self._meeting = Remembered(self._meet)
        self._foreseen = np.full(self.n_elements, np.nan)
        farthest = np.append(np.abs(self._places).max(axis=(0, 2)), 0.0)
        theirs = farthest[np.where(self.points < 0, ~self.points, -1)]
        self._far = np.maximum(np.abs(self.offset), theirs.max(axis=1))
        self._springs: Springs | None = None

    def _between_others(self) -> NDArray[np.bool_]:
        """Pairs (E,) that see to what vertices of sheets and triangles do not: edges of sheets, and edges and
        points of obstacles where their triangles are smooth.
        """
        of, points = self.obstacles, self.points
        out: NDArray[np.bool_] = (self.kind == EDGE_EDGE) & (self.obstacle < 0)
        corners = np.flatnonzero((self.kind == VERTEX_TRIANGLE) & (points[:, 0] < 0))
        out[corners] = of.smooth_points[~points[corners, 0]]
        edges = np.flatnonzero((self.kind == EDGE_EDGE) & (self.obstacle >= 0))
        ends = np.sort(~points[edges, 2:], axis=1)
        keys = ends[:, 0] * of.n_points + ends[:, 1]
        places = np.searchsorted(of.smooth_edges, keys), np.searchsorted(of.smooth_edges, keys, side="right")
        out[edges] = places[0] < places[1]
        return out

    # -- obstacles ---------------------------------------------------------------------------------

    def freeze(self, step: UpcomingStep) -> Places:
        if not self.moving:
            before, now, after = self._places
            moved = self.obstacles.moved(step.start, step.at)
            return Places(before, now, after, moved, moved)
        before, now, after = (self.obstacles.at(time) for time in (step.start, step.at, step.end))
        self._swept = np.stack([before, now, after])
        moved = np.linalg.norm(self._swept - self._places, axis=-1).max(initial=0.0)
        self.stale = bool(moved > 0.5 * self.skin or (moved > 0.0 and len(self.obstacles.planes) > 0))
        self._bulge = self.obstacles.bulges(step.start, step.end)
        ways = (self.obstacles.moved(step.start, time) for time in (step.at, step.end))
        return Places(before, now, after, *ways)

    @property
    def moving(self) -> bool:
        return self.obstacles.moving

    # -- search ------------------------------------------------------------------------------------

    def neighbours(self, x: Array, way: Array, numbers: Ints, triangles: Ints) -> tuple[Ints, Ints] | None:
        if self.moving:
            self._places, self._extents = self._swept, None
        self.stale = False
        if triangles is not self._taken:
            self._sheets.take(x, numbers, triangles[:, :3], triangles[:, 3])
            self._parts = np.full(len(x) + 1, PARTS)  # the last one of what is no vertex
            self._parts[triangles[:, :3]] = triangles[:, 4:]
            self._taken = triangles
        boxes = self._sheets.boxes(x, way)
        most = max(MANY, MANY_PER_VERTEX * len(x)) if way.any() and not self.static else np.inf
        found = [np.empty((0, 7), dtype=np.int64)]
        if self.obstacles.each:
            found += self._at_obstacles(x, way, boxes)
        if self.itself:
            reach = self.search_distance
            edges = reach - (1.0 - EDGES) * self.barrier.gap
            of_sheets = self._sheets.pairs(x, way, numbers, reach, edges, boxes, most)
            if of_sheets is None:
                return None
            found.append(of_sheets)
        every = np.concatenate(found)
        if len(every) > most:
            return None
        if not len(every):
            return every[:, :4], every
        kind, obstacle, points = every[:, 0], every[:, 1], every[:, 2:6]
        sheet = points >= 0
        first = points[np.arange(len(points)), sheet.argmax(axis=1)]
        vertex = np.where((kind != EDGE_EDGE) & sheet[:, 0], points[:, 0], -1)
        what = np.column_stack([kind, obstacle, np.where(sheet, 0, points), every[:, 6], self._parts[vertex]])
        return np.where(sheet, points, first[:, None]), what

    def _nearer(self, x: Array, way: Array, kind: int, obstacle: Ints, points: Ints, rings: Ints) -> Ints:
        """Rows of those pairs that may come within the search distance on their ways."""
        points, found = points.astype(np.int64), np.empty(len(points))
        kinds = np.full(len(points), kind)
        reach = self.search_distance + self.obstacles.radius[obstacle] + self._bulge.max()
        _, now, after = self._places - self._places[0]
        farther = np.linalg.norm(after, axis=1) > np.linalg.norm(now, axis=1)
        theirs = np.where(farther[:, None], after, now)
        contact_pairs.approaches(x, self._places[0], way, theirs, kinds, points, reach, found)
        return np.column_stack([kinds, obstacle, points, rings])[found < reach]

    def _at_obstacles(self, x: Array, way: Array, boxes: Array) -> list[Ints]:
        """Pairs with obstacles, wherever on their way in the step these are near patches in ``boxes``."""
        of, sheets = self.obstacles, self._sheets
        patches = np.minimum(boxes[0], boxes[2]), np.maximum(boxes[1], boxes[3])
        if not len(patches[0]):
            return []
        low, high = patches[0].min(axis=0), patches[1].max(axis=0)
        reach = self.search_distance + self._bulge.max()
        places = self._places if self.moving else self._places[:1]
        found = self._in_containers(x, way, patches, places, reach)
        if self._extents is None:
            self._extents = of.extents(places)
        around = (reach + of.radius[:-1])[:, None]
        least, most = self._extents
        near_by = ((least - around <= high) & (most + around >= low)).all(axis=1)
        if not near_by.any():
            return found

        def meet(kind: int, sheet: Simplices, others: Ints, size: int, *, sheet_first: bool) -> None:
            others = others[near_by[others[:, 3]]]
            if not len(others):
                return
            at = places[:, others[:, :size]]
            around = (reach + of.radius[others[:, 3]])[:, None]
            boxes = at.min(axis=(0, 2)) - around, at.max(axis=(0, 2)) + around
            some = ((boxes[0] <= high) & (boxes[1] >= low)).all(axis=1)
            others, boxes = others[some], (boxes[0][some], boxes[1][some])
            met = near(patches, boxes)
            if not len(met):
                return
            corners = sheet.of(np.unique(met[:, 0]))
            pairs = near(swept_boxes(x, way, corners), boxes)
            mine, theirs = corners[pairs[:, 0]], ~others[pairs[:, 1], :size]
            points = np.concatenate([mine, theirs] if sheet_first else [theirs, mine], axis=1)
            rings = others[pairs[:, 1], 4] if sheet_first else np.zeros(len(points), dtype=np.int64)
            found.append(self._nearer(x, way, kind, others[pairs[:, 1], 3], points, rings))

        meet(VERTEX_TRIANGLE, sheets.vertices, of.triangles, 3, sheet_first=True)
        meet(VERTEX_TRIANGLE, sheets.triangles, of.points, 1, sheet_first=False)
        meet(EDGE_EDGE, sheets.edges, of.edges, 2, sheet_first=True)
        return found

    def _in_containers(
        self, x: Array, way: Array, patches: tuple[Array, Array], places: Array, reach: float
    ) -> list[Ints]:
        """Pairs of vertices with planes, and of vertices inside with segments."""
        found = []
        for kind, others in ((VERTEX_PLANE, self.obstacles.planes), (VERTEX_INSIDE, self.obstacles.segments)):
            if not len(others):
                continue
            low, high = patches[0].min(axis=0, keepdims=True), patches[1].max(axis=0, keepdims=True)
            # distances differ no more than points are apart
            for least, most in ((low, high), patches):
                half = 0.5 * np.linalg.norm(most - least, axis=1)
                close = self._close(0.5 * (least + most), kind, others, places, reach + half)
                others = others[close.any(axis=0)]
                if not len(others):
                    break
            else:
                single = self._sheets.vertices.of(np.flatnonzero(close.any(axis=1)))[:, 0]
                close = np.zeros((len(single), len(others)), dtype=np.bool_)
                for at in (x, x + way):  # along straight ways these distances are least at an end
                    close |= self._close(at[single], kind, others, places, reach)
                number, plane = np.nonzero(close)
                points = np.column_stack([single[number], ~others[plane, :3]])
                rest = np.zeros(len(points), dtype=np.int64)
                found.append(np.column_stack([rest + kind, others[plane, 3], points, rest]))
        return found

    def _close(
        self, points: Array, kind: int, others: Ints, places: Array, reach: float | Array
    ) -> NDArray[np.bool_]:
        """Which of points (n, 3) [m] are within reach [m] of planes or segments (m, 5), (n, m)."""
        n, m = len(points), len(others)
        pairs = np.column_stack([np.repeat(np.arange(n), m), np.tile(~others[:, :3], (n, 1))])
        kinds, out, least = np.full(n * m, kind), np.empty(n * m), np.full((n, m), np.inf)
        for at in places:
            contact_pairs.distances(points, at, kinds, pairs, out)
            least = np.minimum(least, out.reshape(n, m))
        least -= self.obstacles.radius[others[:, 3]]
        return least < np.reshape(reach, (-1, 1))

    # -- energy ------------------------------------------------------------------------------------

    def meeting(self, x: Array, places: Array) -> Meeting:
        """What is nearer than the gap at positions x (n_local, 3) [m] and obstacles' points (m, 3) [m]."""
        if not self.n_elements:
            return NOTHING
        return Meeting(*self._meeting(np.concatenate([x, places])))

    def _meet(self, points: Array) -> tuple[NDArray[Any], ...]:
        x, places = np.split(points, [len(points) - self.obstacles.n_points])
        least = np.empty(self.n_elements)
        of = *self._of_pairs, self.shares, self.n_owned
        while True:
            room = self._room
            numbers = np.empty(room, dtype=np.int64), *np.empty((2, room))
            found = *numbers, np.empty((room, 4)), np.empty(room), np.empty((room, 5))
            met = contact_pairs.meeting(x, places, *of, least, found)
            if met <= room:
                return least, *(part[:met] for part in found)
            self._room = met + met // 4

    @property
    def _of_pairs(self) -> tuple[Any, ...]:
        """Kinds, points, offsets, gaps, and constants of the barrier."""
        return self.kind, self.points, self.offset, self.gap, self._k, self.barrier.parallel

    def energies(self, x: Array, frozen: Places) -> Array:
        if not self.n_elements:
            return _NONE
        met = self.meeting(x, frozen.now)
        counts = met.counted != 0.0  # these are among the owned pairs, as they come first
        energies = (met.counted * met.energy)[counts]
        return np.bincount(met.at[counts], energies, minlength=self.n_owned).astype(np.float64)

    def add_gradient(self, x: Array, frozen: Places, out: Array) -> None:
        if not self.n_elements:
            return
        met, pull = self.meeting(x, frozen.now), np.zeros_like(frozen.now)
        given = met.at, met.weight, met.beta, met.felt
        contact_pairs.add_gradient(x, frozen.now, *self._of_pairs, given, out, pull)

    def active_elements(self, x: Array, frozen: Places) -> NDArray[np.bool_]:
        out = np.zeros(self.n_elements, dtype=np.bool_)
        if self.n_elements:
            out[self.meeting(x, frozen.now).at] = True
            if self._springs is not None:
                out[self._springs.at] = True
        return out

    def add_hessian(
        self,
        x: Array,
        frozen: Places,
        blend: float,
        weight: Array,
        offsets: Mapping[str, Offsets],
        values: Array,
        predicted: tuple[Array, Array] | None = None,
    ) -> None:
        met, at = self.meeting(x, frozen.now), offsets[self.name]
        given = met.at, weight[met.at] * met.weight, met.beta, met.felt
        contact_pairs.add_hessians(x, frozen.now, *self._of_pairs, given, blend, at, values)

    def largest_stiffness(self, x: Array, frozen: Places) -> float:
        """Largest stiffness b″ [N/m] of a counted contact, by as many pairs as it counts for."""
        met = self.meeting(x, frozen.now)
        return float((met.counted * met.stiffness).max(initial=0.0))

    def force_scale(self, size: float) -> Array:
        return HALFWAY * self._k * size

    def stiffness(self, x: Array, frozen: Places) -> Array:
        met, out = self.meeting(x, frozen.now), np.zeros(self.n_elements)
        pressed = np.maximum(met.weight, met.counted) * met.stiffness
        out[met.at] = np.maximum(pressed, HALFWAY * self._k[met.at])
        return out

    def sizes(self, size: float) -> Array:
        return np.maximum(size, self._far)

    def largest_step(self, x: Array, way: Array, frozen: Places) -> float:
        if not self.n_elements:
            return 1.0
        still = np.zeros_like(frozen.now)
        left, nearer = self.meeting(x, frozen.now).least, contact_pairs.approach(way, still)
        at = np.flatnonzero(nearer > (1.0 - KEPT) * left)
        pairs = self.kind[at], self.points[at], self.offset[at], self.gap[at]
        return float(contact_pairs.free_fraction(x, frozen.now, way, still, *pairs, KEPT, 1.0))

    def springs(self, x: Array, way: Array, frozen: Places) -> Springs:
        met, room = self.meeting(x, frozen.now), self._room
        given = met.at, met.weight, met.counted, met.beta, met.felt
        while True:
            numbers = np.empty(room, dtype=np.int64)
            found = numbers, np.empty((room, 4)), np.empty((room, 3)), *np.empty((3, room))
            pairs = *self._of_pairs, given, self.n_owned
            touch, n = contact_pairs.one_sided(x, frozen.now, way, *pairs, found)
            if n <= room:
                break
            room = n
        at, beta, normal, scale, length, counts = (part[:n] for part in found)
        acts = np.arange(n) < touch
        self._springs = Springs(at, self.points[at], beta, normal, scale, self.gap[at], length, counts, acts)
        return self._springs

    def release_springs(self, length: Array | None) -> None:
        self._foreseen[:] = np.nan
        if length is not None and self._springs is not None:
            self._foreseen[self._springs.at] = self._springs.law(length)[0] / self._springs.scale
        self._springs = None

    def target_distances(self, x: Array, way: Array, frozen: Places) -> tuple[NDArray[Any], ...]:
        aim, before = np.empty(self.n_elements), np.zeros((self.n_elements, 3))
        pairs, presses = (self.kind, self.points, self.offset, self.gap), np.empty(self.n_elements, np.bool_)
        contact_pairs.target_distances(
            x, frozen.now, way, *pairs, TOUCHES, self._foreseen, aim, before, presses
        )
        return aim, before, presses

    def add_corrections(
        self,
        x: Array,
        way: Array,
        frozen: Places,
        targets: tuple[NDArray[Any], ...],
        out: Array,
        count: Array,
    ) -> bool:
        pairs = self.kind, self.points, self.offset, self.gap
        return bool(contact_pairs.add_corrections(x, frozen.now, way, *pairs, *targets, SHORT, out, count))

    def is_collision_free(self, x: Array, way: Array, frozen: Places, part: StepInterval) -> bool:
        if not self.n_elements:
            return True
        bent = np.flatnonzero(self._bulge > BULGE * self.barrier.gap)
        if len(bent) and np.isin(self.obstacle, bent).any():
            return False
        pairs = self.kind, self.points, self.offset, self.gap
        return bool(contact_pairs.free_fraction(x, *_during(frozen, part, way), *pairs, KEPT, 1.0) == 1.0)

    def distances(self, x: Array, others: Array) -> Array:
        """Distance less thickness and radius [m] of all pairs, (E,)."""
        out = np.empty(self.n_elements)
        contact_pairs.distances(x, others, self.kind, self.points, out)
        return out - self.offset

    def gaps(self, x: Array, frozen: Places) -> Array:
        return self.distances(x, frozen.now)[: self.n_owned]

    def collision_free_fractions(self, x: Array, way: Array, frozen: Places, part: StepInterval) -> Array:
        pairs, out = (self.kind, self.points, self.offset, self.gap), np.empty(self.n_owned)
        contact_pairs.free_fractions(x, *_during(frozen, part, way), *pairs, KEPT, out)
        return out

    def may_collide(self, x: Array, way: Array, frozen: Places, far: float) -> bool:
        pairs = self.kind, self.points, self.offset, self.gap
        return bool(contact_pairs.may_collide(x, *_during(frozen, StepInterval(0.0, 1.0), way), *pairs, far))

    def pair(self, element: int) -> Pair:
        points, begins = self.points[element].tolist(), 2 if self.kind[element] == EDGE_EDGE else 1
        parts = (tuple(points[:begins]), tuple(points[begins:]))
        number = int(self.obstacle[element])
        name = self.obstacles.each[number].name if number >= 0 else ""
        return Pair(tuple(part for part in parts if min(part) >= 0), name, self.barrier.thickness)

    def _pushed(self, x: Array, places: Array) -> Iterator[tuple[int, Array]]:
        """Obstacles, and the forces (n_local, 3) [N] of the sheets on each by the counted pairs."""
        met = self.meeting(x, places)
        number = self.obstacle[met.at]
        for obstacle in np.unique(number[number >= 0]):
            of = np.flatnonzero((number == obstacle) & (met.counted != 0.0))
            gradient, pull = np.zeros_like(x), np.zeros_like(places)
            given = unwritable(met.at[of], met.counted[of], met.beta[of], met.felt[of])
            contact_pairs.add_gradient(x, places, *self._of_pairs, given, gradient, pull)
            yield int(obstacle), gradient

    def obstacle_forces(self, x: Array, frozen: Places, count: int) -> Array:
        out = np.zeros((count, 6))
        for obstacle, force in self._pushed(x, frozen.now):
            out[obstacle] = *force.sum(axis=0), *np.cross(x, force).sum(axis=0)
        return out

    pushes = True

    def work(self, x: Array, at: float, start: float, end: float) -> float:
        back, on, done = self.obstacles.moved(at, start), self.obstacles.moved(at, end), 0.0
        for obstacle, force in self._pushed(x, self.obstacles.at(at)):
            (turn, way), (further, there) = back[obstacle], on[obstacle]
            done -= float(np.vdot(force, x @ (further - turn).T + there - way))
        return done

    def moved_with_obstacles(self, x: Array, way: Array, frozen: Places) -> Array:
        if not self.moving:
            return way
        pairs, free = (self.kind, self.points, self.offset, self.gap), np.empty(self.n_elements)
        contact_pairs.free_fractions(x, *_during(frozen, StepInterval(0.0, 1.0), way), *pairs, KEPT, free)
        taken = way.copy()
        for number, (turn, there) in enumerate(frozen.moved):
            with_it = x @ turn.T + there - x
            points = self.points[(free < 1.0) & (self.obstacle == number)]
            points = np.unique(points[points >= 0])
            taken[points] = with_it[points]
        blocked = (free < 1.0) & (self.obstacle < 0)
        for points in self.points[blocked]:  # sheets push each other
            pushed = (taken[points] != way[points]).any(axis=1)
            if pushed.any():
                taken[points[~pushed]] = taken[points[pushed]][0]
        return taken

    def find_contacts(self, x: Array, places: Array, counted: int) -> tuple[NDArray[Any], ...]:
        """β (m, 4), unit normals (m, 3), normal forces (m,) [N] and numbers (m,) of what touches among the
        first ``counted`` pairs; none that is as near as another, of a vertex of a sheet, and of others all.
        """
        met = self.meeting(x, places)
        room = len(met.at) + counted
        found = np.empty((room, 4)), np.empty((room, 3)), np.empty(room), np.empty(room, dtype=np.int64)
        given = met.at, met.weight, met.beta, met.felt
        n = contact_pairs.find_contacts(x, places, *self._of_pairs, met.least, given, counted, found)
        beta, normal, force, at = (part[:n] for part in found)
        if (force < 0.0).any():
            contact_pairs.share_negative(self.kind[at], self.points[at, 0], normal, force)
        keeps = force > 0.0
        return beta[keeps], normal[keeps], force[keeps], at[keeps]

    def vertex_of(self, at: Ints) -> Ints:
        """The vertex of a sheet that each of pairs (m,) is of, −1 of edges and of points of obstacles."""
        of_vertex = (self.kind[at] != EDGE_EDGE) & (self.points[at, 0] >= 0)
        return np.where(of_vertex, self.points[at, 0], -1)

    def contact_points(self, x: Array, frozen: Places) -> tuple[Ints, Array, Array, Array, Ints]:
        beta, normal, force, at = self.find_contacts(x, frozen.now, self.n_owned)
        return self.points[at], beta, normal, force, self.vertex_of(at)

    def dashpots(self, x: Array, frozen: Places) -> Dashpots:
        met = self.meeting(x, frozen.after)
        square = met.square
        of = np.flatnonzero((met.weight > 0.0) & (square > 0.0) & np.isfinite(met.felt[:, 4]))
        at, square, beta = met.at[of], square[of], met.beta[of]
        normal = met.felt[of, :3] / np.sqrt(square)[:, None]
        stiffness = met.weight[of] * met.felt[of, 4] * square
        points, obstacle = self.points[at], self.obstacle[at]
        moved = self.obstacles.contact_displacements(x, points, beta, obstacle, frozen.moved_on)
        pushed = np.einsum("ek,ek->e", moved, normal)
        return Dashpots(points, beta, normal, stiffness, self.vertex_of(at), obstacle, pushed)

    def normal_forces(self, x: Array, frozen: Places) -> Array:
        """Sum of the sizes of the normal forces [N] on each local vertex, (n_local,), of the pairs that this
        rank counts: only the owner of a vertex knows all that it is shared between.
        """
        out = np.zeros(len(x))
        beta, _, force, at = self.find_contacts(x, frozen.now, self.n_owned)
        contact_pairs.add_normal_forces(self.points[at], beta, force, out)
        return out

    def history(self, x: Array, frozen: Places) -> Mapping[str, float]:
        met, n = self.meeting(x, frozen.now), self.n_owned
        exact = met.least[:n] < self.gap[:n]
        smallest = met.least[:n][exact].min(initial=np.inf)
        may = np.flatnonzero(~exact & (met.least[:n] < smallest))  # it may be more
        if len(may):
            left = np.empty(len(may))
            contact_pairs.distances(x, frozen.now, self.kind[may], self.points[may], left)
            smallest = min(smallest, (left - self.offset[may]).min())
        # without friction; else that term's takes its place
        work = {"friction_work": 0.0}
        return work | {"contacts": float(met.counted.sum()), "smallest_gap": float(smallest)}


def _edges_of(obstacle: Solid) -> tuple[Ints, NDArray[np.bool_]]:
    """Edges (n, 2) of an obstacle's triangles, lower numbers first, and which are sharp: borders, and those
    with an angle of more than `SHARP`.
    """
    triangles = obstacle.triangles.astype(np.int64).reshape(-1, 3)
    a, b, c = (obstacle.points[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    way = np.where(sides[:, :1] < sides[:, 1:], 1.0, -1.0) * np.tile(normal, (3, 1))
    edges, number, count = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(edges), 3))
    np.add.at(sums, number.ravel(), way)  # of two triangles turned alike: n − n'
    apart = np.linalg.norm(sums, axis=1)
    return edges, (count != 2) | (apart > 2.0 * np.sin(0.5 * SHARP))


def _during(frozen: Places, part: StepInterval, way: Array) -> tuple[Array, Array, Array]:
    """Where obstacles' points stand at the start of a part of the step, the sheets' way, and theirs in it."""
    begin, end = part
    if begin >= 1.0:
        moved = frozen.after - frozen.now
        return frozen.now + (begin - 1.0) * moved, way, (end - begin) * moved
    moved = frozen.now - frozen.before
    return frozen.before + begin * moved, way, (end - begin) * moved


def elements(rest: RestShape) -> Elements:
    """The triangles of the sheets."""
    triangles = rest.mesh.triangles.astype(np.int64)
    marks = np.column_stack([surface_shares.rings(triangles), parts(triangles, rest.area)])
    uv = rest.mesh.triangle_uv.reshape(-1, 6)
    return Elements(rest.mesh.triangles, {"uv": uv, "marks": marks.astype(np.float64)})


def parts(triangles: Ints, area: Array) -> Ints:
    """Which part of k, in units of 1 / `PARTS`, pairs of the corners of triangles (F, 3) have: their area
    over that of a vertex inside of a regular mesh with as many triangles as their sheet.

    So what presses evenly has everywhere the same distance, whatever the size of the triangles. With the mean
    of all sheets the few vertices of a coarse one would bear most of what lies on it, and friction tremble.
    """
    sheet = np.unique(patches.connected(triangles), return_inverse=True)[1]
    mean = np.bincount(sheet, area) / np.bincount(sheet)
    of_vertex = np.bincount(triangles.ravel(), np.repeat(area / 3.0, 3))
    part = np.clip(of_vertex[triangles] / (2.0 * mean[sheet])[:, None], LEAST, MOST)
    return np.rint(PARTS * part).astype(np.int64)


def barrier(rest: RestShape) -> Barrier:
    """The numbers of a scene's barrier (rank 0).

    Raises
    ------
    InputError
        A gap that neighbours in the mesh would feel.
    """
    scene = rest.scene
    assert scene.contact is not None
    length, thickness = edge_lengths(rest.mesh), scene.contact.thickness
    shortest = float(length.min())
    gap = scene.contact.gap or min(0.25 * float(length.mean()), 0.5 * shortest)
    if gap + thickness >= shortest:
        raise InputError(
            f"gap + thickness = {gap + thickness:.3g} m is not below the shortest edge, {shortest:.3g} m: "
            "neighbours in the mesh would touch; give smaller ones, or a mesh without such short edges",
            file=scene.source,
            key="contact",
        )
    stiffness = max(max(shell.c11, shell.c22) for shell in rest.shells)
    stiffness *= max(1.0 / HALFWAY, STRAIN * float(length.mean()) / gap)
    return Barrier(gap, thickness, stiffness, PARALLEL, float(length.max()) ** 2 / (8.0 * SAG * gap))


def make(elements: Elements, scene: Scene, mass: Array) -> ContactBarrier:
    """The term on one rank; `ContactBarrier.set_up` must follow."""
    uv, marks = elements.data["uv"].reshape(-1, 3, 2), elements.data["marks"].reshape(-1, 4)
    return ContactBarrier(elements.stencil.astype(np.int32), uv, marks.astype(np.int64))
