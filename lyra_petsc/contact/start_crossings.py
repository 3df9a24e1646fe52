"""Crossings at the positions where a run begins or is resumed: their places, and the refusal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact.crossings import mutual_crossings
from lyra_petsc.contact.enclosed import enclosed_sheets
from lyra_petsc.contact.joined import crossings_beside_seams
from lyra_petsc.contact.overlaps import behind_wall, find_overlaps
from lyra_petsc.errors import MarkedError
from lyra_petsc.mesh.mesh import Mesh, TriangleSurface
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.mesh.sheet_names import named_sheets
from lyra_petsc.mesh.symmetry import symmetry_walls
from lyra_petsc.scene.schema import Scene

MAX_LISTED = 3
"""Number of triangles, or pairs of triangles, that a message lists."""

NOT_ANY = -1
"""Number that stands for no triangle, sheet or obstacle."""


class PlacedScene(NamedTuple):
    """Sheets and obstacles at a time.

    Attributes
    ----------
    scene : Scene
        A scene with ``contact``.
    mesh : Mesh
    positions : (V, 3) float64
        Of the sheets [m].
    obstacles : sequence of Solid or Container
    time : float
        Time [s] at which the obstacles are where they are.
    """

    scene: Scene
    mesh: Mesh
    positions: Array
    obstacles: Sequence[Solid | Container]
    time: float = 0.0


class Crossing(NamedTuple):
    """Triangles of sheets that cross each other, an obstacle or a symmetry plane, or lie in an obstacle.

    Attributes
    ----------
    key : str
        Key of the scene to which it belongs.
    obstacle : int
        Number of the obstacle in the scene; `NOT_ANY` for sheets among themselves and symmetry planes.
    triangles : (n,) int64
    others : (n,) int64
        Triangle of the other sheet, or of the obstacle if it is a mesh; else `NOT_ANY`.
    segments : (n, 2, 3) float64
        Where they intersect [m]; NaN where the other surface has no triangles.
    subject, remedy : str
        Of the message.
    """

    key: str
    obstacle: int
    triangles: Ints
    others: Ints
    segments: Array
    subject: str
    remedy: str


class StartCrossings(NamedTuple):
    """All crossings at some positions, and what a picture of them needs.

    Attributes
    ----------
    scene : Scene
    surface : TriangleSurface
        The sheets.
    sheet : (F,) int64
        Number of the sheet of each triangle.
    names : list of str
        Of the sheets.
    obstacles : dict of str to TriangleSurface
        Obstacles that have triangles, at the time.
    crossings : list of Crossing
    enclosed : list of Crossing
        Sheets that lie wholly inside of closed meshes and so cross nothing.
    """

    scene: Scene
    surface: TriangleSurface
    sheet: Ints
    names: list[str]
    obstacles: dict[str, TriangleSurface]
    crossings: list[Crossing]
    enclosed: list[Crossing]

    @property
    def clear(self) -> bool:
        """Whether nothing crosses, and no sheet is enclosed."""
        return not (self.crossings or self.enclosed)

    @property
    def notes(self) -> list[str]:
        """For the user, about what is not refused."""
        return [
            f"{one.key}: at the start {one.subject}{_which(self, one)}: they stay inside, as meshes keep "
            f"sheets on both sides; else {one.remedy}"
            for one in self.enclosed
        ]

    def refuse(self, when: str, why: str = "", *, enclosed: bool = False) -> None:
        """Refuse a start if anything crosses ``when`` described, or is ``enclosed``, with a reason ``why`` in
        the message.

        Raises
        ------
        MarkedError
            The message gives numbers, the sheets and the first triangles with their positions.
        """
        crossings = self.crossings + (self.enclosed if enclosed else [])
        if not crossings:
            return
        key, texts = crossings[0].key, []
        for number, crossing in enumerate(crossings):
            prefix = f"{crossing.key}: " if number and crossing.key != key else ""
            rows = range(len(crossing.triangles))[:MAX_LISTED]
            listed = ", ".join(_named(self, crossing, row) for row in rows)
            first = f" (counted from 0, the first: {listed})"
            texts.append(f"{prefix}{crossing.subject}{first}{_which(self, crossing)}")
        remedies = "; ".join(dict.fromkeys(crossing.remedy for crossing in crossings))
        message = f"{when} {'; and '.join(texts)}; {why or remedies}"
        raise MarkedError(message, self, file=self.scene.source, key=key)


def find_start_crossings(placed: PlacedScene) -> StartCrossings:
    """Crossings of sheets with each other, symmetry planes and obstacles."""
    scene, mesh, positions, obstacles, time = placed
    assert scene.contact is not None
    triangles = mesh.triangles
    sheet, names = named_sheets(mesh)
    crossings: list[Crossing] = []
    enclosed: list[Crossing] = []
    surfaces = {
        one.name: TriangleSurface(one.positions(time), one.triangles)
        for one in obstacles
        if isinstance(one, Solid) and len(one.triangles)
    }
    if scene.contact.self and len(pairs := crossings_beside_seams(positions, triangles, mesh.tied)):
        segments = intersections(positions[triangles[pairs[:, 0]]], positions[triangles[pairs[:, 1]]])
        crossings.append(
            Crossing(
                "contact",
                NOT_ANY,
                pairs[:, 0],
                pairs[:, 1],
                segments,
                _counted(len(pairs), "pair", "of triangles", "cross"),
                "move the sheets apart, or give untangle: true, or self: false",
            )
        )
    for wall in symmetry_walls(scene, mesh):
        if len(passing := behind_wall(positions, triangles, wall).triangles):
            count = _counted(len(passing), "triangle", "of the sheet", "reach")
            crossings.append(
                Crossing(
                    f"handles[{wall.handle}].symmetry",
                    NOT_ANY,
                    *_alone(passing),
                    f"{count} through the {wall.container.name}",
                    "move the sheet to one side, or give contact: {untangle: true} or {self: false}",
                )
            )
    remedy = "move the sheet, or the obstacle, or give contact: {untangle: true}"
    for number, obstacle in enumerate(obstacles):
        key, shape = f"obstacles.{obstacle.name}", (scene.obstacles or {})[obstacle.name]
        if shape.mesh is not None:
            points, theirs = surfaces[obstacle.name]
            pairs = mutual_crossings(positions, triangles, points, theirs)
            if len(pairs):
                segments = intersections(positions[triangles[pairs[:, 0]]], points[theirs[pairs[:, 1]]])
                count = _counted(len(pairs), "pair", "of triangles of sheet and obstacle", "cross")
                crossings.append(Crossing(key, number, pairs[:, 0], pairs[:, 1], segments, count, remedy))
            inside, _ = enclosed_sheets(positions, triangles, sheet, points, theirs, pairs)
            if inside.any():
                within = np.flatnonzero(inside.any(axis=1)[sheet])
                count = _counted(len(within), "triangle", "of the sheet", "lie", "s")
                subject = f"{count} wholly inside of it"
                enclosed.append(Crossing(key, number, *_alone(within), subject, remedy))
            continue
        is_box = shape.box is not None
        overlapping = find_overlaps(obstacle, positions, triangles, time, is_box=is_box).triangles
        if len(overlapping):
            where = "into it" if isinstance(obstacle, Solid) else "beyond it"
            count = _counted(len(overlapping), "triangle", "of the sheet", "reach")
            crossings.append(Crossing(key, number, *_alone(overlapping), f"{count} {where}", remedy))
    surface = TriangleSurface(positions, triangles)
    return StartCrossings(scene, surface, sheet, names, surfaces, crossings, enclosed)


def _named(start: StartCrossings, crossing: Crossing, row: int) -> str:
    """Triangle, or pair, of a crossing and its position."""
    points, triangles = start.surface
    place = crossing.segments[row].mean(axis=0)
    numbers = [number for number in (crossing.triangles[row], crossing.others[row]) if number != NOT_ANY]
    if len(numbers) == 1:
        place = points[triangles[numbers[0]]].mean(axis=0)
    x, y, z = place
    return f"{' and '.join(map(str, numbers))} around ({x:.4g}, {y:.4g}, {z:.4g}) m"


def _which(start: StartCrossings, crossing: Crossing) -> str:
    """Numbers of triangles or pairs by sheets, to be added to a message."""
    return "".join(f", {text}" for text in _sheets(start, crossing))


def _sheets(start: StartCrossings, crossing: Crossing) -> Iterable[str]:
    """Numbers of triangles or pairs by sheets, if there are several sheets."""
    if len(start.names) == 1:
        return
    one = start.sheet[crossing.triangles]
    among = crossing.obstacle == NOT_ANY and crossing.others[0] != NOT_ANY
    two = start.sheet[crossing.others] if among else one
    sheets, counts = np.unique(np.sort(np.column_stack([one, two]), axis=1), axis=0, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    for row in order[:MAX_LISTED]:
        first, second = (start.names[number] for number in sheets[row])
        names = f"of {first!r}"
        if among:
            names = f"between {first!r} and {second!r}" if first != second else f"within {first!r}"
        yield f"{counts[row]} {names}"
    if len(order) > MAX_LISTED:
        yield f"{counts[order[MAX_LISTED:]].sum()} others"


def _alone(triangles: Ints) -> tuple[Ints, Ints, Array]:
    """Triangles, others and segments of a `Crossing` with something without triangles."""
    return triangles, np.full_like(triangles, NOT_ANY), np.full((len(triangles), 2, 3), np.nan)


def _counted(count: int, noun: str, of: str, verb: str, ending: str = "es") -> str:
    """Subject and verb of a message: ``1 triangle of the sheet reaches``, ``2 triangles … reach``."""
    return f"{count} {noun} {of} {verb}{ending}" if count == 1 else f"{count} {noun}s {of} {verb}"


def intersections(first: Array, second: Array) -> Array:
    """Segments (n, 2, 3) [m] in which triangles with corners ``first`` and ``second`` (n, 3, 3) [m]
    intersect, to rounding.

    Each triangle cuts the common line of both planes in an interval; the segment is what these have in
    common. (Möller, A Fast Triangle-Triangle Intersection Test, Journal of Graphics Tools 2 (1997) 25-30.)
    """
    normals = [np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) for x in (first, second)]
    along = np.cross(normals[0], normals[1])
    ends = []
    for corners, other, normal in ((first, second, normals[1]), (second, first, normals[0])):
        height = np.einsum("nki,ni->nk", corners - other[:, :1], normal)
        above = height > 0.0
        # the corner that is alone on its side
        alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
        row = np.arange(len(corners))
        cuts = []
        for turn in (1, 2):
            next_one = (alone + turn) % 3
            low, high = height[row, alone], height[row, next_one]
            part = np.divide(low, low - high, out=np.full(len(row), 0.5), where=low != high)
            part = np.clip(part, 0.0, 1.0)[:, None]
            cuts.append((1.0 - part) * corners[row, alone] + part * corners[row, next_one])
        cut = np.stack(cuts, axis=1)
        place = np.einsum("nki,ni->nk", cut, along)
        ends.append(np.take_along_axis(cut, np.argsort(place, axis=1)[:, :, None], axis=1))
    place = np.einsum("mnki,ni->mnk", np.stack(ends), along)
    row = np.arange(len(first))
    begin, end = place[:, :, 0].argmax(axis=0), place[:, :, 1].argmin(axis=0)
    stacked = np.stack(ends)
    return np.stack([stacked[begin, row, 0], stacked[end, row, 1]], axis=1)
