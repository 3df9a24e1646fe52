"""Gales, and a thousand times the weight."""

from __future__ import annotations

from lyra_petsc.experiments.stress.case import QUICK, Case, family
from lyra_petsc.experiments.stress.changes import blow, changed, weigh

wind = family(
    "wind",
    "wind of 50 and 200 m/s",
    Case("wind-50", "wind 50 m/s", changed(blow, speed=50.0)),
    Case("wind-200", "wind 200 m/s", changed(blow, speed=200.0), level=QUICK),
)

gravity = family(
    "gravity",
    "gravity × 1000",
    Case("gravity-1000", "gravity × 1000", changed(weigh, factor=1000.0), level=QUICK),
)
