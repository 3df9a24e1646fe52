"""Meshes of bad elements."""

from __future__ import annotations

import numpy as np

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.experiments.stress.case import QUICK, Case, Content, Setting, family
from lyra_petsc.experiments.stress.changes import scale

ASPECT, RATIO = 1e3, 1e4
"""Of a sliver's sides, and of the sizes of elements in one mesh."""


def _slivers(setting: Setting, bench: Bench) -> Content:
    """A strip held at one end, two cells long and a hundred high."""
    nx, ny = 2, 100
    mesh = bench.mesh(*rectangle(nx, ny, 1.0, ny / nx / ASPECT))
    return setting.content() | {"mesh": mesh, "handles": [{"nodes": [j * (nx + 1) for j in range(ny + 1)]}]}


def _graded(setting: Setting, bench: Bench) -> Content:
    """A square held at two corners whose cells grow from one corner on."""
    n = 24
    sizes = RATIO ** (np.arange(n) / (n - 1.0))
    places = np.concatenate([[0.0], np.cumsum(sizes)]) / sizes.sum()
    vertices, triangles = rectangle(n, n, float(n), float(n))
    vertices[:, :2] = places[np.rint(vertices[:, :2]).astype(np.int64)]
    return setting.content() | {"mesh": bench.mesh(vertices, triangles), "handles": [{"nodes": [0, n]}]}


def _one_triangle(setting: Setting, bench: Bench) -> Content:
    """Hung by one corner, a thousand times as stiff."""
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.3, 0.9, 0.0]])
    content = scale(setting.content(), stretching=1e3)
    return content | {"mesh": bench.mesh(vertices, np.array([[0, 1, 2]])), "handles": [{"nodes": [0]}]}


elements = family(
    "elements",
    "slivers, elements of very different sizes, a single one",
    Case("slivers", "triangles with sides as 1 to 1000", _slivers, own=True, level=QUICK),
    Case("graded", "elements whose sizes differ by 1e4", _graded, own=True),
    Case("one-triangle", "a single stiff triangle", _one_triangle, steps=40, own=True, level=QUICK),
)
