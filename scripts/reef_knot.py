"""Writes meshes/reef-knot.obj: two strips in the shape of a loose reef knot, flat at rest.

    .venv/bin/python scripts/reef_knot.py

The first strip is a bight; the second comes up through it, goes over one of its legs, under both, over the
other, and down through it again. Each follows a smooth curve; its width is directed so that the strip is bent
rather than stretched, and twisted as little as possible.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.experiments.meshes import resample_polyline

FILE = Path(__file__).resolve().parent.parent / "meshes" / "reef-knot.obj"
UNIT = 0.05  # m, unit of the points below
EDGE, CELLS = 0.01, 3  # edge length [m], and number of cells across a strip

BIGHT = [[-5, 1, 0], [-3, 1, 0], [-1, 1, 0], [1, 1, 0], [2.2, 0.7, 0], [2.6, 0, 0]]
AROUND = [[5, 0.6, 0], [3.5, 0.6, -0.4], [2.4, 0.5, -0.9], [1.2, 0.5, 0], [0.2, 0.9, 0.9], [-0.7, 1.6, 0.7]]
AROUND += [[-1.2, 1.6, -0.5], [-1.4, 0.8, -0.9], [-1.4, 0, -0.9]]


def mirrored(half: list[list[float]]) -> Array:
    """The whole curve of a strip: its first half, and the mirror image of this about the xz plane."""
    points = np.array(half, dtype=np.float64)
    return np.concatenate([points, points[-2::-1] * [1, -1, 1]])


def smooth(points: Array) -> tuple[Array, float]:
    """A smooth curve near a polygon's corners, sampled at about the edge length, and its spacing [m]."""
    fine = resample_polyline(points * UNIT, 400)
    for _ in range(250):
        fine[1:-1] += 0.25 * (fine[2:] - 2.0 * fine[1:-1] + fine[:-2])
    length = float(np.linalg.norm(np.diff(fine, axis=0), axis=1).sum())
    n = round(length / EDGE)
    return resample_polyline(fine, n + 1), length / n


def width_directions(curve: Array) -> Array:
    """Unit vectors (n, 3) across a strip: normal to the curve, nearly to its curvature, with little twist."""
    along = np.gradient(curve, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    bend = np.gradient(along, axis=0)
    binormal = np.cross(along, bend)
    # dyadic products are averaged, as the binormals may change their sign
    tensor = binormal[:, :, None] * binormal[:, None, :] / (np.sum(bend**2, axis=1) + 1e-9)[:, None, None]
    tensor += 0.02 * np.eye(3)
    for _ in range(60):
        tensor[1:-1] += 0.25 * (tensor[2:] - 2.0 * tensor[1:-1] + tensor[:-2])
        tensor[0], tensor[-1] = tensor[1], tensor[-2]
    plane = np.eye(3) - along[:, :, None] * along[:, None, :]
    found = np.linalg.eigh(plane @ tensor @ plane)[1][:, :, 2]
    for i in range(1, len(found)):
        found[i] *= np.sign(found[i] @ found[i - 1])
    return found


def strip(points: Array, name: str, first: int, offset: float) -> list[str]:
    """Lines of an .obj file: vertices with numbers from ``first`` on, material coordinates about y =
    ``offset`` [m], and quads; those at each end are a group.
    """
    curve, edge = smooth(points)
    across, n = width_directions(curve), len(curve)
    lines, rows = [], np.arange(CELLS + 1) - 0.5 * CELLS
    for i in range(n):
        lines += ["v {:.6f} {:.6f} {:.6f}".format(*(curve[i] + EDGE * row * across[i])) for row in rows]
        lines += [f"vt {edge * i:.6f} {offset + EDGE * row:.6f}" for row in rows]
    for group, begin, end in ((name, 1, n - 2), (f"{name}-start", 0, 1), (f"{name}-end", n - 2, n - 1)):
        lines.append(f"g {group}")
        for i in range(begin, end):
            for row in range(CELLS):
                a = first + i * (CELLS + 1) + row
                quad = a, a + CELLS + 1, a + CELLS + 2, a + 1
                lines.append("f " + " ".join(f"{corner}/{corner}" for corner in quad))
    return lines


def main() -> None:
    """Write the file."""
    lines = ["# Two strips in a loose reef knot (scripts/reef_knot.py); vt: flat, in metres"]
    lines += strip(mirrored(BIGHT), "left", 1, 0.0)
    lines += strip(mirrored(AROUND), "right", 1 + sum(line.startswith("v ") for line in lines), 1.0)
    FILE.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
