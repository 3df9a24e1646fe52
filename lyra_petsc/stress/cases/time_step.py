"""Steps from a hundredth of a millisecond to a second."""

from __future__ import annotations

from lyra_petsc.stress.case import Case, Family, Level
from lyra_petsc.stress.changes import as_it_is

FAMILY = Family(
    "time-step",
    "Δt from 1e-5 s to 1 s",
    [
        Case(f"step-{step}", f"Δt {step} s", as_it_is, steps=steps, step=float(step), level=level)
        for step, steps, level in (
            ("1e-5", 30, Level.QUICK),
            ("1e-4", 30, Level.USUAL),
            ("1e-3", 30, Level.USUAL),
            ("1e-2", 20, Level.USUAL),
            ("1e-1", 10, Level.USUAL),
            ("1", 5, Level.QUICK),
        )
    ],
)
