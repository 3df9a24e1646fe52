"""What the readers of mesh files share: words for messages, quads and polygons as triangles."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lyra_petsc.arrays import Array, Ints

_FIRST_DIAGONAL = np.array([[0, 1, 2], [0, 2, 3]])
_SECOND_DIAGONAL = np.array([[0, 1, 3], [1, 2, 3]])


def first_few(indices: Iterable[object], limit: int = 5) -> str:
    """``3, 5, 9, 12, 40 and 7 more``."""
    everything = list(indices)
    shown = ", ".join(str(index) for index in everything[:limit])
    more = f" and {len(everything) - limit} more" if len(everything) > limit else ""
    return shown + more


def printable(name: str) -> str:
    """``name`` without what a terminal or HDF5 would choke on (control and null characters)."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in name)


def split_quads(corners: Array) -> Ints:
    """Split quads on the shorter diagonal of those that lie inside.

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
    # equal lengths must not depend on round-off: a tie takes the first diagonal
    shorter = length_first <= length_second * (1 + 1e-9)
    take_first = np.where(inside_first == inside_second, shorter, inside_first)
    return np.where(take_first[:, None, None], _FIRST_DIAGONAL, _SECOND_DIAGONAL).astype(np.int64)


def split_polygon(corners: Array) -> Ints | None:
    """Split one polygon as a fan from the corner that gives the largest smallest triangle.

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
    """Smallest area along ``normal`` (n, 3) over the triangles (n, m, 3, 3) of each polygon."""
    sides = triangles[:, :, 1:] - triangles[:, :, :1]
    areas = np.einsum("nmi,ni->nm", np.cross(sides[:, :, 0], sides[:, :, 1]), normal)
    return areas.min(axis=1)
