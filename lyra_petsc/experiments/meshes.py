"""Meshes that no grid gives: vertices (V, 3) in metres and triangles (F, 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask


def rectangle(
    nx: int, ny: int, width: float, height: float, *, alternating: bool = True
) -> tuple[Array, Ints]:
    """A rectangle of nx × ny cells in the xy plane, numbered as a grid; alternating or diagonal."""
    i, j = (k.ravel() for k in np.meshgrid(np.arange(nx + 1), np.arange(ny + 1)))
    vertices = np.column_stack([i * (width / nx), j * (height / ny), 0.0 * i])
    column, row = (k.ravel() for k in np.meshgrid(np.arange(nx), np.arange(ny)))
    return vertices, _halved(nx, column, row, alternating & ((column + row) % 2 == 1))


def irregular_rectangle(nx: int, ny: int, width: float, height: float, seed: int = 1) -> tuple[Array, Ints]:
    """A rectangle of nx × ny cells in the xy plane: vertices displaced, diagonals at random.

    Vertices move by up to 0.2 of a cell in each direction, those of a side along it; corners stay. From 0.25
    on triangles could turn over.
    """
    random = np.random.default_rng(seed)
    vertices, _ = rectangle(nx, ny, width, height)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(nx + 1), np.arange(ny + 1)))
    shift = random.uniform(-0.2, 0.2, (len(i), 2)) * [width / nx, height / ny]
    shift[(i == 0) | (i == nx), 0] = 0.0
    shift[(j == 0) | (j == ny), 1] = 0.0
    vertices[:, :2] += shift
    column, row = (k.ravel() for k in np.meshgrid(np.arange(nx), np.arange(ny)))
    return vertices, _halved(nx, column, row, random.integers(0, 2, nx * ny) == 1)


def walls(
    section: Sequence[tuple[Sequence[float], Sequence[float]]],
    n: int,
    rows: int,
    depth: float,
    *,
    alternating: bool = True,
) -> tuple[Array, Ints]:
    """Plane walls of n × rows cells, from (x, z) to (x, z) each and from y = 0 to ``depth``.

    Where two or more of them meet they share vertices and edges.
    """
    flat, faces = rectangle(n, rows, 1.0, depth, alternating=alternating)
    each = []
    for start, end in section:
        x, z = (np.asarray(start)[:, None] + np.subtract(end, start)[:, None] * flat[:, 0]).tolist()
        each.append(np.column_stack([x, flat[:, 1], z]))
    vertices = np.concatenate(each)
    size = np.ptp(vertices, axis=0).max()
    _, first, number = np.unique((vertices / size).round(9), axis=0, return_index=True, return_inverse=True)
    triangles = np.concatenate([faces + k * len(flat) for k in range(len(each))])
    return vertices[first], number.ravel()[triangles]


SIDES = ("left", "right", "bottom", "top")


def sides(nx: int, ny: int) -> dict[str, Ints]:
    """The edges (n, 2) on each side of a rectangle of nx × ny cells that is numbered as a grid."""
    across, up = np.arange(nx + 1), np.arange(ny + 1) * (nx + 1)
    chains = (up, up + nx, across, across + ny * (nx + 1))
    return {name: np.column_stack([chain[:-1], chain[1:]]) for name, chain in zip(SIDES, chains, strict=True)}


def rectangle_script(
    width: float, height: float, size: float | Sequence[float], inside: Sequence[float] = ()
) -> str:
    """For gmsh: a rectangle in the xy plane with edges of about ``size`` [m], its sides named as a grid's.

    ``size`` may be one for each corner, from (0, 0) on against the clock; ``inside`` (x, y) [m] is where a
    vertex must be.
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


def _halved(nx: int, column: Ints, row: Ints, flipped: Mask) -> Ints:
    """Two triangles of every cell, cut from its low left to its high right corner or the other way."""
    a = row * (nx + 1) + column
    b, c, d = a + 1, a + nx + 2, a + nx + 1
    other = flipped[:, None]
    first = np.where(other, np.column_stack([a, b, d]), np.column_stack([a, b, c]))
    second = np.where(other, np.column_stack([b, c, d]), np.column_stack([a, c, d]))
    return np.concatenate([first, second])


def evenly(points: Array, n: int) -> Array:
    """n points (n, 3) at equal distances along a polygon (m, 3)."""
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    return np.column_stack([np.interp(np.linspace(0.0, way[-1], n), way, points[:, k]) for k in range(3)])


def rounded(flat: Array) -> Array:
    """Points (n, 3) of the square |x|, |y| ≤ 1, moved smoothly onto the disc of radius 1."""
    x, y = flat[:, 0], flat[:, 1]
    return np.column_stack([x * np.sqrt(1.0 - 0.5 * y**2), y * np.sqrt(1.0 - 0.5 * x**2), 0.0 * x])


def quarter_disc(n: int, radius: float) -> tuple[Array, Ints]:
    """The quarter x, y ≥ 0 of a disc about the origin: a square of n × n cells, mapped smoothly.

    Diagonals alternate, as they also do where the quarter is mirrored: cut otherwise, the centre would
    carry more or less than its neighbours do, and its deflection err by h² log h.

    Vertex j (n + 1) + i as in a grid: i = 0 and j = 0 are the straight sides, i = n and j = n the rim.
    """
    flat, faces = rectangle(n, n, 1.0, 1.0)
    return radius * rounded(flat), faces


def rings(n: int) -> tuple[Array, Ints]:
    """The disc of radius 1 about the origin: a centre and n rings of 6, 12, … 6 n vertices at equal angles.

    All triangles are nearly equilateral.
    """
    vertices, faces = [np.zeros((1, 3))], []
    first = [0, *(1 + 3 * k * (k + 1) for k in range(n))]  # vertex of each ring
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
