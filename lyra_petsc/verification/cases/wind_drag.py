"""Sheets falling in still air by backward Euler."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from lyra_petsc.verification.bench import Bench, data, farthest
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Converges, Exact

DATA = data("wind_drag")
G, DENSITY, AIR = DATA["g"], DATA["density"], DATA["air"]
DRAG = 2.0
"""kg/(m² s), along the sheet"""

END = 0.5
"""s"""


def _scene(n: float, gravity: list[float], air: float, drag: float) -> dict[str, Any]:
    return {
        "mesh": {"grid": {"width": 1.0, "height": 0.6, "nx": 4, "ny": 3, "pattern": "alternating"}},
        "material": {"density": DENSITY, "membrane": {"c11": 1200, "c22": 800, "c12": 300, "c33": 250}},
        "gravity": gravity,
        "wind": {"velocity": [0, 0, 0], "density": air, "drag": drag},
        "time": {"end": END, "step": 1.0 / n},
    }


def level_fall(n: float, end: float) -> tuple[float, float]:
    """Speed [m/s] and depth [m] after backward Euler's steps of 1/n s; v is the root of its quadratic."""
    dt, v, z = 1.0 / n, 0.0, 0.0
    a = dt * AIR / DENSITY
    for _ in range(round(end * n)):
        b = v + dt * G
        v = 2.0 * b / (1.0 + math.sqrt(1.0 + 4.0 * a * b))
        z += dt * v
    return v, z


def _edge_on(n: float) -> float:
    """Speed [m/s] of backward Euler under a force proportional to it."""
    dt, v = 1.0 / n, 0.0
    for _ in range(round(END * n)):
        v = (v + dt * G) / (1.0 + dt * DRAG / DENSITY)
    return v


def _measure(bench: Bench, n: float) -> Iterator[Measured]:
    speed, depth = level_fall(n, END)
    with bench.simulation(_scene(n, [0, 0, -G], AIR, 0.0)) as trial:
        start = trial.x[0, 2]
        trial.run()
        level = farthest(-trial.v[:, 2], speed)
        fallen = float(start - trial.x[0, 2])
    exact = next(-z for t, _, z in DATA["continuous"] if t == END)
    yield Measured("speed of a level sheet, backward Euler", level, speed, "m/s")
    yield Measured("depth of a level sheet, backward Euler", fallen, depth, "m")
    yield Measured("depth of a level sheet, exact in time", fallen, exact, "m")
    with bench.simulation(_scene(n, [0, -G, 0], AIR, DRAG)) as trial:
        slow = _edge_on(n)
        edge_on = farthest(-trial.run().v[:, 1], slow)
    terminal = DENSITY * G / DRAG
    exact = terminal * (1.0 - math.exp(-G * END / terminal))
    yield Measured("speed of a sheet edge-on, backward Euler", edge_on, slow, "m/s")
    yield Measured("speed of a sheet edge-on, exact in time", edge_on, exact, "m/s")


CASE = Case(
    name="wind-drag",
    title="Sheets falling in still air, level (force ρ A v²) and edge-on (drag A v), backward Euler",
    source=DATA["source"],
    resolutions=(50, 100, 200, 400),
    measure=_measure,
    claim=Exact(1e-10),
    claims={
        "depth of a level sheet, exact in time": Converges(1.0, 2e-3, slack=0.1),
        "speed of a sheet edge-on, exact in time": Converges(1.0, 1e-2, slack=0.3),
    },
    counts="steps per second",
)
