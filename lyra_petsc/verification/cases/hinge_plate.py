"""Linear plates of hinges: the errors that are predicted for each pattern of mesh, however fine it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lyra_petsc.verification.bench import Bench, data
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Exact
from lyra_petsc.verification.flat_sheet import stiffness

DATA = data("hinge_plate")

SIDES = ("left", "right", "bottom", "top")
HANDLES: dict[str, list[dict[str, Any]]] = {
    "CCCC": [{"group": side, "clamp": True} for side in SIDES],
    "SSSS": [{"group": side} for side in SIDES],
    "CFFF": [{"group": "left", "clamp": True}],
}
PLACE = {"CCCC": (0.5, 0.5), "SSSS": (0.5, 0.5), "CFFF": (1.0, 0.5)}
"""Where the deflection is taken."""


def scene(edges: str, pattern: str, n: int) -> dict[str, Any]:
    """A unit square with B = 1 and a weight of 1 N/m²."""
    return {
        "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": n, "ny": n, "pattern": pattern}},
        "material": {"density": 1.0, "membrane": {"c11": 1, "c22": 1, "c12": 0, "c33": 0.5}, "bending": 1.0},
        "handles": HANDLES[edges],
        "time": {"end": 1.0, "step": 1.0},
    }


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    found = []
    for edges, pattern, *errors in DATA["rows"]:
        with bench.simulation(scene(edges, pattern, round(n))) as trial:
            operator, points, mass = stiffness(trial), trial.x[:, :2], trial.mass
        height = operator.solve(mass)
        at = int(np.argmin(np.linalg.norm(points - PLACE[edges], axis=1)))
        error = height[at] / DATA["deflection"][edges] - 1.0
        predicted = errors[CASE.resolutions.index(n)]
        found.append(Measured(f"error of the deflection, {edges} {pattern}", error, predicted, scale=1.0))
    return found


CASE = Case(
    name="hinge-plate",
    title=(
        "Linear plates (C clamped, S supported, F free edges) under uniform load: how far hinges are off "
        "the exact deflection, against what is predicted for the mesh"
    ),
    source=DATA["source"],
    resolutions=(8, 16, 32, 64),
    measure=_measure,
    claim=Exact(1e-7),  # round-off: the condition number grows with n⁴
)
