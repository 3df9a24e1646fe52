"""Garment patterns in the format of GarmentCode: panels of curved edges, their places, and stitches.

A source ``pattern`` of a scene stands for one sheet for each panel, and seams for its stitches.

Source: M. Korosteleva and O. Sorkine-Hornung, GarmentCode, ACM Trans. Graph. 42 (2023) 6, and the files of
its public data sets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, suggest
from lyra_petsc.scene.text import parse_json, read_text
from lyra_petsc.scene.values import one_line, shown

CENTIMETRES = 100.0
"""Units in a metre of files that do not say."""

CLOSING = 1.0
"""Time [s] in which the stitches of a pattern close, unless the scene ends before."""

SAMPLES = 400
"""Straight parts by which the length of a curve is measured."""

FLIPPED = "right_wrong"
"""Mark of a stitch between the right side of one panel and the wrong side of the other."""

SAME_DISTANCE = 1e-6
"""Difference of distances, relative, up to which both directions of a seam are equally near."""


class Stitch(NamedTuple):
    """Two edges, each by the name of its panel and its number, and whether one of them is flipped."""

    first: tuple[str, int]
    second: tuple[str, int]
    flipped: bool


@dataclass(frozen=True, eq=False)
class PanelEdge:
    """One edge of a panel.

    Attributes
    ----------
    parts : (SAMPLES + 1, 2) or (2, 2) float64
        Points of the curve from its start to its end [m], dense.
    first, last : int
        Numbers of its vertices.
    label : str
        Label of the edge; empty without one.
    """

    parts: Array
    first: int
    last: int
    label: str

    @property
    def length(self) -> float:
        """Length [m]."""
        return float(np.linalg.norm(np.diff(self.parts, axis=0), axis=1).sum())

    def points(self, n: int) -> Array:
        """Points (n + 1, 2) [m] at equal arc lengths."""
        place = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.parts, axis=0), axis=1))])
        at = np.linspace(0.0, place[-1], n + 1)
        return np.column_stack([np.interp(at, place, coordinate) for coordinate in self.parts.T])


@dataclass(frozen=True, eq=False)
class Panel:
    """One panel: its edges in order, and its place: a point p of the plane goes to ``rotation`` (p, 0) +
    ``translation`` [m].
    """

    edges: list[PanelEdge]
    rotation: Array
    translation: Array

    def placed(self, points: Array) -> Array:
        """Points (n, 2) [m] of the plane in space, (n, 3) [m]."""
        return np.asarray(points @ self.rotation[:, :2].T + self.translation)


@dataclass(frozen=True, eq=False)
class Pattern:
    """Panels by name, stitches, and lines for the user."""

    panels: dict[str, Panel]
    stitches: list[Stitch]
    notes: list[str]

    def is_reversed(self, stitch: Stitch) -> bool:
        """Whether the sides of a stitch meet against the direction in which they are nearer to each other.

        Outlines of panels run around their right sides in one sense, so that along a stitch they run against
        each other.
        """
        ends, ascending = [], []
        for name, number in stitch[:2]:
            panel = self.panels[name]
            ends.append(panel.placed(panel.edges[number].parts[[0, -1]]))
            ascending.append(number < len(panel.edges) - 1)  # the last edge ends at the first vertex
        along = float(np.linalg.norm(ends[0] - ends[1], axis=1).sum())
        against = float(np.linalg.norm(ends[0] - ends[1][::-1], axis=1).sum())
        nearer_against = against < along
        if abs(against - along) <= SAME_DISTANCE * max(against, along):
            # a seam then follows the numbers of the vertices
            nearer_against = ascending[0] != ascending[1]
        return nearer_against == stitch.flipped


def expand_patterns(data: Mapping[str, Any], directory: Path, scene: Path | None) -> dict[str, Any]:
    """The content of a scene with a source for each panel, and seams, in place of whole patterns.

    ``directory`` is that of the scene's file ``scene``, for paths and messages. A seam between the same
    groups that the scene itself has replaces that of the pattern.

    Raises
    ------
    InputError
        As `read_pattern`; or a key that does not go with a pattern.
    """
    sources = data["mesh"] if isinstance(data["mesh"], list) else [data["mesh"]]
    expanded: list[Any] = []
    seams = list(data.get("seams") or [])
    sewn = {frozenset(seam["between"]) for seam in seams if _has_names(seam)}
    for number, source in enumerate(sources):
        if not is_whole_pattern(source):
            expanded.append(source)
            continue
        key = "mesh" if len(sources) == 1 else f"mesh[{number}]"
        if not isinstance(source["pattern"], (str, Path)):
            message = f"must be the path of a pattern (.json), not {shown(source['pattern'])}"
            raise InputError(message, file=scene, key=f"{key}.pattern")
        if source.get("name") is not None:
            raise InputError(
                "the sheets of a pattern have the names of its panels; leave name out", file=scene, key=key
            )
        path = Path(directory, source["pattern"])
        if path.suffix.lower() != ".json":
            raise InputError(f"{path.name!r} must end in .json", file=scene, key=f"{key}.pattern")
        pattern = read_pattern(path)
        expanded += [{**source, "panel": name} for name in pattern.panels]
        for stitch in pattern.stitches:
            groups = [f"{name}/edge{edge}" for name, edge in stitch[:2]]
            if frozenset(groups) not in sewn:
                seams.append(
                    {"between": groups, "reverse": pattern.is_reversed(stitch), "close": _closing(data)}
                )
    return {**data, "mesh": expanded, **({"seams": seams} if seams else {})}


def is_whole_pattern(source: Any) -> bool:
    """Whether a source of a scene's content is a pattern of which no panel is chosen."""
    return isinstance(source, dict) and source.get("pattern") is not None and source.get("panel") is None


