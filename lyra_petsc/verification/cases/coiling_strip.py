"""Clamped strips on a mesh of single diagonals under their own weight: they twist as they bend."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from lyra_petsc.parallel import on_root
from lyra_petsc.verification.bench import Bench
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.coupled_strip import heavy_coupled_strip
from lyra_petsc.verification.strips import DENSITY, AtFinest, strip

WEIGHTS = (0.1, 1.0, 10.0, 100.0)
"""w L³ / (0.8 B)"""

MEMBRANE = 1e7
"""C L²/B: high enough that a strip as narrow as 1/64 hardly bends in its own plane."""


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    found: list[Measured] = []
    for weight in WEIGHTS:
        nominal = 0.8 * weight
        scene = strip("diagonal", n, MEMBRANE, gravity=[0, 0, -nominal / DENSITY])
        with bench.simulation(scene) as trial:
            x, y, z = trial.run().x[[round(n), 2 * round(n) + 1]].mean(axis=0)
        exact = on_root(bench.comm, partial(heavy_coupled_strip, nominal, 1.0 / MEMBRANE))
        assert exact is not None
        reach, sideways, drop = exact
        way = float(np.hypot(1.0 - reach, np.hypot(sideways, drop)))
        words = f"Γ = {weight:g}"
        found += [
            Measured(f"drop / L, {words}", float(-z), drop, scale=way),
            Measured(f"reach / L, {words}", float(x), reach, scale=way),
            Measured(f"sideways / L, {words}", float(y) - 0.5 / n, sideways, scale=way),
        ]
    return found


CASE = Case(
    name="coiling-strip",
    title=(
        "Clamped strip of single diagonals under its own weight, Γ = w L³/(0.8 B): tip against the rod whose "
        "bending twists it; error over the way of the tip"
    ),
    source="Kirchhoff rod with bend-twist coupling, its stiffness by hand from the hinges of a cell",
    resolutions=(16, 32, 64),
    measure=_measure,
    claim=AtFinest(2e-3),
    quick=1,
    counts="cells along the strip",
)
