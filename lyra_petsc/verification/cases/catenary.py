"""Catenaries of a strip that hardly stretches."""

from __future__ import annotations

from collections.abc import Iterator

from lyra_petsc.verification.bar_strip import LENGTH, hung
from lyra_petsc.verification.bench import Bench, data
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Converges

DATA = data("catenary")
WEIGHTS = {0.95: 1e-6, 0.9: 1e-6, 0.8: 1e-6, 0.5: 1e-5}
"""Of c11, by span: the strip stretches by no more than that, and the less it sags, the more that counts."""


def _measure(bench: Bench, n: float) -> Iterator[Measured]:
    for span, sag in DATA["inextensible"]["rows"]:
        if span in WEIGHTS:
            with bench.simulation(hung(bench, int(n), WEIGHTS[span], span * LENGTH, 0.0)) as trial:
                low = -float(trial.run().x[int(n) // 2, 2])
            yield Measured(f"sag, span {span:g} of the length", low, sag * LENGTH, "m")


CASE = Case(
    name="catenary",
    title="A stiff strip hung by both ends at one height, static: sag of the inextensible catenary",
    source=DATA["source"],
    resolutions=(8, 16, 32, 64),
    measure=_measure,
    claim=Converges(2.0, 1e-3),
    counts="cells along the strip",
)
