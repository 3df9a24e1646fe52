"""Handles that do what no hand does."""

from __future__ import annotations

from lyra_petsc.stress.case import Case, Content, Family, Level, Setting
from lyra_petsc.stress.changes import move
from lyra_petsc.verification.bench import Bench

JUMP = (0.15, 0.1, 0.2)
"""Over the size of the sheet."""

TURNS = 10.0
"""1/s"""

SIDES = [{"group": "left"}, {"group": "right"}]
STEPS = 40


def _jump(setting: Setting, bench: Bench) -> Content:
    far = [part * setting.size for part in JUMP]
    still = {"time": 2.0 * setting.step}
    return move(setting.content(), [{"time": 0.0}, still, {"time": 3.0 * setting.step, "translate": far}])


def _spin(setting: Setting, bench: Bench) -> Content:
    quarters = int(4.0 * TURNS * STEPS * setting.step) + 2
    turn = [
        {"time": k / (4.0 * TURNS), "rotate": {"axis": [0.0, 0.0, 1.0], "degrees": 90.0 * k}}
        for k in range(quarters)
    ]
    return move(setting.content(), turn)


def _pull(setting: Setting, to: float) -> Content:
    """Scale the handles' places along x; without a scene of the user, both sides are held."""
    content = setting.content()
    if not setting.given:
        content["handles"] = [dict(side) for side in SIDES]
    end = 0.75 * STEPS * setting.step
    return move(content, [{"time": 0.0}, {"time": end, "scale": [to, 1.0, 1.0]}])


def _squeeze(setting: Setting, bench: Bench) -> Content:
    return _pull(setting, 0.1)


def _stretch(setting: Setting, bench: Bench) -> Content:
    return _pull(setting, 3.0)


FAMILY = Family(
    "handles",
    "handles that jump, spin, squeeze and stretch",
    [
        Case("jump", "handles jump by a quarter of the sheet in one step", _jump, level=Level.QUICK),
        Case("spin", "handles turn ten times a second", _spin, steps=STEPS),
        Case("squeeze", "handles come together to a tenth", _squeeze, steps=STEPS),
        Case("stretch", "handles go apart threefold", _stretch, steps=STEPS, level=Level.QUICK),
    ],
)
