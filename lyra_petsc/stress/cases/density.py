"""Sheets from a thousandth of their weight to a thousand times it."""

from __future__ import annotations

from lyra_petsc.stress.case import Case, Family, Level
from lyra_petsc.stress.changes import changed, scale

FAMILY = Family(
    "density",
    "density × 1e-3 to 1e3",
    [
        Case(f"density-{factor}", f"density × {factor}", changed(scale, density=float(factor)), level=level)
        for factor, level in (
            ("1e-3", Level.QUICK),
            ("1e-2", Level.FULL),
            ("1e-1", Level.FULL),
            ("1e1", Level.FULL),
            ("1e2", Level.FULL),
            ("1e3", Level.USUAL),
        )
    ],
)
