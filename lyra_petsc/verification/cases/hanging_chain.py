"""Small vibrations of a strip hanging from one edge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.verification.bench import Bench, data
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Converges
from lyra_petsc.verification.spectrum import lowest_modes

DATA = data("vibrations")["hanging_chain"]
LENGTH, WIDTH, G, DENSITY = 1.0, 0.05, 9.81, 0.2
"""m, m, m/s², kg/m²"""

STIFFNESS = 1e6
"""N/m; the weight stretches the strip by 1e-6"""

MODES = 3


def _scene(n: float) -> dict[str, Any]:
    membrane = {"c11": STIFFNESS, "c22": STIFFNESS, "c12": 0.0, "c33": 0.5 * STIFFNESS}
    return {
        "mesh": {"grid": {"width": WIDTH, "height": LENGTH, "nx": 2, "ny": int(n)}},
        "material": {"density": DENSITY, "membrane": membrane},
        "gravity": [0, -G, 0],
        # a membrane pulled in one direction only does not feel its neighbours on either side: of the
        # three columns of vertices the middle one, whose masses are those of a wide sheet, is free
        "handles": [
            {"group": "top"},
            {"group": "sheet", "axes": ["x"]},
            {"group": "left", "axes": ["z"]},
            {"group": "right", "axes": ["z"]},
        ],
        "time": {"end": 1.0, "step": 1.0},
    }


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    with bench.simulation(_scene(n)) as trial:
        x = trial.start
        trial.set_state(x=np.column_stack([x[:, 0], _hanging(x[:, 1], n), x[:, 2]]))
        found, _ = lowest_modes(trial, MODES)
    exact = [half * math.sqrt(G / LENGTH) for half in DATA["half_j0"]]
    return [
        Measured(f"ω of mode {k}", float(omega), exact[k - 1], "rad/s") for k, omega in enumerate(found, 1)
    ]


def _hanging(y: NDArray[np.float64], n: float) -> NDArray[np.float64]:
    """Heights at which every bar between two rows carries what hangs below its middle."""
    tension = DENSITY * G * LENGTH * (np.arange(int(n)) + 0.5) / n
    # λ³ − λ = 2 T/C by two Newton steps from the linear answer
    stretch = 1.0 + tension / STIFFNESS
    for _ in range(2):
        stretch -= (stretch**3 - stretch - 2.0 * tension / STIFFNESS) / (3.0 * stretch**2 - 1.0)
    heights = np.concatenate([[0.0], np.cumsum(stretch) * LENGTH / n])
    return np.asarray(LENGTH - (heights[-1] - heights)[np.rint(y / LENGTH * n).astype(np.int64)])


CASE = Case(
    name="hanging-chain",
    title="A strip hanging from one edge: frequencies from the assembled K and M against zeros of J0",
    source="closed form ω = j_0k/2 √(g/L)",
    resolutions=(16, 32, 64, 128),
    measure=_measure,
    claim=Converges(2.0, 1e-3),
    counts="cells along the strip",
)
