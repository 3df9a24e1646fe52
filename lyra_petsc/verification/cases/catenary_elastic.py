"""Elastic catenaries."""

from __future__ import annotations

from collections.abc import Iterator

from lyra_petsc.verification.bar_strip import LENGTH, hung
from lyra_petsc.verification.bench import Bench, data
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Converges

DATA = data("catenary")
STRIPS = ((0.001, 0.8), (0.01, 0.5), (0.01, 1.0), (0.1, 0.8), (1.0, 0.5), (1.0, 1.0))
"""e and span of the rows that are run"""


def _measure(bench: Bench, n: float) -> Iterator[Measured]:
    for e, span, sag, _, _ in DATA["elastic"]["rows"]:
        if (e, span) in STRIPS:
            with bench.simulation(hung(bench, int(n), e, span * LENGTH, 0.0)) as trial:
                low = -float(trial.run().x[int(n) // 2, 2])
            name = f"sag, weight {e:g} of c11, span {span:g} of the length"
            yield Measured(name, low, sag * LENGTH, "m")


CASE = Case(
    name="catenary-elastic",
    title="A strip hung by both ends that stretches under its own weight, static: sag",
    source=DATA["source"],
    resolutions=(8, 16, 32, 64),
    measure=_measure,
    claim=Converges(2.0, 1e-3),
    counts="cells along the strip",
)
