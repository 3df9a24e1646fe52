"""The cloth maker's cantilever test: a cloth of known bending length droops to the standard angle."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lyra_petsc.verification.bench import Bench
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.cases.hinge_strip import expected
from lyra_petsc.verification.elastica import overhang_weight
from lyra_petsc.verification.strips import MEMBRANE, AtFinest, strip, tip

PATTERNS = ("alternating", "criss-cross")
ANGLES = (7.1, 41.5, 45.0)
"""Of the chord from the clamp to the tip, degrees below the horizontal; 41.5 is the standard's."""

BENDING_LENGTH = 0.02
"""c [m]; the cloth's flexural rigidity is w c³ with its weight w [N/m²]."""

DENSITY = 0.15
"""kg/m²"""
GRAVITY = 9.81
"""m/s²"""


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    found = []
    rigidity = DENSITY * GRAVITY * BENDING_LENGTH**3
    for pattern in PATTERNS:
        for angle in ANGLES:
            overhang = BENDING_LENGTH * overhang_weight(angle) ** (1.0 / 3.0)
            stretching = MEMBRANE * rigidity / overhang**2
            material = {
                "density": DENSITY,
                "membrane": {"c11": stretching, "c22": stretching, "c12": 0.0, "c33": 0.5 * stretching},
                # what the mesh makes of B is known, hence corrected
                "bending": rigidity / expected(pattern),
            }
            scene = strip(pattern, n, material=material, gravity=[0, 0, -GRAVITY])
            grid = scene["mesh"]["grid"]
            scene["mesh"] = {"grid": grid | {"width": overhang, "height": overhang / round(n)}}
            with bench.simulation(scene) as trial:
                reach, drop = tip(trial.run(), n)
            reached = math.degrees(math.atan2(drop, reach))
            found.append(
                Measured(f"angle of the chord, {pattern}, overhang for {angle:g}°", reached, angle, "°")
            )
    return found


CASE = Case(
    name="cloth-overhang",
    title=(
        "Cantilever test of cloth: with B = w c³, corrected for the mesh, the chord must reach the angle "
        "that belongs to the overhang (41.5° at 2.0003 c)"
    ),
    source="ASTM D1388, option A, and ISO 9073-7 (angle, G = w c³); overhangs from the exact heavy elastica",
    resolutions=(16, 32, 64),
    measure=_measure,
    claim=AtFinest(2e-3),
    quick=1,
    counts="cells along the strip",
)
