"""Clamped strips that roll up into an arc because their rest shape is one."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lyra_petsc.verification.bench import Bench
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Claim, Converges, Exact
from lyra_petsc.verification.elastica import Cantilever
from lyra_petsc.verification.strips import AtFinest, compared, strip

TURNS = {"diagonal": (0.25, 1.0), "alternating": (0.25, 0.5), "criss-cross": (0.25, 0.5)}
"""Parts of a full circle for each pattern of mesh."""


MEMBRANE = 1e4
"""C L²/B: without tension or weight it stretches nothing, and a softer one is found sooner."""


def arc(turns: float) -> Cantilever:
    """Tip of an arc of length 1 that starts horizontally and bends downwards."""
    angle = 2.0 * math.pi * turns
    return Cantilever(math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle, angle, angle)


def _words(pattern: str, turns: float) -> str:
    return f"{pattern}, {turns:g} of a circle"


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    found: list[Measured] = []
    for pattern, parts in TURNS.items():
        for turns in parts:
            curved = {"rest_curvature": [-2.0 * math.pi * turns, 0.0, 0.0]}
            with bench.simulation(strip(pattern, n, MEMBRANE, material=curved)) as trial:
                found += compared(trial.run(), n, arc(turns), _words(pattern, turns))
    return found


def _claims() -> dict[str, Claim]:
    claims: dict[str, Claim] = {}
    for turns in TURNS["criss-cross"]:
        # the arc dimples every cell, which its membrane resists: not free of energy
        claims |= {
            f"{side} / L, {_words('criss-cross', turns)}": AtFinest(5e-3) for side in ("drop", "reach")
        }
    # there the polygon that the cells make ends where the arc does
    for exact in ("reach / L, " + _words("alternating", 0.5), "drop / L, " + _words("diagonal", 1.0)):
        claims[exact] = Exact(1e-6)
    claims["reach / L, " + _words("diagonal", 1.0)] = Exact(1e-6)
    return claims


CASE = Case(
    name="roll-up",
    title=(
        "Clamped strip that its rest curvature rolls up: tip against the arc; error over the way of the tip"
    ),
    source="closed form; the shape of K. Y. Sze, X. H. Liu, S. H. Lo, Finite Elem. Anal. Des. 40 (2004) 1551",
    resolutions=(16, 32, 64),
    measure=_measure,
    claim=Converges(2.0, 1e-4),
    claims=_claims(),
    quick=1,
    counts="cells along the strip",
)
