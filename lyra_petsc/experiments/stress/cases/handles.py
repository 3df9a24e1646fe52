"""Handles that do what no hand does."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.stress.case import QUICK, Case, Content, Setting, family
from lyra_petsc.experiments.stress.changes import move
from lyra_petsc.experiments.stress.record import Record
from lyra_petsc.terms.stretch import SOFTENS_BELOW

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


def _pull(setting: Setting, bench: Bench, to: float) -> Content:
    """Scale the handles' places along x; without a scene of the user, both sides are held."""
    content = setting.content()
    if not setting.given:
        content["handles"] = [dict(side) for side in SIDES]
    end = 0.75 * STEPS * setting.step
    return move(content, [{"time": 0.0}, {"time": end, "scale": [to, 1.0, 1.0]}])


handles = family(
    "handles",
    "handles that jump, spin, squeeze and stretch",
    Case("jump", "handles jump by a quarter of the sheet in one step", _jump, level=QUICK),
    Case("spin", "handles turn ten times a second", _spin, steps=STEPS),
    Case("squeeze", "handles come together to a tenth", partial(_pull, to=0.1), steps=STEPS),
    Case("stretch", "handles go apart threefold", partial(_pull, to=3.0), steps=STEPS, level=QUICK),
)

# -- a membrane that cannot buckle, pressed beyond where its model softens -------------------------------

TO = 0.4
"""Of the width, well below 1/√3."""


def _pressed(setting: Setting, bench: Bench) -> Content:
    content = setting.content() | {"handles": [dict(side) for side in SIDES]}
    move(content, [{"time": 0.0}, {"time": STEPS * setting.step, "scale": [TO, 1.0, 1.0]}])
    # a plane that the sheet cannot leave
    content["handles"].append({"group": "sheet", "axes": ["z"]})
    return content


def _reached(setting: Setting, bench: Bench, record: Record) -> Mapping[str, Verdict]:
    smallest = record.stretches[0]
    return {"compressed": Verdict(smallest < SOFTENS_BELOW, f"to {smallest:.3f} of its length")}


compression = family(
    "compression",
    "a membrane pressed in its plane beyond a stretch of 1/√3",
    Case(
        "pressed", "pressed in its plane to 0.4 of its width", _pressed, steps=STEPS, own=True,
        judge=_reached, level=QUICK,
    ),
)  # fmt: skip
