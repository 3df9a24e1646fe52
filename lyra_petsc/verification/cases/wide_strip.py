"""Strips several cells wide: the clamp keeps them from curving across, which hinges want to."""

from __future__ import annotations

from collections.abc import Sequence

from lyra_petsc.verification.bench import Bench
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.cases.hinge_strip import PATTERNS, expected
from lyra_petsc.verification.claims import Converges
from lyra_petsc.verification.flat_sheet import stiffness
from lyra_petsc.verification.strips import DENSITY, strip

ACROSS = (2, 4)
"""Square cells across the strip."""


def _words(pattern: str, across: int) -> str:
    return f"deflection over that with B_effective, {pattern}, {across} cells wide"


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    found = []
    along = round(n)
    for across in ACROSS:
        for pattern in PATTERNS:
            scene = strip(pattern, n)
            scene["mesh"] = {
                "grid": scene["mesh"]["grid"] | {"height": across / along, "ny": across},
            }
            with bench.simulation(scene) as trial:
                operator, mass = stiffness(trial), trial.mass
            height = operator.solve(mass / DENSITY)
            tips = [row * (along + 1) + along for row in range(across + 1)]
            beam = 1.0 / (8.0 * expected(pattern))
            found.append(Measured(_words(pattern, across), float(height[tips].mean() / beam), 1.0))
    return found


CASE = Case(
    name="wide-strip",
    title=(
        "Clamped strips 2 and 4 square cells wide under a small uniform load: mean deflection of the end "
        "against the beam's with B_effective"
    ),
    source="Euler-Bernoulli beam, closed form: w = q L⁴/(8 B)",
    resolutions=(32, 64, 128),
    measure=_measure,
    # near the clamp, over about the strip's width, curvature across is missing
    claim=Converges(1.0, 1.3e-2),
    claims={_words("alternating", 2): Converges(2.0, 1e-4)},
    counts="cells along the strip",
)
