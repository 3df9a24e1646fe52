"""Membranes from a thousandth of the scene's stiffness to a thousand million times it."""

from __future__ import annotations

from lyra_petsc.stress.case import Case, Family, Level
from lyra_petsc.stress.changes import changed, scale

FAMILY = Family(
    "membrane",
    "membrane stiffness × 1e-3 to 1e9",
    [
        Case(
            f"membrane-{factor}",
            f"membrane × {factor}",
            changed(scale, stretching=float(factor)),
            level=level,
        )
        for factor, level in (
            ("1e-3", Level.QUICK),
            ("1", Level.USUAL),
            ("1e3", Level.USUAL),
            ("1e6", Level.USUAL),
            ("1e9", Level.QUICK),
        )
    ],
)
