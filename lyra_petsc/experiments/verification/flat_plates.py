"""Plates: rectangles on every kind of mesh (patterns of grids, an irregular one, gmsh's), and a material."""

from __future__ import annotations

from typing import Any

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.meshes import irregular_rectangle, rectangle_script, sides
from lyra_petsc.experiments.verification.answers import grid, isotropic

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
