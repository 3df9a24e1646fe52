"""Cantilever strips one cell wide, clamped at x = 0: their scenes, and what is compared of them.

Of length 1 m with B = 1 N·m; c12 = 0. One cell across keeps apart what a plate adds to a strip: wider
strips resist with their membrane against the lateral curvature that hinges give them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lyra_petsc.experiments.bench import Trial
from lyra_petsc.experiments.verification.case import Measured, isotropic
from lyra_petsc.experiments.verification.elastica import Cantilever

MEMBRANE = 1e6
"""C L²/B: as of a strip with a thickness of 0.0035 L. The exact shapes take its stretch into account."""

DENSITY = 1.0
"""kg/m²"""


def strip(pattern: str, n: float, membrane: float = MEMBRANE, **more: Any) -> dict[str, Any]:
    """A scene: n square cells along the strip, its end clamped, static.

    ``more`` are further keys of the scene; ``material`` is added to.
    """
    along = round(n)
    material = {"density": DENSITY, "membrane": isotropic(membrane), "bending": 1.0}
    return {
        "mesh": {"grid": {"width": 1.0, "height": 1.0 / along, "nx": along, "ny": 1, "pattern": pattern}},
        "material": material | more.pop("material", {}),
        "handles": [{"group": "left", "clamp": True}],
        "time": {"analysis": "static"},
        **more,
    }


def tip(trial: Trial, n: float) -> tuple[float, float]:
    """Mean (x, −z) of the two vertices of the free end over L: reach and drop."""
    along = round(n)
    x, _, z = trial.x[[along, 2 * along + 1]].mean(axis=0)
    return float(x), float(-z)


def compared(trial: Trial, n: float, exact: Cantilever, words: str) -> Sequence[Measured]:
    """Drop and reach of the tip, both errors relative to the way the tip went."""
    reach, drop = tip(trial, n)
    way = float(np.hypot(exact.drop, 1.0 - exact.reach))
    return [
        Measured(f"drop / L, {words}", drop, exact.drop, scale=way),
        Measured(f"reach / L, {words}", reach, exact.reach, scale=way),
    ]
