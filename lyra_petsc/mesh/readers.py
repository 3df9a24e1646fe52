"""Functions that readers of mesh files share: text for messages, splitting of polygons, loose vertices."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.mesh import NamedSet, Sheet

_FIRST_DIAGONAL = np.array([[0, 1, 2], [0, 2, 3]])
_SECOND_DIAGONAL = np.array([[0, 1, 3], [1, 2, 3]])


def first_few(indices: Iterable[object], limit: int = 5) -> str:
    """The first ``limit`` of the indices as text: ``3, 5, 9, 12, 40 and 7 more``."""
    everything = list(indices)
    shown = ", ".join(str(index) for index in everything[:limit])
    more = f" and {len(everything) - limit} more" if len(everything) > limit else ""
    return shown + more


def printable(name: str) -> str:
    """``name`` with control and null characters, which terminals and HDF5 cannot take, replaced."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in name)


def drop_loose_vertices(sheet: Sheet, *, noted: bool = True) -> None:
    """Drop vertices in no triangle, which have no mass, and points and curves of groups there; with a note if
    ``noted``.
    """
    used = np.zeros(len(sheet.points), dtype=np.bool_)
    used[sheet.triangles] = True
    if used.all():
        return
    number = np.cumsum(used) - 1
    if noted:
        loose = np.flatnonzero(~used)
        which = f"{first_few(loose.tolist())}, counted from 0"
        if sheet.tags is not None:
            which = f"tag {first_few(sheet.tags[loose].tolist())}"
        which += "; later ones are numbered anew" if used[loose[0] :].any() else ""
        verb = "vertex that is" if len(loose) == 1 else "vertices that are"
        sheet.notes.append(f"{len(loose)} {verb} in no triangle dropped ({which})")
    kept = []
    for group in sheet.groups:
        if group.dimension < 2:
            inside = used[group.members].reshape(len(group.members), -1).all(axis=1)
            group = NamedSet(group.name, group.dimension, number[group.members[inside]])
        if len(group.members):
            kept.append(group)
    sheet.points, sheet.triangles, sheet.groups = sheet.points[used], number[sheet.triangles], kept
    sheet.tags = None if sheet.tags is None else sheet.tags[used]


def split_quads(corners: Array) -> Ints:
    """Split quads along the shorter of the diagonals that lie inside the quad.

    Parameters
    ----------
    corners : (n, 4, 3) float64
        Points of the quads in order [m].

    Returns
    -------
    (n, 2, 3) int64
        Corner numbers (0 to 3) of the two triangles of each quad.
    """
    first, second = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    normal = np.cross(first, second)
    length_first, length_second = np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)
    inside_first = _smallest_area(corners[:, _FIRST_DIAGONAL], normal) > 0
    inside_second = _smallest_area(corners[:, _SECOND_DIAGONAL], normal) > 0
    # between diagonals of equal length the first is taken, whatever their round-off
    shorter = length_first <= length_second * (1 + 1e-9)
    take_first = np.where(inside_first == inside_second, shorter, inside_first)
    return np.where(take_first[:, None, None], _FIRST_DIAGONAL, _SECOND_DIAGONAL).astype(np.int64)


def split_polygon(corners: Array) -> Ints | None:
    """Split one polygon into a fan of triangles, from the corner for which the smallest one is largest.

    Parameters
    ----------
    corners : (n, 3) float64
        Points of the polygon in order [m].

    Returns
    -------
    (n - 2, 3) int64, or None
        Corner numbers of the triangles; None if no fan stays inside the polygon.
    """
    n = len(corners)
    spokes = corners - corners[0]
    normal = np.cross(spokes[1:-1], spokes[2:]).sum(axis=0)
    best, best_area = None, 0.0
    for apex in range(n):
        ring = (apex + 1 + np.arange(n - 1)) % n
        fan = np.stack([np.full(n - 2, apex), ring[:-1], ring[1:]], axis=1)
        area = _smallest_area(corners[fan][None], normal[None])[0]
        if area > best_area:
            best, best_area = fan.astype(np.int64), area
    return best


def _smallest_area(triangles: Array, normal: Array) -> Array:
    """Smallest signed area (n,) of the triangles (n, m, 3, 3) of each polygon, times 2 |normal| (n, 3)."""
    sides = triangles[:, :, 1:] - triangles[:, :, :1]
    areas = np.einsum("nmi,ni->nm", np.cross(sides[:, :, 0], sides[:, :, 1]), normal)
    return areas.min(axis=1)
