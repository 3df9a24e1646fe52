"""Everything at once: stiffness × Δt × bending × density, without a scene of the user on a coarser sheet."""

from __future__ import annotations

from collections.abc import Iterator

from lyra_petsc.stress.base import CELLS, sheet
from lyra_petsc.stress.case import Case, Content, Family, Level, Maker, Setting
from lyra_petsc.stress.changes import scale
from lyra_petsc.verification.bench import Bench

STIFFNESSES = ("1", "1e3", "1e6", "1e9")
STEPS = ("1e-4", "5e-3", "4e-2", "1")
BENDINGS = ("0", "1", "1e3", "1e6")
DENSITIES = ("1e-3", "1", "1e3")


def _scaled(stiffness: str, bending: str, density: str) -> Maker:
    def scene(setting: Setting, bench: Bench) -> Content:
        content = setting.content()
        if not setting.given:
            content |= {key: sheet(CELLS[Level.QUICK])[key] for key in ("mesh", "handles")}
        return scale(content, stretching=float(stiffness), bending=float(bending), density=float(density))

    return scene


def _cases() -> Iterator[Case]:
    for stiffness in STIFFNESSES:
        for step in STEPS:
            for bending in BENDINGS:
                for density in DENSITIES:
                    yield Case(
                        f"all-{stiffness}-{step}-{bending}-{density}",
                        f"membrane × {stiffness}, Δt {step} s, bending × {bending}, density × {density}",
                        _scaled(stiffness, bending, density),
                        steps=5,
                        step=float(step),
                        level=Level.FULL,
                    )


FAMILY = Family("products", "stiffness × Δt × bending × density", list(_cases()))
