"""Checks of a mesh: what cannot be simulated is refused, with the numbers of vertices and triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.mesh import Sheet
from lyra_petsc.mesh.readers import first_few

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
