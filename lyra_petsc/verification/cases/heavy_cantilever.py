"""Clamped strips that droop under their own weight: the cantilever test."""

from __future__ import annotations

from collections.abc import Sequence

from lyra_petsc.verification.bench import Bench
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.cases.hinge_strip import expected
from lyra_petsc.verification.elastica import cantilever
from lyra_petsc.verification.strips import DENSITY, MEMBRANE, AtFinest, compared, strip

PATTERNS = ("alternating", "criss-cross")
WEIGHTS = (0.1, 1.0, 10.0, 100.0, 1e3, 1e4)
"""Γ = w L³ / B_effective"""


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    found: list[Measured] = []
    for pattern in PATTERNS:
        stiffness = expected(pattern)
        for weight in WEIGHTS:
            scene = strip(pattern, n, gravity=[0, 0, -weight * stiffness / DENSITY])
            with bench.simulation(scene) as trial:
                exact = cantilever(weight, stretch=stiffness / MEMBRANE)
                found += compared(trial.run(), n, exact, f"{pattern}, Γ = {weight:g}")
    return found


CASE = Case(
    name="heavy-cantilever",
    title=(
        "Clamped strip under its own weight, Γ = w L³/B_effective: tip against the heavy elastica with the "
        "strip's stretch; error over the way of the tip"
    ),
    source=(
        "heavy elastica by collocation; test of Romero et al., ACM Trans. Graph. 40(4):66 (2021); with "
        "T = C (λ³ − λ)/2 for the stretch"
    ),
    resolutions=(16, 32, 64),
    measure=_measure,
    claim=AtFinest(2e-3),
    quick=1,
    counts="cells along the strip",
)
