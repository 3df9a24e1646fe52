"""A round membrane under a dead load."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from lyra_petsc.verification.bench import Bench, data
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Converges
from lyra_petsc.verification.meshes import quarter_disc

DATA = data("circular_membrane")
RADIUS, STIFFNESS, G = 1.0, 1000.0, 9.81
"""m, N/m, m/s²"""

LOADS = ((0.0, 1e-4), (0.0, 0.1), (0.3, 1e-4), (0.3, 0.01), (0.3, 0.1), (0.3, 1.0))
"""nu and e of the rows that are run"""


def _scene(mesh: dict[str, Any], n: int, nu: float, e: float) -> dict[str, Any]:
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    rim = np.unique(np.concatenate([number[-1], number[:, -1]]))
    membrane = {
        "c11": STIFFNESS,
        "c22": STIFFNESS,
        "c12": nu * STIFFNESS,
        "c33": 0.5 * (1.0 - nu) * STIFFNESS,
    }
    return {
        "mesh": mesh,
        "material": {"density": e * STIFFNESS / (G * RADIUS), "membrane": membrane},
        "gravity": [0, 0, -G],
        # the rim, and the two planes of symmetry
        "handles": [
            {"nodes": rim.tolist()},
            {"nodes": number[:, 0].tolist(), "axes": ["x"]},
            {"nodes": number[0].tolist(), "axes": ["y"]},
        ],
        "time": {"analysis": "static"},
    }


def _measure(bench: Bench, n: float) -> Iterator[Measured]:
    mesh = bench.mesh(*quarter_disc(int(n), RADIUS))
    for nu, e, exact in DATA["rows"]:
        if (nu, e) in LOADS:
            with bench.simulation(_scene(mesh, int(n), nu, e)) as trial:
                sag = -float(trial.run().x[0, 2])
            name = f"central deflection, ν = {nu:g}, load {e:g} C/a"
            yield Measured(name, sag, exact * RADIUS, "m")


CASE = Case(
    name="circular-membrane",
    title="A round membrane with a fixed rim under its own weight, static: central deflection",
    source=DATA["source"],
    resolutions=(4, 8, 16, 32),
    measure=_measure,
    claim=Converges(2.0, 1e-3),
    counts="cells along the radius",
)
