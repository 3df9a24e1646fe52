"""The goal: stiff sheets at steps of milliseconds and tens of milliseconds, solved in few iterations."""

from __future__ import annotations

from lyra_petsc.stress.case import Case, Family, Level
from lyra_petsc.stress.changes import changed, scale

FAMILY = Family(
    "stiff-steps",
    "membrane stiffness and Δt together, with bounds on iterations and wall time",
    [
        Case(
            f"stiff-{exponent}-{ms}ms",
            f"membrane × {exponent}, Δt {ms} ms",
            changed(scale, stretching=float(exponent)),
            step=1e-3 * ms,
            level=Level.QUICK,
            swift=True,
        )
        for exponent in ("1e3", "1e6")
        for ms in (5, 40)
    ],
)
