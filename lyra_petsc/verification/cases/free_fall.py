"""Free fall by backward Euler."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lyra_petsc.verification.bench import Trial, data, simulated
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Converges, Exact

DATA = data("free_fall")
END = 0.1
"""s"""


def _scene(n: float) -> dict[str, Any]:
    return {
        "mesh": {"grid": {"width": 1.0, "height": 0.6, "nx": 5, "ny": 3, "pattern": "alternating"}},
        "material": {"density": 0.2, "membrane": {"c11": 1200, "c22": 800, "c12": 300, "c33": 250}},
        "gravity": [0, 0, -DATA["g"]],
        "time": {"end": END, "step": 1.0 / n},
    }


def _measure(trial: Trial, n: float) -> Sequence[Measured]:
    z = trial.x[:, 2]
    discrete = next(z for dt, _, z in DATA["z_backward_euler"] if np.isclose(dt * n, 1.0))
    exact = -0.5 * DATA["g"] * END**2
    farthest = z[np.argmax(np.abs(z - discrete))]
    return [
        Measured("z of the vertex farthest off, discrete answer", float(farthest), discrete, "m"),
        Measured("mean z, continuous answer", float(z.mean()), exact, "m"),
    ]


CASE = Case(
    name="free-fall",
    title="Free fall of a sheet, backward Euler: z against −g Δt² n(n+1)/2 and against −g t²/2",
    source="closed form",
    resolutions=(10, 100, 1000),
    measure=simulated(_scene, _measure),
    claim=Exact(1e-10),
    claims={"mean z, continuous answer": Converges(1.0, 1.1e-2, slack=1e-6)},
    quick=2,
    counts="steps per second",
)
