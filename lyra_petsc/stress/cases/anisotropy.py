"""Sheets that are stiff along one thread and soft along the other."""

from __future__ import annotations

from lyra_petsc.stress.case import Case, Family, Level
from lyra_petsc.stress.changes import anisotropic, changed

FAMILY = Family(
    "anisotropy",
    "c11/c22 = 1e4, their mean staying",
    [
        Case("stiff-warp", "c11/c22 = 1e4", changed(anisotropic, ratio=1e4), level=Level.QUICK),
        Case("stiff-weft", "c11/c22 = 1e-4", changed(anisotropic, ratio=1e-4)),
    ],
)
