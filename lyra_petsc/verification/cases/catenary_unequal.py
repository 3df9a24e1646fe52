"""Catenaries between supports of different heights."""

from __future__ import annotations

import math
from collections.abc import Iterator

from lyra_petsc.verification.bar_strip import LENGTH, hung
from lyra_petsc.verification.bench import Bench, data
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Converges

DATA = data("catenary")["unequal_heights"]
WEIGHT = 2e-6
"""of c11: the strip stretches by no more than that"""


def middle(a: float, lowest: float) -> tuple[float, float]:
    """Where half the length of a catenary has been run through from its left end [both over L].

    ``a`` and ``lowest`` are its parameter and the abscissa of its lowest point.
    """
    x = lowest + a * math.asinh(0.5 / a - math.sinh(lowest / a))
    return x, a * (math.cosh((x - lowest) / a) - math.cosh(lowest / a))


def _measure(bench: Bench, n: float) -> Iterator[Measured]:
    for dx, dz, a, lowest, _, _ in DATA["rows"]:
        with bench.simulation(hung(bench, int(n), WEIGHT, dx * LENGTH, dz * LENGTH)) as trial:
            x = trial.run().x[int(n) // 2]
        exact = middle(a, lowest)
        supports = f"right support {dx:g} L away, {dz:g} L up"
        yield Measured(f"x of the middle, {supports}", float(x[0]), exact[0] * LENGTH, "m")
        yield Measured(f"z of the middle, {supports}", float(x[2]), exact[1] * LENGTH, "m")


CASE = Case(
    name="catenary-unequal",
    title="A stiff strip hung at two heights, static: its middle against the inextensible catenary",
    source="closed form",
    resolutions=(8, 16, 32, 64),
    measure=_measure,
    claim=Converges(2.0, 1e-3),
    counts="cells along the strip",
)
