"""Sheets that nothing holds."""

from __future__ import annotations

from lyra_petsc.stress.case import Case, Content, Family, Level, Setting
from lyra_petsc.stress.changes import changed, free
from lyra_petsc.verification.bench import Bench

SPIN = [3.0, 20.0, 1.0]
"""rad/s"""


def _tumbling(setting: Setting, bench: Bench) -> Content:
    content = free(setting.content())
    initial = content.get("initial") or {}
    content["initial"] = {**initial, "angular_velocity": SPIN}
    return content


FAMILY = Family(
    "free",
    "no handle: falling, and tumbling",
    [
        Case("falling", "no handle, released at rest", changed(free), level=Level.QUICK),
        Case("tumbling", "no handle, thrown with 20 rad/s", _tumbling),
    ],
)
