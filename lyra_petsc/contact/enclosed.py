"""Sheets that lie wholly inside of closed meshes, which exact tests for crossings do not tell."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.mesh.topology import connected_pieces, enclosed_volumes

SAMPLES = 8
"""Number of vertices of a sheet by which it is judged: single ones may touch the mesh."""


def winding_numbers(at: Array, corners: Array) -> Array:
    """How often triangles with corners (F, 3, 3) [m] that close a surface wind around points (n, 3) [m]: 0
    outside, 1 or −1 inside by the direction of the normals, and in between on the surface; (n,).

    It is the sum of the solid angles (van Oosterom & Strackee, IEEE Transactions on Biomedical Engineering 30
    (1983) 125-126, equation 8) over 4 π.
    """
    turns = np.empty(len(at))
    for row, point in enumerate(at):
        a, b, c = np.moveaxis(corners - point, 1, 0)
        volume = np.einsum("fi,fi->f", a, np.cross(b, c))
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        ab, bc, ca = (np.einsum("fi,fi->f", *pair) for pair in ((a, b), (b, c), (c, a)))
        half_angle = np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
        turns[row] = half_angle[volume != 0.0].sum() / (2.0 * np.pi)
    return turns


def enclosed_sheets(
    points: Array, triangles: Ints, sheet: Ints, body: Array, body_triangles: Ints, crossings: Ints
) -> tuple[Mask, Ints]:
    """Which sheets lie wholly inside of which closed pieces of a body.

    Parameters
    ----------
    points, body : (V, 3) and (W, 3) float64
        Of the sheets, and of the body [m].
    triangles, body_triangles : (F, 3) and (G, 3) int64
    sheet : (F,) int64
        Number of the sheet of each triangle, from 0 on: sheets are connected.
    crossings : (n, 2) int64
        Triangles of sheets and body that cross.

    Returns
    -------
    inside : (sheets, pieces) bool
    piece : (G,) int64
        Number of the piece of each triangle of the body.
    """
    piece = connected_pieces(body_triangles)
    closed = enclosed_volumes(body, body_triangles, piece) != 0.0
    inside = np.zeros((int(sheet.max(initial=-1)) + 1, len(closed)), dtype=bool)
    crosses = np.zeros_like(inside)
    crosses[sheet[crossings[:, 0]], piece[crossings[:, 1]]] = True
    for number in np.flatnonzero(closed):
        corners = body[body_triangles[piece == number]]
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        for one in np.flatnonzero(~crosses[:, number]):
            vertices = np.unique(triangles[sheet == one])
            at = points[vertices[:: -(-len(vertices) // SAMPLES)]]
            if ((at > low) & (at < high)).all(axis=1).any():
                # a sheet that crosses nothing is on one side; what touches counts half
                inside[one, number] = np.abs(winding_numbers(at, corners)).mean() > 0.75
    return inside, piece
