"""Closed surfaces for tests: spheres, boxes with a wall between two chambers, and sewn layers of sheets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array, Ints


def sphere(n: int, radius: float = 1.0) -> tuple[Array, Ints]:
    """Vertices and triangles of an octahedron, its edges divided into n, projected onto a sphere."""
    numbers: dict[tuple[int, ...], int] = {}
    triangles = []
    for signs in np.ndindex(2, 2, 2):
        sign = 1 - 2 * np.array(signs)

        def vertex(i: int, j: int, sign: Ints = sign) -> int:
            return numbers.setdefault(tuple(int(k) for k in sign * (i, j, n - i - j)), len(numbers))

        for i in range(n):
            for j in range(n - i):
                triangles.append((vertex(i, j), vertex(i + 1, j), vertex(i, j + 1)))
                if i + j < n - 1:
                    triangles.append((vertex(i + 1, j), vertex(i + 1, j + 1), vertex(i, j + 1)))
        if np.prod(sign) < 0:
            triangles[-n * n :] = [triangle[::-1] for triangle in triangles[-n * n :]]
    lattice = np.array(list(numbers), dtype=np.float64)
    return radius * lattice / np.linalg.norm(lattice, axis=1, keepdims=True), np.array(triangles)


def walled_box(path: Path, n: int) -> dict[str, Any]:
    """A box 2 × 1 × 1 m, n cells to a metre, with a wall at x = 1 m; groups left, right and wall.

    Normals of the left part point inwards. Returns the mesh block.
    """
    numbers: dict[tuple[int, ...], int] = {}
    rows: dict[str, list[list[int]]] = {"left": [], "right": [], "wall": []}

    def face(axis: int, place: int, size: Sequence[int]) -> None:
        u, w = (axis + 1) % 3, (axis + 2) % 3
        for i, j in np.ndindex(size[u], size[w]):
            corners = []
            for a, b in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)):
                at = [0, 0, 0]
                at[axis], at[u], at[w] = place, a, b
                corners.append(numbers.setdefault(tuple(at), len(numbers)) + 1)
            middle = (2 * i + 1) / 2 if u == 0 else (2 * j + 1) / 2 if w == 0 else float(place)
            group = "left" if middle < n else "right" if middle > n else "wall"
            turn = -1 if (place == 0) != (group == "left") else 1
            rows[group] += [corners[:3][::turn], [corners[0], *corners[2:]][::turn]]

    size = (2 * n, n, n)
    for axis in range(3):
        face(axis, 0, size)
        face(axis, size[axis], size)
    face(0, n, size)
    lines = [f"v {x / n!r} {y / n!r} {z / n!r}" for x, y, z in numbers]
    for group, triangles in rows.items():
        lines += [f"g {group}", *("f " + " ".join(map(str, triangle)) for triangle in triangles)]
    path.write_text("\n".join(lines) + "\n")
    return {"file": str(path)}


def sewn_layers(numbers: Sequence[int], gap: float, seam: dict[str, Any]) -> dict[str, Any]:
    """Keys ``mesh`` and ``seams`` of square sheets ``layer0``, ``layer1``, … of 0.2 m above each other, with
    these numbers of edges along their sides, each sewn to the next one along all four.
    """
    return {
        "mesh": [
            {
                "name": f"layer{k}",
                "grid": {"width": 0.2, "height": 0.2, "nx": n, "ny": n},
                "transform": {"translate": [0.0, 0.0, k * gap]},
            }
            for k, n in enumerate(numbers)
        ],
        "seams": [
            {"between": [f"layer{k}/{side}", f"layer{k + 1}/{side}"]} | seam
            for k in range(len(numbers) - 1)
            for side in ("left", "right", "top", "bottom")
        ],
    }
