"""Meshes that the grids of scenes cannot describe: vertices (V, 3) in metres and triangles (F, 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask


def rectangle(
    nx: int, ny: int, width: float, height: float, *, alternating: bool = True
) -> tuple[Array, Ints]:
    """A rectangle of nx × ny cells in the xy plane, numbered as a grid; diagonals alternate or are equal."""
    i, j = (k.ravel() for k in np.meshgrid(np.arange(nx + 1), np.arange(ny + 1)))
    vertices = np.column_stack([i * (width / nx), j * (height / ny), 0.0 * i])
    column, row = (k.ravel() for k in np.meshgrid(np.arange(nx), np.arange(ny)))
    return vertices, _split_cells(nx, column, row, alternating & ((column + row) % 2 == 1))


def irregular_rectangle(nx: int, ny: int, width: float, height: float, seed: int = 1) -> tuple[Array, Ints]:
    """A rectangle of nx × ny cells in the xy plane with randomly displaced vertices and random diagonals.

    Vertices are displaced by up to 0.2 cells in each direction, vertices of a side only along the side;
    corners stay. From 0.25 cells on triangles could be inverted.
    """
    random = np.random.default_rng(seed)
    vertices, _ = rectangle(nx, ny, width, height)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(nx + 1), np.arange(ny + 1)))
    shift = random.uniform(-0.2, 0.2, (len(i), 2)) * [width / nx, height / ny]
    shift[(i == 0) | (i == nx), 0] = 0.0
    shift[(j == 0) | (j == ny), 1] = 0.0
    vertices[:, :2] += shift
    column, row = (k.ravel() for k in np.meshgrid(np.arange(nx), np.arange(ny)))
    return vertices, _split_cells(nx, column, row, random.integers(0, 2, nx * ny) == 1)


def walls(
    section: Sequence[tuple[Sequence[float], Sequence[float]]],
    n: int,
    rows: int,
    depth: float,
    *,
    alternating: bool = True,
) -> tuple[Array, Ints]:
    """Plane walls of n × rows cells, each between two points (x, z) and from y = 0 to ``depth`` [m].

    Where two or more walls meet they share vertices and edges.
    """
    flat, faces = rectangle(n, rows, 1.0, depth, alternating=alternating)
    pieces = []
    for start, end in section:
        x, z = (np.asarray(start)[:, None] + np.subtract(end, start)[:, None] * flat[:, 0]).tolist()
        pieces.append(np.column_stack([x, flat[:, 1], z]))
    vertices = np.concatenate(pieces)
    size = np.ptp(vertices, axis=0).max()
    _, first, number = np.unique((vertices / size).round(9), axis=0, return_index=True, return_inverse=True)
    triangles = np.concatenate([faces + k * len(flat) for k in range(len(pieces))])
    return vertices[first], number.ravel()[triangles]


SIDES = ("left", "right", "bottom", "top")


def side_edges(nx: int, ny: int) -> dict[str, Ints]:
    """The edges (n, 2) on each side of a rectangle of nx × ny cells that is numbered as a grid."""
    across, up = np.arange(nx + 1), np.arange(ny + 1) * (nx + 1)
    chains = (up, up + nx, across, across + ny * (nx + 1))
    return {name: np.column_stack([chain[:-1], chain[1:]]) for name, chain in zip(SIDES, chains, strict=True)}


def rectangle_script(
    width: float, height: float, size: float | Sequence[float], inside: Sequence[float] = ()
) -> str:
    """Script for gmsh: a rectangle in the xy plane with edges of about ``size`` [m] and the groups of a grid.

    ``size`` may have one value per corner, counter-clockwise from (0, 0); ``inside`` (x, y) [m] is the
    place of an additional vertex.
    """
    corners = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)]
    points = corners + ([(inside[0], inside[1])] if inside else [])
    sizes = np.broadcast_to(size, len(points))
    lines = [
        f"Point({k}) = {{{x!r}, {y!r}, 0, {h:.9g}}};"
        for k, ((x, y), h) in enumerate(zip(points, sizes, strict=True), 1)
    ]
    lines += [f"Line({k}) = {{{k}, {k % 4 + 1}}};" for k in range(1, 5)]
    lines += ["Curve Loop(1) = {1, 2, 3, 4};", "Plane Surface(1) = {1};"]
    lines += ["Point{5} In Surface{1};"] if inside else []
    lines += [f'Physical Curve("{name}") = {{{k}}};' for name, k in zip(SIDES, (4, 2, 1, 3), strict=True)]
    return "\n".join(['SetFactory("Built-in");', *lines, 'Physical Surface("sheet") = {1};', ""])


def _split_cells(nx: int, column: Ints, row: Ints, flipped: Mask) -> Ints:
    """Two triangles of every cell, split along the diagonal from its lower left corner, or the other one."""
    a = row * (nx + 1) + column
    b, c, d = a + 1, a + nx + 2, a + nx + 1
    flip = flipped[:, None]
    first = np.where(flip, np.column_stack([a, b, d]), np.column_stack([a, b, c]))
    second = np.where(flip, np.column_stack([b, c, d]), np.column_stack([a, c, d]))
    return np.concatenate([first, second])


def resample_polyline(points: Array, n: int) -> Array:
    """n points (n, 3) at equal arc lengths along a polyline (m, 3)."""
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    return np.column_stack(
        [np.interp(np.linspace(0.0, length[-1], n), length, points[:, k]) for k in range(3)]
    )


def square_to_disc(flat: Array) -> Array:
    """Map points (n, 3) of the square |x|, |y| ≤ 1 smoothly to the disc of radius 1."""
    x, y = flat[:, 0], flat[:, 1]
    return np.column_stack([x * np.sqrt(1.0 - 0.5 * y**2), y * np.sqrt(1.0 - 0.5 * x**2), 0.0 * x])


def quarter_disc(n: int, radius: float) -> tuple[Array, Ints]:
    """The quarter x, y ≥ 0 of a disc about the origin: a square of n × n cells, mapped smoothly.

    Diagonals alternate, also across the mirror lines of the quarter: with another pattern the centre would
    carry more or less load than its neighbours, and its deflection would have an error of h² log h.

    Vertex j (n + 1) + i as in a grid: i = 0 and j = 0 are the straight sides, i = n and j = n the rim.
    """
    flat, faces = rectangle(n, n, 1.0, 1.0)
    return radius * square_to_disc(flat), faces


def ring_disc(n: int) -> tuple[Array, Ints]:
    """The disc of radius 1 about the origin: its centre and n rings of 6, 12, … 6 n vertices at equal angles.

    All triangles are nearly equilateral.
    """
    vertices, faces = [np.zeros((1, 3))], []
    first = [0, *(1 + 3 * k * (k + 1) for k in range(n))]  # first vertex of each ring
    for k in range(1, n + 1):
        angle = np.arange(6 * k) * (math.pi / (3 * k))
        vertices.append(np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle]) * (k / n))
        sector, at = (i.ravel() for i in np.meshgrid(np.arange(6), np.arange(k), indexing="ij"))
        outer, last, inside = sector * k + at, at == k - 1, max(6 * (k - 1), 1)
        inner = sector * (k - 1) + at
        a, b = first[k] + outer, first[k] + (outer + 1) % (6 * k)
        c, d = first[k - 1] + inner % inside, first[k - 1] + (inner + 1) % inside
        faces += [np.column_stack([a, b, c]), np.column_stack([c, b, d])[~last]]
    return np.concatenate(vertices), np.concatenate(faces)
