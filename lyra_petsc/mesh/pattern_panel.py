"""Mesh of one panel of a garment pattern, by gmsh in its guarded process."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, suggest
from lyra_petsc.mesh.capacity import check_capacity
from lyra_petsc.mesh.library_file import read_by_library
from lyra_petsc.mesh.mesh import NamedSet, Sheet
from lyra_petsc.mesh.readers import printable
from lyra_petsc.scene.pattern_file import Panel, Pattern, outline, read_pattern

SAME_POINT = 1e-9
"""Distance over the extent of a panel below which two points of its outline are one."""


def read_panel(
    path: Path,
    name: str,
    size: float,
    *,
    algorithm: str | None = None,
    report: Callable[[str], None] | None = None,
) -> Sheet:
    """One panel at its place, with its plane as ``vt``.

    Both edges of a stitch get the same number of parts. Groups are ``edge0``, ``edge1``, … in the order of
    the file, and the labels of edges.

    Raises
    ------
    InputError
        As `read_pattern`; or the outline crosses itself; the message names the panel.
    """
    pattern = read_pattern(path)
    if name not in pattern.panels:
        raise InputError(f"no panel {name!r}; {suggest(name, pattern.panels)}", file=path)
    panel, key = pattern.panels[name], f"panel {name}"
    counts = _parts(pattern, name, size)
    check_capacity(sum(counts), file=path, key=key)
    points = outline(panel.edges, counts)
    area = _signed_area(points)
    check_capacity(int(2.0 * abs(area) / size**2), file=path, key=key)
    edge_of = np.repeat(np.arange(len(counts)), counts)
    _refuse_crossings(points, edge_of, path, key)
    try:
        with tempfile.TemporaryDirectory() as folder:
            script = Path(folder) / "panel.geo"
            script.write_text(_script(points, counts, size))
            # the script is our own: it holds nothing but numbers
            sheet = read_by_library(script, algorithm=algorithm, trusted=True, report=report)
    except InputError as error:
        raise InputError(f"cannot be meshed: {error.message}", file=path, key=key) from None
    flat = sheet.points[:, :2].copy()
    sheet.points = panel.placed(flat)
    if area < 0.0:  # seen from behind
        flat[:, 0] *= -1.0
    sheet.uv = flat[sheet.triangles]
    sheet.groups += _labels(panel, sheet.groups)
    if name == next(iter(pattern.panels)):
        sheet.notes += pattern.notes
    return sheet


def _parts(pattern: Pattern, name: str, size: float) -> list[int]:
    """Number of parts of each edge of a panel."""

    def own(panel: str, edge: int) -> int:
        return max(1, math.ceil(pattern.panels[panel].edges[edge].length / size - 1e-9))

    counts = [own(name, edge) for edge in range(len(pattern.panels[name].edges))]
    for first, second, _ in pattern.stitches:
        for (panel, edge), other in ((first, second), (second, first)):
            if panel == name:
                counts[edge] = max(counts[edge], own(*other))
    return counts


def _script(points: Array, counts: list[int], size: float) -> str:
    """Text of a script for gmsh: a polygon with a physical curve for each edge."""
    n, begin = len(points), np.cumsum([1, *counts])
    lines = [f"Point({i}) = {{{x!r}, {y!r}, 0, {size!r}}};" for i, (x, y) in enumerate(points.tolist(), 1)]
    lines += [f"Line({i}) = {{{i}, {i % n + 1}}};" for i in range(1, n + 1)]
    lines += [f"Transfinite Curve {{1:{n}}} = 2;", f"Curve Loop(1) = {{1:{n}}};", "Plane Surface(1) = {1};"]
    lines += [f'Physical Curve("edge{k}") = {{{begin[k]}:{begin[k + 1] - 1}}};' for k in range(len(counts))]
    lines += ['Physical Surface("cloth") = {1};']
    return "\n".join(lines) + "\n"


def _labels(panel: Panel, groups: list[NamedSet]) -> list[NamedSet]:
    """Groups of the edges with each label."""
    members: dict[str, list[Ints]] = {}
    edges = {group.name: group.members for group in groups}
    for number, edge in enumerate(panel.edges):
        if edge.label:
            members.setdefault(printable(edge.label), []).append(edges[f"edge{number}"])
    return [NamedSet(label, 1, np.concatenate(parts)) for label, parts in members.items()]


def _signed_area(points: Array) -> float:
    following = np.roll(points, -1, axis=0)
    return 0.5 * float(np.sum(points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]))


def _refuse_crossings(points: Array, edge_of: Ints, path: Path, key: str) -> None:
    """Refuse an outline (n, 2) that crosses itself."""
    n = len(points)
    if n < 3:
        raise InputError("has fewer than three sides", file=path, key=key)
    following, extent = np.roll(points, -1, axis=0), np.ptp(points)

    def side(a: Array, b: Array, c: Array) -> Array:
        return np.asarray(
            np.sign((b[:, 0] - a[:, 0]) * (c[1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[0] - a[:, 0]))
        )

    for i in range(n - 2):
        others = slice(i + 2, n - (i == 0))
        a, b, p, q = points[i], following[i], points[others], following[others]
        of_p = side(p, q, a) * side(p, q, b)
        line = np.broadcast_to(a, p.shape), np.broadcast_to(b, p.shape)
        ends = [
            np.sign(
                (line[1][:, 0] - line[0][:, 0]) * (end[:, 1] - line[0][:, 1])
                - (line[1][:, 1] - line[0][:, 1]) * (end[:, 0] - line[0][:, 0])
            )
            for end in (p, q)
        ]
        meet = np.abs(p - a).max(axis=1) <= SAME_POINT * extent
        crossing = np.flatnonzero((of_p < 0) & (ends[0] * ends[1] < 0) | meet)
        if len(crossing):
            one, other = edge_of[i], edge_of[i + 2 + crossing[0]]
            where = ", ".join(f"{x:.4g}" for x in a)
            raise InputError(
                f"its outline crosses itself: edge {one} and edge {other}, near [{where}] m; move the "
                "vertices or flatten the curves",
                file=path,
                key=key,
            )
