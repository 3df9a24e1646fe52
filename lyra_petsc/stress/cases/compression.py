"""Compression of a membrane that cannot buckle, beyond where its model softens."""

from __future__ import annotations

from collections.abc import Mapping

from lyra_petsc.stress.case import Case, Content, Family, Level, Setting
from lyra_petsc.stress.changes import move
from lyra_petsc.stress.record import Record
from lyra_petsc.terms.stretch import SOFTENS_BELOW
from lyra_petsc.verification.bench import Bench
from lyra_petsc.verification.claims import Verdict

TO = 0.4
"""Of the width, well below 1/√3."""

STEPS = 40


def _pressed(setting: Setting, bench: Bench) -> Content:
    content = setting.content() | {"handles": [{"group": "left"}, {"group": "right"}]}
    move(content, [{"time": 0.0}, {"time": STEPS * setting.step, "scale": [TO, 1.0, 1.0]}])
    # a plane that the sheet cannot leave
    content["handles"].append({"group": "sheet", "axes": ["z"]})
    return content


def _reached(setting: Setting, bench: Bench, record: Record) -> Mapping[str, Verdict]:
    smallest = record.stretches[0]
    return {"compressed": Verdict(smallest < SOFTENS_BELOW, f"to {smallest:.3f} of its length")}


FAMILY = Family(
    "compression",
    "a membrane pressed in its plane beyond a stretch of 1/√3",
    [
        Case(
            "pressed", "pressed in its plane to 0.4 of its width", _pressed, steps=STEPS, own=True,
            judge=_reached, level=Level.QUICK,
        )
    ],
)  # fmt: skip
