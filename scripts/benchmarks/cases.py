"""Scenes of the benchmark: a square of gray interlock hung by two corners, and contact."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from lyra_petsc.experiments.meshes import rectangle_script

CLOTH = "gray-interlock"
DAMPING = 0.03  # s
GRAVITY = [0.0, 0.0, -9.81]  # m/s²
STEP = 0.005  # s
METHODS = ("semi-implicit", "beuler")


def cells_of(vertices: int) -> int:
    """Cells along an edge of the square whose number of vertices is closest to ``vertices``."""
    return max(1, round(math.sqrt(vertices)) - 1)


def square_number(vertices: int) -> int:
    """Number of vertices of the square that is closest to ``vertices``."""
    return (cells_of(vertices) + 1) ** 2


def corners(vertices: int) -> list[int]:
    """The vertices that hold the square: the ends of its upper edge."""
    cells = cells_of(vertices)
    return [cells * (cells + 1), (cells + 1) ** 2 - 1]


def hanging_square(
    vertices: int, method: str = METHODS[0], *, step: float = STEP, stiffness: float = 1.0
) -> dict[str, Any]:
    """The scene, in the keys of a scene file.

    Parameters
    ----------
    vertices : int
        Approximate number, see `square_number`.
    method : str
        ``semi-implicit``: one linear solve a step; ``beuler``: Newton's method to the scene's tolerances.
    step : float
        Δt [s].
    stiffness : float
        Factor on the membrane stiffness.
    """
    cells = cells_of(vertices)
    return {
        "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": cells, "ny": cells}},
        "material": {"cloth": CLOTH, "damping": DAMPING, "stretching_scale": stiffness},
        "gravity": GRAVITY,
        "handles": [{"nodes": corners(vertices)}],
        "time": {"end": 1e6 * step, "step": step, "integrator": method},
    }


GRADED_MESH = "gmsh 1:20"

PLAIN_MESHES = ("diagonal", "alternating", "criss-cross", "gmsh")
"""Kinds of meshes of the square; the first is used in most measurements."""

MESHES = (*PLAIN_MESHES, GRADED_MESH, "diagonal, midedge", "gmsh, midedge")
"""All kinds of meshes, with the bending model if it is not that of hinges."""

BENDING_MESHES = ("diagonal", "alternating", "gmsh")
BENDING_MODELS = ("hinge", "midedge")

GRADED = 20.0
"""Largest over smallest edge of graded meshes."""


def on_mesh(kind: str, vertices: int, folder: Path) -> dict[str, Any]:
    """`hanging_square` on another kind of mesh; files for gmsh are written into ``folder``."""
    kind, _, model = kind.partition(", ")
    scene = hanging_square(vertices)
    if kind in ("diagonal", "alternating"):
        scene["mesh"]["grid"]["pattern"] = kind
    elif kind == "criss-cross":
        # a centre for each cell, numbered after the corners of all cells
        scene = hanging_square(vertices // 2)
        scene["mesh"]["grid"]["pattern"] = kind
    else:
        file = folder / f"{kind.replace(':', '-').replace(' ', '-')}-{vertices}.geo"
        file.write_text(square_script(vertices, GRADED if kind == GRADED_MESH else 1.0), encoding="ascii")
        scene |= {"mesh": {"file": str(file)}, "handles": [{"group": "held"}]}
    if model:
        scene["material"]["bending_model"] = model
    return scene


def square_script(vertices: int, ratio: float) -> str:
    """Gmsh script of the square with about ``vertices`` vertices; edges grow ``ratio`` times to the top."""
    # equilateral triangles of edge h have one vertex per √3/2 h²; h grows with the height
    lower = math.sqrt(2.0 / (math.sqrt(3.0) * ratio * vertices))
    sizes = (lower, lower, ratio * lower, ratio * lower)
    return rectangle_script(1.0, 1.0, sizes) + 'Physical Point("held") = {3, 4};\n'


SHEETS = 5
"""Number of sheets in the stack."""


def in_contact(vertices: int, ball_gap: float | None = None) -> dict[str, dict[str, Any]]:
    """Scenes by name, each with about ``vertices`` vertices in total.

    A sheet held at an edge that swings, without contact and with contact but nothing near (also with
    ``semi-implicit`` steps); a sheet that falls over a ball, with ``ball_gap`` [m] if given; several sheets
    that swing, and as many in a stack on a plane, with aligned and with shifted vertices; the latter also a
    thousand times stiffer.
    """

    def sheets(number: int, distance: float, shift: float = 0.0) -> list[dict[str, Any]]:
        cells = cells_of(vertices // number)
        grid = {"width": 1.0, "height": 1.0, "nx": cells, "ny": cells, "pattern": "alternating"}
        first, offset = np.array([-0.5, -0.5, 0.95 * distance]), np.array([shift, 0.6 * shift, distance])
        return [
            {"grid": grid, "transform": {"translate": (first + layer * offset).tolist()}}
            for layer in range(number)
        ]

    common = hanging_square(vertices, "beuler")
    held = {"handles": [{"group": "left"}]}
    free = {"handles": []}
    ball = {"obstacles": {"ball": {"sphere": {"center": [0.0, 0.0, -0.31], "radius": 0.3}}}}
    floor = {"obstacles": {"floor": {"plane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}}}}
    gap = 0.2 / cells_of(vertices // SHEETS)
    one, several, shifted = sheets(1, 0.0), sheets(SHEETS, gap), {"mesh": sheets(SHEETS, gap, 1.55 * gap)}
    far = {"ball": {"sphere": {"center": [0.0, 0.0, -9.0], "radius": 0.3}}}
    alone: dict[str, Any] = {"mesh": one}
    near = alone | {"contact": {"friction": 0.4}}
    once = held | {"time": common["time"] | {"integrator": "semi-implicit"}}
    closer = {} if ball_gap is None else {"contact": near["contact"] | {"gap": ball_gap}}
    scenes = {
        "swings, semi-implicit": common | once | alone,
        "swings, semi-implicit, nothing near": common | once | near | {"obstacles": far},
        "swings": common | held | alone,
        "swings, nothing near": common | held | near | {"obstacles": far},
        "over a ball": common | free | ball | near | closer,
    }
    for factor in (1.0, 1000.0):
        stiffer = common | {"material": common["material"] | {"stretching_scale": factor}, "mesh": several}
        words = "" if factor == 1.0 else f", ×{factor:g}"
        scenes[f"{SHEETS} swing{words}"] = stiffer | held
        touching = {"contact": {"gap": gap, "friction": 0.4}}
        scenes[f"{SHEETS} in a stack{words}"] = stiffer | free | floor | touching
        scenes[f"{SHEETS} in a stack, not in line{words}"] = stiffer | free | floor | touching | shifted
    return scenes
