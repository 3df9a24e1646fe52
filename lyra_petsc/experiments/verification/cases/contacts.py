"""Sheets in contact: friction on a slope."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.verification.answers import Exact, Measured, case

G = 9.81
SLOPES = (5.0, 30.0, 60.0)
SLIDING = (0.99, 0.9, 0.5)
"""Coefficients of friction over the slope's tangent."""

STICKS = 1.01
GAP, STEP = 0.01, 0.01
CLEAR = 0.94
"""Part of the gap at which the sheet starts, near where its weight holds it."""

SETTLED, END, SLID = 1.0, 3.0, 1.5
"""Times [s]: from when a sheet that sticks must stand, its end, that of a sheet that slides."""


def _slope(degrees: float, friction: float, cells: int, end: float) -> dict[str, Any]:
    """A free sheet on a slope that falls along x."""
    angle = math.radians(degrees)
    normal = [math.sin(angle), 0.0, math.cos(angle)]
    side = 0.4
    grid = {"width": side, "height": side, "nx": cells, "ny": cells, "pattern": "alternating"}
    turn = {"axis": [0.0, 1.0, 0.0], "degrees": degrees}
    place = [CLEAR * GAP * component for component in normal]
    return {
        "mesh": {"grid": grid, "transform": {"rotate": turn, "translate": place}},
        "material": {"cloth": "gray-interlock"},
        "gravity": [0.0, 0.0, -G],
        "contact": {"gap": GAP, "friction": friction, "self": False},
        "obstacles": {"slope": {"plane": {"point": [0.0, 0.0, 0.0], "normal": normal}}},
        "time": {"end": end, "step": STEP},
    }


def _at(trial: Trial, time: float) -> Trial:
    """Steps to a time [s]; collective."""
    while trial.simulation.time < time - 0.5 * STEP:
        trial.step()
    return trial


@case(
    "Sheet on a slope of 5, 30 and 60°: stands at 1.01 of the friction that holds it, slides with "
    "g (sin α − μ cos α) at 0.99, 0.9 and 0.5 of it",
    source="Coulomb's law",
    resolutions=(2, 4),
    claim=Exact(1e-6),
    claims={"acceleration": Exact(5e-3)},
    counts="cells a side",
    quick=1,
)
def incline(bench: Bench, n: float) -> Sequence[Measured]:
    creep, off = 0.0, (0.0, 1.0, 1.0)
    for degrees in SLOPES:
        angle = math.radians(degrees)
        down = np.array([math.cos(angle), 0.0, -math.sin(angle)])
        with bench.simulation(_slope(degrees, STICKS * math.tan(angle), round(n), END)) as trial:
            settled = _at(trial, SETTLED).x
            creep = max(creep, float(np.abs((trial.run().x - settled) @ down).max()))
        for part in SLIDING:
            with bench.simulation(_slope(degrees, part * math.tan(angle), round(n), SLID)) as trial:
                before = _at(trial, 0.5 * SLID).v
                change = (trial.run().v - before) @ down
            exact = G * (1.0 - part) * math.sin(angle)
            found = float(change.mean()) / (0.5 * SLID)
            off = max(off, (abs(found / exact - 1.0), found, exact))
    return [
        Measured("creep", creep, 0.0, "m", scale=1.0),
        Measured("acceleration", off[1], off[2], "m/s²"),
    ]
