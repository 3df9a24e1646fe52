"""A thousand times the weight."""

from __future__ import annotations

from lyra_petsc.stress.case import Case, Content, Family, Level, NotHere, Setting
from lyra_petsc.verification.bench import Bench

FACTOR = 1000.0


def _heavy(setting: Setting, bench: Bench) -> Content:
    content = setting.content()
    if not any(content.get("gravity") or ()):
        raise NotHere("has no gravity to be multiplied")
    content["gravity"] = [FACTOR * g for g in content["gravity"]]
    return content


FAMILY = Family(
    "gravity", "gravity × 1000", [Case("gravity-1000", "gravity × 1000", _heavy, level=Level.QUICK)]
)
