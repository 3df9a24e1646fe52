"""Everything at once: stiffness × Δt × bending × density."""

from __future__ import annotations

from collections.abc import Iterator

from lyra_petsc.stress.case import Case, Family, Level
from lyra_petsc.stress.changes import changed, scale

STIFFNESSES = ("1", "1e3", "1e6", "1e9")
STEPS = ("1e-4", "5e-3", "4e-2", "1")
BENDINGS = ("0", "1", "1e3", "1e6")
DENSITIES = ("1e-3", "1", "1e3")


def _cases() -> Iterator[Case]:
    for stiffness in STIFFNESSES:
        for step in STEPS:
            for bending in BENDINGS:
                for density in DENSITIES:
                    yield Case(
                        f"all-{stiffness}-{step}-{bending}-{density}",
                        f"membrane × {stiffness}, Δt {step} s, bending × {bending}, density × {density}",
                        changed(
                            scale,
                            stretching=float(stiffness),
                            bending=float(bending),
                            density=float(density),
                        ),
                        steps=5,
                        step=float(step),
                        level=Level.FULL,
                    )


FAMILY = Family("products", "stiffness × Δt × bending × density", list(_cases()))
