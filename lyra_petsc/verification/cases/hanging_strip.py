"""A strip hanging under its own weight."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from lyra_petsc.verification.bench import Bench, data
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Converges

DATA = data("hanging")
LENGTH, WIDTH, STIFFNESS, G = 1.0, 0.1, 100.0, 9.81
"""m, m, N/m, m/s²"""

WEIGHTS = (0.01, 0.1, 1.0, 10.0)
"""e of the rows that are run"""


def _scene(n: int, e: float) -> dict[str, Any]:
    membrane = {"c11": STIFFNESS, "c22": STIFFNESS, "c12": 0.0, "c33": 0.5 * STIFFNESS}
    return {
        "mesh": {"grid": {"width": LENGTH, "height": WIDTH, "nx": n, "ny": 1, "pattern": "criss-cross"}},
        "material": {"density": e * STIFFNESS / (G * LENGTH), "membrane": membrane},
        "gravity": [G, 0, 0],
        "handles": [{"group": "left"}, {"group": "sheet", "axes": ["z"]}],
        "time": {"analysis": "static"},
    }


def _measure(bench: Bench, n: float) -> Iterator[Measured]:
    for e, exact in DATA["strip"]["rows"]:
        if e in WEIGHTS:
            with bench.simulation(_scene(int(n), e)) as trial:
                x = trial.run().x
            end = float(x[[int(n), 2 * int(n) + 1], 0].mean()) - LENGTH
            yield Measured(f"elongation, weight {e:g} of c11", end, exact * LENGTH, "m")


CASE = Case(
    name="hanging-strip",
    title="A strip hanging by one end under its own weight, static: elongation against the continuum",
    source=DATA["source"],
    resolutions=(32, 64, 128),
    measure=_measure,
    claim=Converges(2.0, 1e-3),
    counts="cells along the strip",
)
