"""What is measured: a square of gray interlock hung by two corners, and a sheet of 100 triangles."""

from __future__ import annotations

import math
from typing import Any

CLOTH = "gray-interlock"
DAMPING = 0.03  # s
GRAVITY = [0.0, 0.0, -9.81]  # m/s²
STEP = 0.005  # s
METHODS = ("semi-implicit", "beuler")


def cells_of(vertices: int) -> int:
    """Cells along an edge of the square that comes closest to a number of vertices."""
    return max(1, round(math.sqrt(vertices)) - 1)


def square_number(vertices: int) -> int:
    """Vertices of the square that comes closest to a number of them."""
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
        About as many, see `square_number`.
    method : str
        ``semi-implicit``: one linear solve a step; ``beuler``: Newton's method to the scene's tolerances.
    step : float
        Δt [s].
    stiffness : float
        Factor on the membrane's.
    """
    cells = cells_of(vertices)
    return {
        "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": cells, "ny": cells}},
        "material": {"cloth": CLOTH, "damping": DAMPING, "stretching_scale": stiffness},
        "gravity": GRAVITY,
        "handles": [{"nodes": corners(vertices)}],
        "time": {"end": 1e6 * step, "step": step, "integrator": method},
    }


def small_sheet() -> dict[str, Any]:
    """100 triangles, so that hardly anything but the overhead of a step is left."""
    scene = hanging_square(36)
    scene["mesh"] = {"grid": {"width": 0.5, "height": 1.0, "nx": 5, "ny": 10}}
    scene["handles"] = [{"nodes": [60, 65]}]
    return scene
