"""Gales."""

from __future__ import annotations

from lyra_petsc.stress.case import Case, Family, Level
from lyra_petsc.stress.changes import blow, changed

FAMILY = Family(
    "wind",
    "wind of 50 and 200 m/s",
    [
        Case("wind-50", "wind 50 m/s", changed(blow, speed=50.0)),
        Case("wind-200", "wind 200 m/s", changed(blow, speed=200.0), level=Level.QUICK),
    ],
)
