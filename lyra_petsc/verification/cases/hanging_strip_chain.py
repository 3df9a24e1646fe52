"""A strip whose rows carry equal weights, half of it at both ends: a chain of equal bars."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from lyra_petsc.verification.bench import Bench, data, farthest
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Exact

DATA = data("hanging")
LENGTH, WIDTH, STIFFNESS = 1.0, 0.1, 100.0
"""m, m, N/m"""


def _scene(n: int, e: float) -> dict[str, Any]:
    weight = e * STIFFNESS * WIDTH
    rows = [{"nodes": [i, n + 1 + i]} for i in range(n + 1)]
    shares = np.full(n + 1, 1.0 / n)
    shares[[0, -1]] *= 0.5
    # not by gravity: the two corners of a strip's end differ in mass, its rows must not
    loads = [
        row | {"force": [weight * share, 0, 0]} for row, share in zip(rows, shares.tolist(), strict=True)
    ]
    membrane = {"c11": STIFFNESS, "c22": STIFFNESS, "c12": 0.0, "c33": 0.5 * STIFFNESS}
    return {
        "mesh": {"grid": {"width": LENGTH, "height": WIDTH, "nx": n, "ny": 1}},
        "material": {"density": 0.1, "membrane": membrane},
        "handles": [rows[0], {"group": "sheet", "axes": ["z"]}],
        "loads": loads,
        "time": {"analysis": "static"},
    }


def _measure(bench: Bench, n: float) -> Iterator[Measured]:
    for e, bars, exact in DATA["chain"]["rows"]:
        if bars == n:
            with bench.simulation(_scene(int(n), e)) as trial:
                x = trial.run().x
            end = farthest(x[[int(n), 2 * int(n) + 1], 0] - LENGTH, exact * LENGTH)
            yield Measured(f"elongation, weight {e:g} of c11", end, exact * LENGTH, "m", LENGTH)


CASE = Case(
    name="hanging-strip-chain",
    title="A strip hanging by one end, its weight in equal rows, static: the chain of n equal bars",
    source=DATA["source"],
    resolutions=(1, 2, 4, 8, 16, 32, 64),
    measure=_measure,
    claim=Exact(1e-10),
    quick=4,
    counts="cells along the strip",
)
