"""Rectangles and strips, their meshes (patterns of grids, an irregular one, gmsh's) and materials.

Strips one cell wide are cantilevers clamped at x = 0, of length 1 m with B = 1 N·m and c12 = 0, or hang
between two supports. One cell across keeps apart what a plate adds to a strip: wider strips resist with their
membrane against the lateral curvature that hinges give them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.meshes import irregular_rectangle, rectangle, rectangle_script, sides
from lyra_petsc.experiments.verification.answers import grid, isotropic, scene

KINDS = ("diagonal", "alternating", "criss-cross", "irregular", "gmsh")


def flat_mesh(
    bench: Bench, kind: str, nx: int, ny: int, width: float = 1.0, height: float = 1.0
) -> dict[str, Any]:
    """The mesh block of a rectangle of nx × ny cells with groups left, right, bottom, top; collective.

    gmsh's edges are as long as a cell along x, and it puts a vertex in the middle where ny is even.
    """
    if kind == "irregular":
        return bench.grouped(*irregular_rectangle(nx, ny, width, height), sides(nx, ny))
    if kind == "gmsh":
        middle = () if ny % 2 else (0.5 * width, 0.5 * height)
        return bench.script(rectangle_script(width, height, width / nx, middle))
    return grid(width, height, nx, ny, kind)


def strip_mesh(bench: Bench, kind: str, n: float, width: float, length: float = 1.0) -> dict[str, Any]:
    """The mesh block of a strip, n cells along; ``width`` over its length, 0 is one square cell; collective.

    Cells are as near to squares as the width allows.
    """
    across = max(1, round(width * n))
    return flat_mesh(bench, kind, round(n), across, length, (width or 1.0 / n) * length)


def plate_material(membrane: float, stiffness: float = 1.0, poisson: float = 0.0) -> dict[str, Any]:
    """Material of 1 kg/m²: c11 [N/m] and the plate stiffness D [N·m], both with ``poisson``; directors."""
    return {
        "density": 1.0,
        "membrane": isotropic(membrane, poisson),
        "bending_model": "midedge",
        "bending": {
            "d11": stiffness,
            "d22": stiffness,
            "d12": poisson * stiffness,
            "d33": 0.5 * (1.0 - poisson) * stiffness,
        },
    }


MEMBRANE = 1e6
"""C L²/B: as of a strip with a thickness of 0.0035 L. The exact shapes take its stretch into account."""

DENSITY = 1.0
"""kg/m²"""


def strip(pattern: str, n: float, membrane: float = MEMBRANE, **more: Any) -> dict[str, Any]:
    """A scene: n square cells along the strip, its end clamped, static.

    ``more`` are further keys of the scene; ``material`` is added to.
    """
    along = round(n)
    material = {"density": DENSITY, "membrane": isotropic(membrane), "bending": 1.0}
    held = [{"group": "left", "clamp": True}]
    mesh = grid(1.0, 1.0 / along, along, 1, pattern)
    return scene(mesh, material | more.pop("material", {}), handles=held, **more)


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
    mesh = bench.mesh(start, triangles, rest=vertices[:, :2])
    material = {"density": e * STIFFNESS / (G * LENGTH), "membrane": isotropic(STIFFNESS)}
    held = [{"nodes": [0, n, n + 1, 2 * n + 1]}, {"box": [[-9, -9, -9], [9, 9, 9]], "axes": ["y"]}]
    return scene(mesh, material, gravity=[0, 0, -G], handles=held)
