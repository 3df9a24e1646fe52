"""A strip one cell wide along x between two supports, started from an arc of its own length."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.experiments.verification.case import isotropic

Array = NDArray[np.float64]

LENGTH, WIDTH, STIFFNESS, G = 1.0, 0.1, 1000.0, 9.81
"""m, m, N/m, m/s²"""


def arc(s: Array, span: float) -> Array:
    """Points (n, 2) [m] at arc lengths s of a sagging circular arc of length 1 over a chord ``span``."""
    if span >= LENGTH:
        return np.column_stack([s, 0.0 * s])
    # chord = 2 R sin(L/2R): the half angle by bisection
    low, high = 1e-9, math.pi
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if math.sin(middle) / middle > span / LENGTH else (low, middle)
    radius = 0.5 * LENGTH / low
    angle = s / radius - low
    return radius * np.column_stack([np.sin(angle) + math.sin(low), math.cos(low) - np.cos(angle)])


def hung(bench: Bench, n: int, e: float, dx: float, dz: float) -> dict[str, Any]:
    """The scene: supports (dx, dz) [m] apart, weight e times c11, n cells; static.

    Nothing in it knows the catenary: the strip starts from an arc of a circle between the supports.
    """
    # all inner vertices of a diagonal grid have the same mass, so that the edges hang alike
    vertices, triangles = rectangle(n, 1, LENGTH, WIDTH, alternating=False)
    chord = math.hypot(dx, dz)
    along = arc(vertices[:, 0], chord)
    cos, sin = dx / chord, dz / chord
    start = np.column_stack(
        [cos * along[:, 0] - sin * along[:, 1], vertices[:, 1], sin * along[:, 0] + cos * along[:, 1]]
    )
    return {
        "mesh": bench.mesh(start, triangles, rest=vertices[:, :2]),
        "material": {"density": e * STIFFNESS / (G * LENGTH), "membrane": isotropic(STIFFNESS)},
        "gravity": [0, 0, -G],
        "handles": [{"nodes": [0, n, n + 1, 2 * n + 1]}, {"box": [[-9, -9, -9], [9, 9, 9]], "axes": ["y"]}],
        "time": {"analysis": "static"},
    }
