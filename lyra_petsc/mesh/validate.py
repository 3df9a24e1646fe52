"""Checks of a mesh: what cannot be simulated is refused, with the numbers of vertices and triangles.

Neighbouring triangles are turned so that they run along their common edge in opposite directions.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.mesh import Sheet
from lyra_petsc.mesh.readers import first_few
from lyra_petsc.mesh.topology import edge_table

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# a triangle is degenerate if twice its area is below this share of its longest side squared: slivers of
# aspect 1e9 pass, and three points on a line do not, whatever their round-off
_FLATNESS = 1e-10


def check_topology(sheet: Sheet, *, file: object | None, key: str | None = None) -> None:
    """Refuse a mesh that is no surface, however it is scaled and moved.

    Raises
    ------
    InputError
        No triangles, non-finite coordinates, a triangle that uses a vertex twice, duplicate triangles,
        vertices in no triangle. Triangles and vertices are counted from 0 in file order, after splitting
        quads.
    """

    def refuse(message: str) -> None:
        raise InputError(message, file=file, key=key)

    triangles = sheet.triangles
    if len(triangles) == 0:
        refuse("the mesh has no triangles")
    if (bad := np.flatnonzero(~np.isfinite(sheet.points).all(axis=1))).size:
        refuse(f"coordinates that are not finite: vertices {first_few(bad.tolist())} (counted from 0)")
    if sheet.uv is not None and (bad := np.flatnonzero(~np.isfinite(sheet.uv).all(axis=(1, 2)))).size:
        refuse(f"vt that are not finite: triangles {first_few(bad.tolist())} (counted from 0)")
    if (bad := np.flatnonzero((triangles == np.roll(triangles, 1, axis=1)).any(axis=1))).size:
        refuse(f"degenerate triangles (a vertex used twice): {first_few(bad.tolist())} (counted from 0)")
    if (bad := _duplicates(triangles)).size:
        refuse(f"triangles that repeat another one: {first_few(bad.tolist())} (counted from 0)")
    used = np.zeros(len(sheet.points), dtype=np.bool_)
    used[triangles] = True
    if (bad := np.flatnonzero(~used)).size:
        refuse(f"vertices in no triangle have no mass: {first_few(bad.tolist())} (counted from 0)")


def check_shape(corners: Floats, shape: str, *, file: object | None, key: str | None = None) -> None:
    """Refuse triangles without area.

    Parameters
    ----------
    corners : (F, 3, d) float64
        Corners of the triangles [m], d = 2 or 3.
    shape : str
        Which shape this is (``rest`` or ``start``), for the message.

    Raises
    ------
    InputError
        Triangles whose area is zero, up to round-off, or too large for a number.
    """
    with np.errstate(all="ignore"):
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        longest = np.sqrt(np.maximum(np.maximum((a * a).sum(1), (b * b).sum(1)), ((b - a) ** 2).sum(1)))
        if corners.shape[2] == 2:
            double_area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        else:
            double_area = np.linalg.norm(np.cross(a, b), axis=1)
        # coordinates carry a round-off of their own size: what is left of a line far from the origin
        noise = 16 * np.finfo(np.float64).eps * np.abs(corners).max(axis=(1, 2)) * longest
        flat = double_area <= np.maximum(_FLATNESS * longest**2, noise)
    for wrong, words in (
        (~np.isfinite(double_area), f"triangles too large to compute in the {shape} shape"),
        (flat, f"degenerate triangles (no area in the {shape} shape)"),
    ):
        if wrong.any():
            numbers = first_few(np.flatnonzero(wrong).tolist())
            raise InputError(f"{words}: {numbers} (counted from 0)", file=file, key=key)


def _duplicates(triangles: Ints) -> Ints:
    """Triangles with the three vertices of an earlier one, ascending."""
    corners = np.sort(triangles, axis=1)
    order = np.lexsort(corners.T[::-1])
    same = (corners[order][1:] == corners[order][:-1]).all(axis=1)
    return np.sort(order[1:][same])


def orient(sheet: Sheet, *, file: object | None, key: str | None = None) -> None:
    """Turn triangles over until the orientation is consistent in each connected piece, with a note.

    In each piece the larger part keeps its orientation, in a tie that of the first triangle.

    Parameters
    ----------
    sheet : Sheet
        At most two triangles on an edge.

    Raises
    ------
    InputError
        A one-sided surface (Möbius strip).
    """
    table = edge_table(sheet.triangles)
    begin = table.first[table.sizes == 2]
    first, second = table.sides[begin], table.sides[begin + 1]
    corner = sheet.triangles.reshape(-1)
    # both sides start at the same vertex: the two triangles disagree
    disagree = corner[first] == corner[second]
    if not disagree.any():
        return
    pairs = np.stack([first // 3, second // 3], axis=1)
    turned = _walk(len(sheet.triangles), pairs, disagree)
    contradiction = pairs[(turned[pairs[:, 0]] != turned[pairs[:, 1]]) != disagree]
    if contradiction.size:
        shown = first_few(f"{one}-{other}" for one, other in contradiction.tolist())
        raise InputError(
            f"the surface has one side only (a Möbius strip): cut it where triangles {shown} meet "
            "(counted from 0)",
            file=file,
            key=key,
        )
    sheet.triangles = sheet.triangles.copy()
    sheet.triangles[turned] = sheet.triangles[turned][:, [0, 2, 1]]
    if sheet.uv is not None:
        sheet.uv = sheet.uv.copy()
        sheet.uv[turned] = sheet.uv[turned][:, [0, 2, 1]]
    sheet.notes.append(
        f"{int(turned.sum())} of {len(turned)} triangles turned over so that all are oriented alike"
    )


def _walk(n_triangles: int, pairs: Ints, disagree: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Triangles to turn over, by a breadth-first walk over each connected piece."""
    links: list[list[tuple[int, bool]]] = [[] for _ in range(n_triangles)]
    for (one, other), differs in zip(pairs.tolist(), disagree.tolist(), strict=True):
        links[one].append((other, differs))
        links[other].append((one, differs))
    turned: list[bool | None] = [None] * n_triangles
    for seed in range(n_triangles):
        if turned[seed] is not None:
            continue
        turned[seed] = False
        piece, queue = [seed], deque([seed])
        while queue:
            here = queue.popleft()
            for there, differs in links[here]:
                if turned[there] is None:
                    turned[there] = bool(turned[here]) != differs
                    piece.append(there)
                    queue.append(there)
        if 2 * sum(bool(turned[member]) for member in piece) > len(piece):
            for member in piece:
                turned[member] = not turned[member]
    return np.array(turned, dtype=np.bool_)
