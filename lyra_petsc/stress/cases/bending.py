"""Bending from none to a million times the scene's."""

from __future__ import annotations

from lyra_petsc.stress.case import Case, Family, Level
from lyra_petsc.stress.changes import changed, scale

FAMILY = Family(
    "bending",
    "bending stiffness × 0 to 1e6",
    [
        Case(f"bending-{factor}", f"bending × {factor}", changed(scale, bending=float(factor)), level=level)
        for factor, level in (
            ("0", Level.QUICK),
            ("1", Level.FULL),
            ("1e3", Level.USUAL),
            ("1e6", Level.QUICK),
        )
    ],
)