def _has_names(seam: Any) -> bool:
    between = seam.get("between") if isinstance(seam, dict) else None
    return isinstance(between, (list, tuple)) and all(isinstance(name, str) for name in between)


def _closing(data: Mapping[str, Any]) -> dict[str, float]:
    time = data.get("time")
    end = time.get("end", CLOSING) if isinstance(time, dict) else CLOSING
    usual = isinstance(end, (int, float)) and not isinstance(end, bool) and 0.0 < end < CLOSING
    return {"from": 0.0, "until": float(end) if usual else CLOSING}


def read_pattern(path: Path) -> Pattern:
    """The panels and stitches of a pattern (.json).

    Raises
    ------
    InputError
        The file cannot be read; an outline is not closed; a curve is of an unknown type; a stitch names
        what is not there. The message names the panel and the edge.
    """
    data = parse_json(read_text(path), file=path)
    reader = _Reader(path)
    pattern = reader.block(data, "pattern", "")
    properties = data.get("properties") or {}
    units = properties.get("units_in_meter", CENTIMETRES) if isinstance(properties, dict) else CENTIMETRES
    scale = reader.number(units, "properties.units_in_meter")
    if scale <= 0.0:
        raise reader.error(f"must be > 0, not {shown(units)}", "properties.units_in_meter")
    curvature = properties.get("curvature_coords", "relative") if isinstance(properties, dict) else "relative"
    if curvature not in ("relative", "absolute"):
        raise reader.error(
            f"must be relative or absolute, not {shown(curvature)}", "properties.curvature_coords"
        )
    panels = reader.block(pattern, "panels", "pattern.")
    if not panels:
        raise reader.error("holds no panel", "pattern.panels")
    centred = isinstance(properties, dict) and properties.get("normalize_panel_translation") is True
    read = {
        name: reader.panel(panel, name, scale, absolute=curvature == "absolute", centred=centred)
        for name, panel in panels.items()
    }
    notes = []
    if not isinstance(properties, dict) or "units_in_meter" not in properties:
        notes.append(f"{path.name} has no properties.units_in_meter: its lengths are taken as centimetres")
    return Pattern(read, reader.stitches(pattern.get("stitches") or [], read), notes)


