"""A sheet stiff in membrane and bending falls like the rigid plate it is.

A uniform plate of length L, hinged at one edge and released horizontal, passes the vertical after
√(2 L/3 g) K(1/√2), K(1/√2) = 1.8541: 0.4836 s for 1 m and 9.8 m/s².
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import cast

import numpy as np

from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.stress.step_balance import Record
from lyra_petsc.experiments.stress.stress_scenes import (
    FULL,
    QUICK,
    USUAL,
    Content,
    Scope,
    Setting,
    StressCase,
    family,
)
from lyra_petsc.experiments.verification.answers import grid, isotropic, scene

LENGTH, G, DENSITY, CELLS = 1.0, 9.8, 0.15, 16
"""m, m/s², kg/m², cells along a side"""

QUARTER = 1.8540746773013719 * math.sqrt(2.0 * LENGTH / (3.0 * G))
"""s"""

BOUND, EARLY = 0.005, 0.25
"""Relative, and the part of Δt by which backward Euler may be early."""


def _plate(setting: Setting, bench: Bench, stiffness: float, bending: float) -> Content:
    mesh = grid(LENGTH, LENGTH, CELLS, CELLS, "alternating")
    material = {"density": DENSITY, "membrane": isotropic(stiffness, 0.3), "bending": bending}
    time, about = {"end": 0.5, "step": setting.step}, "A plate hinged at one edge"
    return scene(mesh, material, time, title=about, gravity=[0.0, 0.0, -G], handles=[{"group": "left"}])


def _centre(trial: Trial) -> tuple[float, float]:
    """Of mass, x and z [m]."""
    x = trial.mass @ trial.x / trial.mass.sum()
    return float(x[0]), float(x[2])


def first_vertical(times: list[float], places: list[tuple[float, float]]) -> float:
    """When the centre of mass first passes below the hinge [s], between two steps; NaN if never."""
    angles = np.arctan2([-z for _, z in places], [x for x, _ in places])
    passed = np.flatnonzero(angles >= 0.5 * np.pi)
    if not len(passed):
        return math.nan
    k = int(passed[0])
    part = (0.5 * np.pi - angles[k - 1]) / (angles[k] - angles[k - 1])
    return float(times[k - 1] + part * (times[k] - times[k - 1]))


def _falls(setting: Setting, bench: Bench, record: Record) -> Mapping[str, Verdict]:
    places = cast("list[tuple[float, float]]", record.observed)
    found = first_vertical([0.0, *record.times], places)
    least, most = QUARTER * (1.0 - BOUND) - EARLY * record.nominal, QUARTER * (1.0 + BOUND)
    words = f"first vertical at {found:.4f} s, from {least:.4f} to {most:.4f} s allowed"
    return {"rigid plate": Verdict(least <= found <= most, words)}


def _case(stiffness: str, bending: str, step: float, level: Scope) -> StressCase:
    return StressCase(
        f"plate-{stiffness}-{bending}-{step * 1e3:g}ms",
        f"C {stiffness} N/m, B {bending} N·m, Δt {step * 1e3:g} ms",
        partial(_plate, stiffness=float(stiffness), bending=float(bending)),
        steps=round(0.5 / step),
        step=step,
        level=level,
        own=True,
        observe=_centre,
        judge=_falls,
    )


rigid_plate = family(
    "rigid-plate",
    "stiff in membrane and bending, hinged at one edge: first vertical as a rigid plate",
    _case("1e4", "1e2", 0.005, USUAL),
    _case("1e6", "1e2", 0.005, QUICK),
    _case("1e6", "1e4", 0.005, USUAL),
    _case("1e8", "1e4", 0.005, USUAL),
    _case("1e9", "1e6", 0.005, FULL),
    _case("1e6", "1e3", 0.0025, USUAL),
    _case("1e8", "1e3", 0.001, FULL),
)
