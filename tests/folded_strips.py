"""Strips with a crease, as .msh files with a group of curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike


def msh_file(
    path: Path, points: ArrayLike, triangles: ArrayLike, curves: Mapping[str, Sequence[Sequence[int]]]
) -> dict[str, Any]:
    """Write a .msh file with groups of curves, by pairs of vertices; returns its mesh block."""
    names = [f'1 {number} "{name}"' for number, name in enumerate(curves, start=1)]
    elements = [(1, number, pair) for number, pairs in enumerate(curves.values(), start=1) for pair in pairs]
    elements += [(2, len(names) + 1, corners) for corners in np.asarray(triangles)]
    names.append(f'2 {len(names) + 1} "sheet"')
    rows = [
        f"{number} {dimension} 2 {group} {group} " + " ".join(str(vertex + 1) for vertex in corners)
        for number, (dimension, group, corners) in enumerate(elements, start=1)
    ]
    nodes = [
        f"{number} {x!r} {y!r} {z!r}" for number, (x, y, z) in enumerate(np.asarray(points).tolist(), start=1)
    ]
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat"]
    for name, content in (("PhysicalNames", names), ("Nodes", nodes), ("Elements", rows)):
        lines += [f"${name}", str(len(content)), *content, f"$End{name}"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return {"file": str(path)}


def strip(path: Path, creases: Mapping[str, int], nx: int = 4, ny: int = 2) -> dict[str, Any]:
    """A strip of nx × ny squares of 0.25 m in the xy plane, with creases along y at columns of vertices."""
    columns = nx + 1
    points = [(0.25 * i, 0.25 * j, 0.0) for j in range(ny + 1) for i in range(columns)]
    triangles = []
    for j in range(ny):
        for i in range(nx):
            a, b = j * columns + i, (j + 1) * columns + i
            triangles += [(a, a + 1, b + 1), (a, b + 1, b)]
    curves = {
        name: [(j * columns + i, (j + 1) * columns + i) for j in range(ny)] for name, i in creases.items()
    }
    return msh_file(path, points, triangles, curves)
