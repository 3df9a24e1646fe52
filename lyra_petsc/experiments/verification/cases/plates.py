"""Plates that bend by one unknown on every edge: they converge to Kirchhoff's on every kind of mesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.meshes import irregular_rectangle, square_script
from lyra_petsc.experiments.verification.answers import Converges, Measured, case, data

EXACT = data("linear_plate")
HELD = {
    "CCCC": ("clamp", ("left", "right", "bottom", "top")),
    "SSSS": ("pin", ("left", "right", "bottom", "top")),
    "CFFF": ("clamp", ("left",)),
}
SIDES: dict[str, list[list[float | None]]] = {
    "left": [[None, None, None], [0.0, None, None]],
    "right": [[1.0, None, None], [None, None, None]],
    "bottom": [[None, None, None], [None, 0.0, None]],
    "top": [[None, 1.0, None], [None, None, None]],
}
LARGEST = 1e-3
"""Deflection over the side: so small that the plate is linear to 1e-5."""

MESHES = ("diagonal", "alternating", "criss-cross", "irregular", "gmsh")


def unit_square(bench: Bench, kind: str, n: int) -> dict[str, Any]:
    """The mesh block of a unit square with n edges along each side; collective."""
    if kind == "irregular":
        return bench.mesh(*irregular_rectangle(n, 1.0, 1.0))
    if kind == "gmsh":
        return bench.script(square_script(1.0 / n))
    return {"grid": {"width": 1.0, "height": 1.0, "nx": n, "ny": n, "pattern": kind}}


def _beside(side: str) -> list[list[float]]:
    """Opposite corners of a box about one side of the unit square."""
    low, high = SIDES[side]
    grown = 1e-6
    return [
        [-1.0 if value is None else value - grown for value in low],
        [2.0 if value is None else value + grown for value in high],
    ]


@case(
    "Plates (C clamped, S supported, F free edges) under a small uniform load, bending_model: midedge: "
    "deflection against Kirchhoff's plate",
    source=EXACT["source"],
    resolutions=(8, 16, 32, 64, 128),
    claim=Converges(2.0, 2e-3, slack=0.4),
)
def plate(bench: Bench, n: float) -> Sequence[Measured]:
    found = []
    for words, exact in EXACT["deflection"].items():
        edges, poisson = words.split()
        how, sides = HELD[edges]
        load = LARGEST / exact["at"]
        for kind in MESHES:
            scene = {
                "mesh": unit_square(bench, kind, round(n)),
                "material": {
                    "density": 1.0,
                    "membrane": {"c11": 1.0, "c22": 1.0, "c12": 0.0, "c33": 0.5},
                    "bending_model": "midedge",
                    "bending": {
                        "d11": 1.0,
                        "d22": 1.0,
                        "d12": float(poisson),
                        "d33": 0.5 * (1.0 - float(poisson)),
                    },
                },
                "gravity": [0.0, 0.0, load],
                "handles": [{"box": _beside(side), "clamp": how == "clamp"} for side in sides],
                "time": {"analysis": "static"},
            }
            with bench.simulation(scene) as trial:
                height, start = trial.run().x[:, 2], trial.start[:, :2]
            at = int(np.argmin(np.linalg.norm(start - exact["place"], axis=1)))
            value = float(height[at]) / LARGEST
            found.append(Measured(f"deflection, {edges}, ν = {poisson}, {kind}", value, 1.0))
    return found
