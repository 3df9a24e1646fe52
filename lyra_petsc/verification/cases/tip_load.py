"""Clamped strips with a dead load at the tip."""

from __future__ import annotations

from collections.abc import Sequence

from lyra_petsc.verification.bench import Bench
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.cases.hinge_strip import expected
from lyra_petsc.verification.elastica import cantilever
from lyra_petsc.verification.strips import MEMBRANE, AtFinest, compared, strip

PATTERNS = ("alternating", "criss-cross")
LOADS = (0.25, 1.0, 4.0, 10.0, 50.0)
"""α = P L² / B_effective, P per width"""


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    found: list[Measured] = []
    for pattern in PATTERNS:
        stiffness = expected(pattern)
        for load in LOADS:
            # the scene's force is the total over the strip's width of one cell
            scene = strip(pattern, n, loads=[{"group": "right", "force": [0, 0, -load * stiffness / n]}])
            with bench.simulation(scene) as trial:
                exact = cantilever(0.0, tip_load=load, stretch=stiffness / MEMBRANE)
                found += compared(trial.run(), n, exact, f"{pattern}, α = {load:g}")
    return found


CASE = Case(
    name="tip-load",
    title=(
        "Clamped strip with a load at the tip, α = P L²/B_effective: tip against the elastica with the "
        "strip's stretch; error over the way of the tip"
    ),
    source=(
        "elastica by collocation; K. E. Bisshopp and D. C. Drucker, Quart. Appl. Math. 3 (1945) 272-275, "
        "with T = C (λ³ − λ)/2 for the stretch"
    ),
    resolutions=(16, 32, 64),
    measure=_measure,
    claim=AtFinest(2e-3),
    quick=1,
    counts="cells along the strip",
)
