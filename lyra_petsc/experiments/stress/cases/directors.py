"""Sheets that bend by directors on edges: stiff, at large steps, folded, twisted, crushed."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.stress.stress_scenes import (
    QUICK,
    STEP,
    Content,
    Setting,
    StressCase,
    by_directors,
    changed,
    family,
    move,
    release,
    scale,
)
from lyra_petsc.experiments.verification.answers import grid

Array = NDArray[np.float64]

FOLD = np.radians(177.0)
"""Of a crease; from 178° on a start is refused."""

TURNS, PART = 2.0, 0.02
"""Of a twist, and of the length that is left of a crushed strip."""

STEPS = 80


def _changed(change: Callable[..., Content], setting: Setting, bench: Bench, **numbers: float) -> Content:
    return change(by_directors(setting.content()), **numbers)


def _folded(x: Array, spacing: float) -> Array:
    """What is beyond a crease in the middle of x, turned about it until it nearly lies on the rest."""
    middle = 0.5 * (x[:, 0].min() + x[:, 0].max())
    crease = x[np.argmin(np.abs(x[:, 0] - middle)), 0]
    y = x.copy()
    beyond = y[:, 0] > crease
    way, height = y[beyond, 0] - crease, y[beyond, 2].copy()
    y[beyond, 0] = crease + np.cos(FOLD) * way - np.sin(FOLD) * height
    y[beyond, 2] = np.sin(FOLD) * way + np.cos(FOLD) * height
    return y


def _strip(setting: Setting, bench: Bench, frames: list[dict[str, Any]]) -> Content:
    """A strip clamped at both ends, one of which moves; stiffer than the base scene's sheet."""
    content = scale(by_directors(setting.content()), stretching=8.0, bending=10.0)
    content["mesh"] = grid(1.0, 0.3, 40, 12, "alternating") | {"transform": {"translate": [0.0, -0.15, 0.0]}}
    content["handles"] = [{"group": "right", "clamp": True}]
    content = move(content, frames)
    content["handles"].append({"group": "left", "clamp": True})
    return content


def _turned(part: float) -> dict[str, Any]:
    turn = {"axis": [1.0, 0.0, 0.0], "degrees": 360.0 * TURNS * part}
    return {"time": part * STEPS * STEP, "rotate": turn}


TWIST = [_turned(k / 16.0) for k in range(17)]
CRUSH: list[dict[str, Any]] = [{"time": 0.0}, {"time": STEPS * STEP, "scale": [PART, 1.0, 1.0]}]

directors = family(
    "directors",
    "bending_model: midedge",
    StressCase("directors", "as it is", changed(by_directors), level=QUICK),
    *(
        StressCase(
            f"directors-1e6-{ms}ms", f"membrane × 1e6, Δt {ms} ms", partial(_changed, scale, stretching=1e6),
            step=1e-3 * ms,
        )
        for ms in (5, 40)
    ),
    StressCase("directors-bending-1e6", "bending × 1e6", partial(_changed, scale, bending=1e6)),
    StressCase("directors-folded", "a crease of 177°, no handle", partial(_changed, release), shape=_folded),
    *(
        StressCase(f"directors-{name}", words, partial(_strip, frames=frames), steps=STEPS, own=True)
        for name, words, frames in (
            ("twist", "a strip twisted by 720°", TWIST),
            ("crush", "a strip crushed to 2 %", CRUSH),
        )
    ),
)  # fmt: skip
