"""Stiffness of an endless strip or sheet from the hinges of one of its periodic cells.

The height is a quadratic with the mean curvatures plus a periodic part; the energy, least over the
periodic part and whatever curvature is left free, gives the effective stiffness.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.verification.flat_sheet import HingeBlocks

Array = NDArray[np.float64]

OFF_THE_LINES = 0.0917
"""Where a cell begins, as a part of it: no hinge lies on its border."""


def strip_stiffness(hinges: HingeBlocks, points: Array, start: float, period: float, width: float) -> float:
    """B_effective [N·m] of a strip along x with free edges: moment per width over curvature.

    Lateral curvature, twist and the heights of the vertices relax.

    Parameters
    ----------
    hinges : HingeBlocks
    points : (V, 2) float64
        Vertices at rest [m].
    start, period : float [m]
        The cell begins at ``start``, far enough from the ends of the strip that none of its hinges is
        missing, and repeats after ``period``.
    width : float [m]
    """
    x, y = points.T
    shapes = np.stack([0.5 * x**2, x * y], axis=1)
    lattice = np.array([[period], [0.0]])
    energy = _relaxed(hinges, points, shapes, np.linalg.pinv(lattice), np.array([start / period]))
    bent = energy[0, 0] - energy[0, 1] ** 2 / energy[1, 1]
    return float(bent / (period * width))


def sheet_stiffness(
    hinges: HingeBlocks, points: Array, start: Sequence[float], lattice: Array, relaxed: bool = True
) -> Array:
    """D (3, 3) [N·m] of an endless sheet: energy per area ½ κᵀ D κ with κ = (κ11, κ22, 2 κ12).

    Parameters
    ----------
    hinges : HingeBlocks
    points : (V, 2) float64
        Vertices at rest [m].
    start : (2,)
        Where the cell begins, in lattice coordinates.
    lattice : (2, 2) float64
        The two periods [m], as columns.
    relaxed : bool
        False leaves the vertices on the quadratic.
    """
    x, y = points.T
    shapes = np.stack([0.5 * x**2, 0.5 * y**2, 0.5 * x * y], axis=1)
    energy = _relaxed(hinges, points, shapes, np.linalg.inv(lattice), np.asarray(start), relaxed)
    area: float = abs(float(np.linalg.det(lattice)))
    return energy / area


def _relaxed(
    hinges: HingeBlocks, points: Array, shapes: Array, to_cell: Array, start: Array, relaxed: bool = True
) -> Array:
    """Quadratic form (m, m) of a cell's energy in the amplitudes of ``shapes`` (V, m).

    ``to_cell`` (d, 2) maps positions to lattice coordinates.
    """
    cell = points @ to_cell.T - start - OFF_THE_LINES
    middle = 0.5 * (cell[hinges.stencil[:, 0]] + cell[hinges.stencil[:, 1]])
    inside = ((middle >= 0.0) & (middle < 1.0)).all(axis=1)
    stencil, blocks = hinges.stencil[inside], hinges.blocks[inside]
    # vertices that differ by a period have the same periodic part
    lattice = np.linalg.pinv(to_cell)
    folded = points - (np.floor(cell) @ lattice.T)
    _, kind = np.unique(np.round(folded, 9), axis=0, return_inverse=True)
    kind = kind.reshape(-1)
    n = int(kind.max()) + 1
    size = shapes.shape[1]
    form = np.zeros((size + n, size + n))
    for vertices, block in zip(stencil, blocks, strict=True):
        heights = np.zeros((4, size + n))
        heights[:, :size] = shapes[vertices]
        np.add.at(heights, (np.arange(4), size + kind[vertices]), 1.0)
        form += heights.T @ block @ heights
    if not relaxed:
        return form[:size, :size]
    coupling, periodic = form[:size, size:], form[size:, size:]
    energy: Array = form[:size, :size] - coupling @ np.linalg.pinv(periodic, rcond=1e-9) @ coupling.T
    return energy