class _Reader:
    """Reads the parts of one file; messages name it."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def error(self, message: str, key: str) -> InputError:
        return InputError(message, file=self._path, key=one_line(key))

    def block(self, data: Any, key: str, before: str) -> dict[str, Any]:
        value = data.get(key) if isinstance(data, dict) else None
        if not isinstance(value, dict):
            hint = "; is this a pattern of GarmentCode (NAME_specification.json)?"
            raise self.error(f"must be a block, not {shown(value)}{hint}", before + key)
        return value

    def number(self, value: Any, key: str) -> float:
        usual = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not usual or not np.isfinite(float(value)):
            raise self.error(f"must be a finite number, not {shown(value)}", key)
        return float(value)

    def numbers(self, value: Any, n: int, key: str) -> Array:
        if not isinstance(value, list) or len(value) != n:
            raise self.error(f"must be {n} numbers, not {shown(value)}", key)
        return np.array([self.number(entry, key) for entry in value])

    def panel(self, panel: Any, name: str, scale: float, *, absolute: bool, centred: bool) -> Panel:
        key = f"panel {name}"
        if not isinstance(panel, dict):
            raise self.error(f"must be a block, not {shown(panel)}", key)
        corners, edges = panel.get("vertices"), panel.get("edges")
        for word, value in (("vertices", corners), ("edges", edges)):
            if not isinstance(value, list) or not value:
                raise self.error(f"must have a list of {word}, not {shown(value)}", key)
        assert isinstance(corners, list)
        assert isinstance(edges, list)
        vertices = np.array([self.numbers(v, 2, f"{key}: vertex {n}") for n, v in enumerate(corners)]) / scale
        read = [self._edge(e, vertices, f"{key}: edge {n}", scale, absolute) for n, e in enumerate(edges)]
        for n, edge in enumerate(read):
            before = read[n - 1]
            if before.last != edge.first:
                raise self.error(
                    f"begins at vertex {edge.first}, but edge {(n - 1) % len(read)} before it ends at vertex "
                    f"{before.last}; list the edges in order around the panel, so that they close",
                    f"{key}: edge {n}",
                )
        translation = self.numbers(panel.get("translation", [0, 0, 0]), 3, f"{key}: translation") / scale
        rotation = self._rotation(panel.get("rotation", [0, 0, 0]), f"{key}: rotation")
        if centred:
            offset = np.append(vertices.mean(axis=0), 0.0)
            translation = translation + offset - rotation @ offset
        return Panel(read, rotation, translation)

    def _rotation(self, value: Any, key: str) -> Array:
        if isinstance(value, list) and len(value) == 3 and isinstance(value[0], list):
            return np.array([self.numbers(row, 3, key) for row in value])
        x, y, z = np.radians(self.numbers(value, 3, key))
        cx, sx, cy, sy, cz, sz = np.cos(x), np.sin(x), np.cos(y), np.sin(y), np.cos(z), np.sin(z)
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
        about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
        about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(about_z @ about_y @ about_x)

    def _edge(self, edge: Any, vertices: Array, key: str, scale: float, absolute: bool) -> PanelEdge:
        ends = edge.get("endpoints") if isinstance(edge, dict) else None
        if not isinstance(ends, list) or len(ends) != 2 or any(type(end) is not int for end in ends):
            raise self.error(f"must have endpoints [first, last], not {shown(ends)}", key)
        for end in ends:
            if not 0 <= end < len(vertices):
                raise self.error(f"no vertex {end}; the panel has vertices 0 to {len(vertices) - 1}", key)
        start, stop = vertices[ends]
        if ends[0] == ends[1] or np.array_equal(start, stop):
            raise self.error("begins and ends at the same place; join it to its neighbour", key)
        label = edge.get("label")
        with np.errstate(over="ignore", invalid="ignore"):
            curve = self._curve(edge.get("curvature"), start, stop, key, scale, absolute)
            read = PanelEdge(curve, ends[0], ends[1], one_line(label) if isinstance(label, str) else "")
            if not np.isfinite(read.length):
                raise self.error("is too long; give its vertices and curvature smaller numbers", key)
        return read

    def _curve(
        self, curvature: Any, start: Array, stop: Array, key: str, scale: float, absolute: bool
    ) -> Array:
        """Points of an edge (m, 2) [m]."""
        if curvature is None:
            return np.array([start, stop])
        kind, params = "quadratic", curvature
        if isinstance(curvature, dict):
            kind, params = str(curvature.get("type")), curvature.get("params")
        elif isinstance(curvature, list) and curvature and not isinstance(curvature[0], list):
            params = [curvature]
        t = np.linspace(0.0, 1.0, SAMPLES + 1)[:, None]
        if kind == "circle":
            radius, large, right = self.numbers(params, 3, f"{key}: circle")
            return _arc(start, stop, radius / scale, large != 0.0, right != 0.0, t)
        counts = {"quadratic": 1, "cubic": 2}
        if kind not in counts:
            raise self.error(f"unknown curvature {kind!r}; known: quadratic, cubic, circle", key)
        if not isinstance(params, list) or len(params) != counts[kind]:
            raise self.error(f"{kind} curvature needs {counts[kind]} points, not {shown(params)}", key)
        across = np.array([start[1] - stop[1], stop[0] - start[0]])
        places = [self.numbers(point, 2, f"{key}: curvature") for point in params]
        if absolute:
            control = [place / scale for place in places]
        else:
            control = [start + along * (stop - start) + away * across for along, away in places]
        nodes, s = [start, *control, stop], 1.0 - t
        weights = (
            [s * s, 2 * s * t, t * t] if kind == "quadratic" else [s**3, 3 * s * s * t, 3 * s * t * t, t**3]
        )
        return np.asarray(sum(weight * node for weight, node in zip(weights, nodes, strict=True)))

    def stitches(self, stitches: Any, panels: Mapping[str, Panel]) -> list[Stitch]:
        if not isinstance(stitches, list):
            raise self.error(f"must be a list, not {shown(stitches)}", "pattern.stitches")
        return [self._stitch(stitch, panels, f"stitch {n}") for n, stitch in enumerate(stitches)]

    def _stitch(self, stitch: Any, panels: Mapping[str, Panel], key: str) -> Stitch:
        sides = [side for side in stitch if isinstance(side, dict)] if isinstance(stitch, list) else []
        if len(sides) != 2:
            raise self.error(f"must be two edges {{panel, edge}}, not {shown(stitch)}", key)
        ends: list[tuple[str, int]] = []
        for side in sides:
            name, edge = side.get("panel"), side.get("edge")
            if not isinstance(name, str) or name not in panels:
                raise self.error(f"no panel {shown(name)}; {suggest(str(name), panels)}", key)
            n = len(panels[name].edges)
            if type(edge) is not int or not 0 <= edge < n:
                raise self.error(f"no edge {shown(edge)} in panel {name}; it has edges 0 to {n - 1}", key)
            ends.append((name, edge))
        if ends[0] == ends[1]:
            raise self.error(f"sews edge {ends[0][1]} of panel {ends[0][0]} to itself", key)
        return Stitch(ends[0], ends[1], FLIPPED in stitch)


def _arc(start: Array, stop: Array, radius: float, large: bool, right: bool, t: Array) -> Array:
    """Points of an arc of a circle (m, 2) at parameters t (m, 1); ``right``: it lies right of its chord."""
    chord = stop - start
    distance = float(np.linalg.norm(chord))
    radius = max(
        abs(radius), 0.5 * distance
    )  # as in SVG, a radius that is too small is the least possible one
    away = np.sqrt(max(radius**2 - 0.25 * distance**2, 0.0)) * (1.0 if right != large else -1.0)
    centre = 0.5 * (start + stop) + away * np.array([-chord[1], chord[0]]) / distance
    first, last = (np.arctan2(*(point - centre)[::-1]) for point in (start, stop))
    turn = (last - first) % (2.0 * np.pi) if right else -((first - last) % (2.0 * np.pi))
    angle = first + turn * t
    points = centre + radius * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
    points[0], points[-1] = start, stop
    return np.asarray(points)


def outline(edges: Sequence[PanelEdge], counts: Sequence[int]) -> Array:
    """Points (n, 2) [m] around a panel, with ``counts`` equal parts of each edge."""
    return np.concatenate([edge.points(n)[:-1] for edge, n in zip(edges, counts, strict=True)])
