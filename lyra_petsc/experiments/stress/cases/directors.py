"""Sheets that bend by directors on edges: stiff, at large steps, folded, twisted, crushed, crumpled."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.stress.cases.shapes_and_handles import spinning
from lyra_petsc.experiments.stress.stress_scenes import (
    FULL,
    QUICK,
    STEP,
    Content,
    Setting,
    StressCase,
    blow,
    by_directors,
    changed,
    family,
    move,
    release,
    scale,
)
from lyra_petsc.experiments.verification.answers import grid

Array = NDArray[np.float64]

FOLD = np.radians(179.0)
"""Of a crease."""

PART, CRUMPLED = 0.02, 0.3
"""Of the length of a crushed strip, and of a crumpled sheet's width, what is left."""

STEPS, FEW, LONG = 80, 20, 0.02
"""Numbers of steps, and Δt [s] of the few."""


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


def _spun(setting: Setting, bench: Bench) -> Content:
    return by_directors(spinning(setting, bench))


def _strip(
    setting: Setting,
    bench: Bench,
    frames: list[dict[str, Any]],
    stiffer: bool,
    integrator: str = "beuler",
) -> Content:
    """A strip of the base scene's sheet, or a stiffer one, clamped at both ends, one of which moves."""
    content = by_directors(setting.content())
    if stiffer:
        content = scale(content, stretching=8.0, bending=10.0)
    content["mesh"] = grid(1.0, 0.3, 40, 12, "alternating") | {"transform": {"translate": [0.0, -0.15, 0.0]}}
    content["time"] = {**content["time"], "integrator": integrator}
    content["handles"] = [{"group": "right", "clamp": True}]
    content = move(content, frames)
    content["handles"].append({"group": "left", "clamp": True})
    return content


def _crumpled(setting: Setting, bench: Bench) -> Content:
    """The sheet, whose four sides come together."""
    content = by_directors(setting.content())
    content["handles"] = [{"group": side} for side in ("left", "right", "bottom", "top")]
    return move(content, [{"time": 0.0}, {"time": STEPS * STEP, "scale": [CRUMPLED, CRUMPLED, 1.0]}])


def _twist(degrees: float, seconds: float, parts: int) -> list[dict[str, Any]]:
    """Keyframes."""
    return [
        {
            "time": seconds * k / parts,
            "rotate": {"axis": [1.0, 0.0, 0.0], "degrees": degrees * k / parts},
        }
        for k in range(parts + 1)
    ]


CRUSH: list[dict[str, Any]] = [{"time": 0.0}, {"time": STEPS * STEP, "scale": [PART, 1.0, 1.0]}]

directors = family(
    "directors",
    "bending_model: midedge",
    StressCase("directors-plain", "as it is", changed(by_directors), level=QUICK),
    *(
        StressCase(
            f"directors-1e6-{ms}ms", f"membrane × 1e6, Δt {ms} ms", partial(_changed, scale, stretching=1e6),
            step=1e-3 * ms,
        )
        for ms in (5, 40)
    ),
    StressCase("directors-bending-1e6", "bending × 1e6", partial(_changed, scale, bending=1e6)),
    StressCase("directors-wind-200", "wind 200 m/s", partial(_changed, blow, speed=200.0)),
    StressCase("directors-spin", "handles turn ten times a second", _spun, steps=FEW, level=FULL),
    StressCase("directors-folded", "a crease of 179°, no handle", partial(_changed, release), shape=_folded),
    StressCase(
        "directors-twist", "a stiff strip twisted by 720°", steps=STEPS, own=True,
        scene=partial(_strip, frames=_twist(720.0, STEPS * STEP, 16), stiffer=True),
    ),
    StressCase(
        "directors-twist-20ms", "a soft strip twisted by 1080°, Δt 20 ms", steps=FEW, step=LONG, own=True,
        scene=partial(_strip, frames=_twist(1080.0, FEW * LONG, FEW), stiffer=False),
    ),
    StressCase(
        "directors-twist-bdf2", "the same with bdf2", steps=FEW, step=LONG, own=True,
        scene=partial(_strip, frames=_twist(1080.0, FEW * LONG, FEW), stiffer=False, integrator="bdf2"),
    ),
    StressCase(
        "directors-crush", "a stiff strip crushed to 2 %", steps=STEPS, own=True,
        scene=partial(_strip, frames=CRUSH, stiffer=True),
    ),
    StressCase("directors-crumpled", "all sides come together to 0.3", _crumpled, steps=STEPS, own=True),
)  # fmt: skip
