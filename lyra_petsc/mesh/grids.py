"""Built-in rectangular grids in the xy plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.mesh.mesh import NamedSet, Sheet
from lyra_petsc.scene.schema import Grid


def grid_sheet(grid: Grid) -> Sheet:
    """Triangles of an nx × ny grid of cells, from the origin to (width, height, 0).

    Vertex ``j (nx + 1) + i`` lies at column i, row j. ``diagonal`` joins (i, j) to (i+1, j+1);
    ``alternating`` flips that where i + j is odd; ``criss-cross`` adds the centre of cell (i, j) as
    vertex ``(nx + 1)(ny + 1) + j nx + i``. All triangles run anticlockwise seen from +z, those of a
    cell follow each other. Groups: surface ``sheet``, curves ``left``, ``right``, ``bottom``, ``top``,
    points ``corners``.
    """
    nx, ny = grid.nx, grid.ny
    points = _lattice(nx, ny, grid.width, grid.height)
    low_left = (np.arange(ny)[:, None] * (nx + 1) + np.arange(nx)[None, :]).reshape(-1)
    cell = np.stack([low_left, low_left + 1, low_left + nx + 2, low_left + nx + 1], axis=1)
    if grid.pattern == "criss-cross":
        points = np.concatenate([points, points[cell[:, [0, 2]]].mean(axis=1)])
        centre = np.arange(nx * ny) + (nx + 1) * (ny + 1)
        triangles = np.stack(
            [np.stack([cell[:, k], cell[:, (k + 1) % 4], centre], axis=1) for k in range(4)], axis=1
        )
    else:
        column, row = np.arange(nx)[None, :], np.arange(ny)[:, None]
        flipped = ((column + row) % 2 == 1).reshape(-1) & (grid.pattern == "alternating")
        triangles = np.where(
            flipped[:, None, None],
            cell[:, [[0, 1, 3], [1, 2, 3]]],
            cell[:, [[0, 1, 2], [0, 2, 3]]],
        )
    triangles = np.ascontiguousarray(triangles.reshape(-1, 3), dtype=np.int64)
    return Sheet(points, triangles, groups=_grid_groups(nx, ny, len(triangles)))


def grid_vertices(grid: Grid) -> int:
    """Number of vertices of a grid."""
    nx, ny = grid.nx, grid.ny
    return (nx + 1) * (ny + 1) + (nx * ny if grid.pattern == "criss-cross" else 0)


def _lattice(nx: int, ny: int, width: float, height: float) -> NDArray[np.float64]:
    points = np.zeros(((nx + 1) * (ny + 1), 3))
    points[:, 0] = np.tile(np.linspace(0.0, width, nx + 1), ny + 1)
    points[:, 1] = np.repeat(np.linspace(0.0, height, ny + 1), nx + 1)
    return points


def _grid_groups(nx: int, ny: int, n_triangles: int) -> list[NamedSet]:
    across, up = np.arange(nx + 1, dtype=np.int64), np.arange(ny + 1, dtype=np.int64) * (nx + 1)
    chains = {"left": up, "right": up + nx, "bottom": across, "top": across + ny * (nx + 1)}
    groups = [NamedSet("sheet", 2, np.arange(n_triangles, dtype=np.int64))]
    for name, chain in chains.items():
        groups.append(NamedSet(name, 1, np.stack([chain[:-1], chain[1:]], axis=1)))
    groups.append(NamedSet("corners", 0, np.array([0, nx, up[-1], up[-1] + nx], dtype=np.int64)))
    return groups
