"""Effective bending stiffness of free-edged strips of hinges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lyra_petsc.verification.bench import Bench
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Exact
from lyra_petsc.verification.flat_sheet import hinge_blocks
from lyra_petsc.verification.periodic_cell import strip_stiffness

PATTERNS = ("diagonal", "alternating", "criss-cross")
RATIOS = {"square cells": 1.0, "cells twice as long as wide": 0.5, "cells twice as wide as long": 2.0}
"""Width of a cell over its length along the strip."""


def expected(pattern: str, ratio: float = 1.0) -> float:
    """B_effective / B of a strip with free edges, by hand from the hinges of one cell.

    Single diagonals and alternating: (1 + r²)² / ((1 + r²)² + r⁴); criss-cross:
    2 / (1 + 4 r⁴ / (1 + r²)²), r the width of a cell over its length.
    """
    square = (1.0 + ratio**2) ** 2
    if pattern == "criss-cross":
        return 2.0 / (1.0 + 4.0 * ratio**4 / square)
    return square / (square + ratio**4)


def _scene(pattern: str, across: int, ratio: float) -> dict[str, Any]:
    return {
        "mesh": {"grid": {"width": 6.0, "height": across * ratio, "nx": 6, "ny": across, "pattern": pattern}},
        "material": {"density": 1.0, "membrane": {"c11": 1, "c22": 1, "c12": 0, "c33": 0.5}, "bending": 1.0},
        "time": {"end": 1.0, "step": 1.0},
    }


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    found = []
    for words, ratio in RATIOS.items():
        for pattern in PATTERNS:
            with bench.simulation(_scene(pattern, round(n), ratio)) as trial:
                hinges, points = hinge_blocks(trial), trial.x[:, :2]
            stiffness = strip_stiffness(hinges, points, start=2.0, period=2.0, width=n * ratio)
            found.append(
                Measured(f"B_effective / B, {pattern}, {words}", stiffness, expected(pattern, ratio))
            )
    return found


CASE = Case(
    name="hinge-strip",
    title="Bending stiffness of a strip with free edges over B, on each pattern of mesh",
    source=(
        "closed form from the hinges of one cell (lateral curvature, twist and vertex heights relaxed); for "
        "square cells 4.8 k and 6 k with k = B/6 by an independent program too"
    ),
    resolutions=(1, 2, 3, 4, 8, 16),
    measure=_measure,
    claim=Exact(1e-10),
    counts="cells across the strip",
)
