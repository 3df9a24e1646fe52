"""What of a sheet is in an obstacle, and start positions that contact cannot begin with."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.crossings import mutual_crossings, self_crossings
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.mesh.overlaps import Overlaps, beyond_planes, in_ball, in_box, out_of_ball
from lyra_petsc.scene.schema import Scene

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

NAMED = 3
"""Triangles, or pairs of them, that a message names."""


def refuse_crossings(
    scene: Scene, mesh: Mesh, positions: Array, obstacles: Sequence[Solid | Container]
) -> None:
    """Refuse a start in which triangles cross, or are in an obstacle.

    Parameters
    ----------
    scene : Scene
        With ``contact``.
    mesh : Mesh
    positions : (V, 3) float64
        Of its vertices at t = 0 [m].
    obstacles : sequence of Solid or Container
        As `obstacles.made` makes them.

    Raises
    ------
    InputError
        The first triangles, and where they are.
    """
    assert scene.contact is not None
    triangles = mesh.triangles

    def refuse(key: str, count: str, named: Iterable[str], remedy: str) -> None:
        first = ", ".join(named)
        message = f"at the start {count} (counted from 0, the first: {first}); {remedy}"
        raise InputError(message, file=scene.source, key=key)

    def around(*numbers: int) -> str:
        x, y, z = positions[triangles[list(numbers)]].mean(axis=(0, 1))
        return f"around ({x:.4g}, {y:.4g}, {z:.4g}) m"

    if scene.contact.self and len(pairs := self_crossings(positions, triangles)):
        refuse(
            "contact",
            _counted(len(pairs), "pair", "of triangles", "cross"),
            (f"{a} and {b} {around(a, b)}" for a, b in pairs[:NAMED].tolist()),
            "move the sheets apart, or give self: false",
        )
    remedy = "move the sheet, or the obstacle"
    for obstacle in obstacles:
        key, shape = f"obstacles.{obstacle.name}", (scene.obstacles or {})[obstacle.name]
        if shape.mesh is not None and isinstance(obstacle, Solid):
            pairs = mutual_crossings(positions, triangles, obstacle.points, obstacle.triangles)
            if len(pairs):
                named = (f"{a} and {b} {around(a)}" for a, b in pairs[:NAMED].tolist())
                count = _counted(len(pairs), "pair", "of a triangle of the sheet and one of it", "cross")
                refuse(key, count, named, remedy)
            continue
        inside = overlaps_of(obstacle, positions, triangles, 0.0, is_box=shape.box is not None).triangles
        if len(inside):
            where = "into it" if isinstance(obstacle, Solid) else "beyond it"
            named = (f"{a} {around(a)}" for a in inside[:NAMED].tolist())
            refuse(
                key, f"{_counted(len(inside), 'triangle', 'of the sheet', 'reach')} {where}", named, remedy
            )


def overlaps_of(
    obstacle: Solid | Container, positions: Array, triangles: Ints, time: float, *, is_box: bool
) -> Overlaps:
    """What of a sheet at positions (V, 3) [m] is at a time [s] where an obstacle does not let it.

    ``is_box`` tells a box from a mesh, of which only the triangles that cross it are found.
    """
    sheet, points = (positions, triangles), obstacle.positions(time)
    if isinstance(obstacle, Container):
        if obstacle.kind == "planes":
            return beyond_planes(*sheet, points, obstacle.normals_at(time))
        return out_of_ball(*sheet, points, obstacle.radius)
    if obstacle.radius > 0.0:
        return in_ball(*sheet, points, obstacle.radius)
    if is_box:
        return in_box(*sheet, points)
    crossed = mutual_crossings(*sheet, points, obstacle.triangles)[:, 0]
    return Overlaps(np.empty(0, np.int64), np.empty((0, 2), np.int64), np.unique(crossed))


def _counted(count: int, noun: str, of: str, verb: str) -> str:
    """Subject and verb."""
    return f"{count} {noun} {of} {verb}es" if count == 1 else f"{count} {noun}s {of} {verb}"
