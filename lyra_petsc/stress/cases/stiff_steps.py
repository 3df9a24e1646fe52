"""The goal: stiff sheets at steps of milliseconds and tens of milliseconds, solved in few iterations."""

from __future__ import annotations

from lyra_petsc.stress.case import Case, Content, Family, Level, Maker, Setting
from lyra_petsc.stress.changes import scale
from lyra_petsc.verification.bench import Bench

STIFFNESSES = (1e3, 1e6)
STEPS = (0.005, 0.04)
"""s"""


def _stiffer(factor: float) -> Maker:
    def scene(setting: Setting, bench: Bench) -> Content:
        return scale(setting.content(), stretching=factor)

    return scene


FAMILY = Family(
    "stiff-steps",
    "Membrane stiffness and Δt together: at most 10 Newton iterations in the median and 30 at worst, "
    "5 times the base's wall time per step",
    [
        Case(
            f"stiff-{factor:.0e}-step-{step * 1e3:g}ms".replace("e+0", "e"),
            f"membrane × {factor:g}, Δt {step * 1e3:g} ms",
            _stiffer(factor),
            steps=20,
            step=step,
            level=Level.QUICK,
            swift=True,
        )
        for factor in STIFFNESSES
        for step in STEPS
    ],
)
