"""Random overlaps of layered sheets."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from brute_force import depth_of_overlap

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.experiments.meshes import irregular_rectangle, rectangle


class Layers(NamedTuple):
    """Sheets that cross: points (V, 3) [m] and triangles (F, 3) of each, and the depth [m] of the overlap."""

    kind: str
    sheets: list[tuple[Array, Ints]]
    depth: float


KINDS = ("dents", "corner", "tilted", "curved", "border", "three")

EDGE = 0.01
"""Side of the cells [m]."""


def random_layers(seed: int, cells: int = 30) -> Layers:
    """Two or three sheets of cells × cells, less than an edge apart, and overlaps up to five edges deep."""
    random = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    n_sheets = 3 if kind == "three" else 2
    size, depth = cells * EDGE, EDGE * random.uniform(0.3, 5.0)
    sheets = []
    distance = EDGE * random.uniform(0.3, 1.0)
    for number in range(n_sheets):
        n = cells - 4 * number
        if random.random() < 0.5:
            flat, triangles = irregular_rectangle(n, n, n * EDGE, n * EDGE, int(random.integers(1000)))
        else:
            flat, triangles = rectangle(n, n, n * EDGE, n * EDGE)
        x = np.column_stack([flat[:, :2] - 0.5 * n * EDGE, np.zeros(len(flat))])
        turn = random.uniform(0.0, 2.0 * np.pi)
        x[:, :2] = x[:, :2] @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        if kind == "border" and number:
            x[:, 0] += random.uniform(0.3, 0.6) * size
        x[:, 2] = number * distance
        if number:
            _deform(random, kind, x, depth + distance, size)
        sheets.append((x, triangles))
    depth = depth_of_overlap(sheets)
    if kind == "curved":
        radius = size * random.uniform(0.4, 1.0)
        for x, _ in sheets:
            angle, r = x[:, 0] / radius, radius + x[:, 2]
            x[:, 0], x[:, 2] = r * np.sin(angle), r * np.cos(angle) - radius
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    return Layers(kind, [(x @ rotation.T, triangles) for x, triangles in sheets], depth)


def _deform(random: np.random.Generator, kind: str, x: Array, depth: float, size: float) -> None:
    """Move a layer into the one below by up to ``depth`` [m]."""
    if kind == "corner":
        at = random.uniform(0.0, 2.0 * np.pi)
        along = x[:, :2] @ np.array([np.cos(at), np.sin(at)])
        begin = random.uniform(0.1, 0.3) * size
        x[:, 2] -= depth * np.maximum((along - begin) / (along.max() - begin), 0.0)
    elif kind == "tilted":
        at = random.uniform(0.0, 2.0 * np.pi)
        along = x[:, :2] @ np.array([np.cos(at), np.sin(at)])
        begin = random.uniform(-0.05, 0.2) * size
        x[:, 2] -= depth * (along - begin) / (along.max() - begin)
    else:
        for _ in range(1 if kind == "border" else int(random.integers(1, 4))):
            reach = 0.3 * size
            centre = random.uniform(-reach, reach, 2)
            if kind == "border":
                centre[0] = x[:, 0].min() + random.uniform(0.0, 0.1) * size
            width = EDGE * random.uniform(3.0, 7.0)
            x[:, 2] -= depth * np.exp(-((x[:, :2] - centre) ** 2).sum(axis=1) / (2.0 * width**2))
