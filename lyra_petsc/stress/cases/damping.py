"""No damping, and so much that the sheet creeps."""

from __future__ import annotations

from lyra_petsc.stress.case import Case, Family, Level
from lyra_petsc.stress.changes import changed, damp

FAMILY = Family(
    "damping",
    "γ 0 and 10 s",
    [
        Case("damping-0", "no damping", changed(damp, seconds=0.0)),
        Case("damping-10s", "damping γ = 10 s", changed(damp, seconds=10.0), level=Level.QUICK),
    ],
)
