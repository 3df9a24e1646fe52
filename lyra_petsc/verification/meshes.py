"""Meshes that no grid gives: vertices (V, 3) in metres and triangles (F, 3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


def irregular_rectangle(n: int, width: float, height: float, seed: int = 1) -> tuple[Array, Ints]:
    """A rectangle of n × n cells in the xy plane: inner vertices displaced, diagonals at random.

    Inner vertices move by up to 0.3 of a cell in each direction.
    """
    random = np.random.default_rng(seed)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
    shift = random.uniform(-0.3, 0.3, (len(i), 2))
    shift[(i == 0) | (i == n) | (j == 0) | (j == n)] = 0.0
    vertices = np.column_stack([(i + shift[:, 0]) * width / n, (j + shift[:, 1]) * height / n, 0.0 * i])
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    b, c, d = a + 1, a + n + 2, a + n + 1
    flipped = random.integers(0, 2, len(a))[:, None] == 1
    first = np.where(flipped, np.column_stack([a, b, d]), np.column_stack([a, b, c]))
    second = np.where(flipped, np.column_stack([b, c, d]), np.column_stack([a, c, d]))
    return vertices, np.concatenate([first, second])


def quarter_disc(n: int, radius: float = 1.0) -> tuple[Array, Ints]:
    """The quarter x, y ≥ 0 of a disc about the origin: n rings of triangles.

    Vertex 0 is the centre; ring k has k + 1 vertices, the last ring is the rim.
    """
    vertices, first = [np.zeros((1, 3))], [0]
    for k in range(1, n + 1):
        angle = 0.5 * np.pi * np.arange(k + 1) / k
        ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(k + 1)])
        ring[-1, 0] = 0.0  # on the y axis exactly
        first.append(first[-1] + len(vertices[-1]))
        vertices.append(radius * k / n * ring)
    triangles = []
    for k in range(1, n + 1):
        inner, outer = first[k - 1], first[k]
        triangles += [(inner + i, outer + i, outer + i + 1) for i in range(k)]
        triangles += [(inner + i, outer + i + 1, inner + i + 1) for i in range(k - 1)]
    return np.concatenate(vertices), np.array(triangles, dtype=np.int64)
