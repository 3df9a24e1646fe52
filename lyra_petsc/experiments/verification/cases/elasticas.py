"""Clamped strips that bend by directors on edges, on every kind of mesh and of any width, B as it stands."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.verification.answers import Converges, Measured, at_finest, case
from lyra_petsc.experiments.verification.flat_plates import KINDS, plate_material, strip_mesh
from lyra_petsc.experiments.verification.rods import Cantilever, cantilever, overhang_weight

STRIPS: dict[str, Any] = {
    "resolutions": (25, 50, 100),
    "claim": at_finest(3e-3),
    "quick": 1,
    "counts": "cells along the strip",
}

WIDTHS = {"one cell": 0.0, "0.1 L": 0.1, "0.25 L": 0.25}

MEMBRANE = 1e6
"""C L²/B: as of a strip with a thickness of 0.0035 L. The exact shapes take its stretch into account."""


def _cantilever(bench: Bench, kind: str, n: float, width: float, **more: Any) -> dict[str, Any]:
    """A scene: a strip of length 1 and B = 1, its end clamped, static."""
    return {
        "mesh": strip_mesh(bench, kind, n, width),
        "material": plate_material(MEMBRANE),
        "handles": [{"group": "left", "clamp": True}],
        "time": {"analysis": "static"},
        **more,
    }


def _tip(trial: Trial) -> tuple[float, float]:
    """Mean (x, −z) of the vertices of the free end over L: reach and drop."""
    start = trial.start[:, 0]
    x, _, z = trial.x[np.isclose(start, start.max(), rtol=1e-9)].mean(axis=0) / start.max()
    return float(x), float(-z)


def _compared(bench: Bench, scene: dict[str, Any], exact: Cantilever, words: str) -> Iterator[Measured]:
    """Drop and reach of the tip, both errors relative to the way the tip went."""
    with bench.simulation(scene) as trial:
        reach, drop = _tip(trial.run())
    way = float(np.hypot(exact.drop, 1.0 - exact.reach))
    yield Measured(f"drop / L, {words}", drop, exact.drop, scale=way)
    yield Measured(f"reach / L, {words}", reach, exact.reach, scale=way)


def _combined(loads: Mapping[str, tuple[float, ...]]) -> Iterator[tuple[str, float, float, str]]:
    """Kind of mesh, width, load, and words for them."""
    for kind in KINDS:
        for words, some in loads.items():
            for load in some:
                yield kind, WIDTHS[words], load, f"{kind}, {words} wide"


TIP_LOADS = {"one cell": (1.0, 50.0), "0.1 L": (4.0,), "0.25 L": (10.0,)}
"""α = P L²/B for each width, P per width"""


@case(
    "Strip that bends by directors, with a load at the tip, α = P L²/B: tip against the elastica with the "
    "strip's stretch; error over the way of the tip",
    source=(
        "elastica by collocation; K. E. Bisshopp and D. C. Drucker, Quart. Appl. Math. 3 (1945) 272-275, "
        "with T = C (λ³ − λ)/2 for the stretch"
    ),
    **STRIPS,
)
def elastica_tip(bench: Bench, n: float) -> Iterator[Measured]:
    for kind, width, load, words in _combined(TIP_LOADS):
        # the scene's force is the total over the width
        force = [{"group": "right", "force": [0, 0, -load * (width or 1.0 / n)]}]
        scene = _cantilever(bench, kind, n, width, loads=force)
        exact = cantilever(0.0, tip_load=load, stretch=1.0 / MEMBRANE)
        yield from _compared(bench, scene, exact, f"{words}, α = {load:g}")


WEIGHTS = {"one cell": (1.0, 1000.0), "0.1 L": (10.0,), "0.25 L": (100.0,)}
"""Γ = w L³/B for each width"""


@case(
    "Strip that bends by directors, under its own weight, Γ = w L³/B: tip against the heavy elastica with "
    "the strip's stretch; error over the way of the tip",
    source=(
        "heavy elastica by collocation; test of Romero et al., ACM Trans. Graph. 40(4):66 (2021); with "
        "T = C (λ³ − λ)/2 for the stretch"
    ),
    **STRIPS,
)
def elastica_weight(bench: Bench, n: float) -> Iterator[Measured]:
    for kind, width, weight, words in _combined(WEIGHTS):
        scene = _cantilever(bench, kind, n, width, gravity=[0, 0, -weight])
        exact = cantilever(weight, stretch=1.0 / MEMBRANE)
        yield from _compared(bench, scene, exact, f"{words}, Γ = {weight:g}")


TURNS = {"one cell": (0.25, 1.0), "0.1 L": (0.5,), "0.25 L": (0.5,)}
"""f = M L/(2π B) for each width: parts of a full circle"""


@case(
    "Strip that bends by directors, rolled up by the moment 2π f B/L at its end: tip against the arc; "
    "error over the way of the tip",
    source="closed form; K. Y. Sze, X. H. Liu, S. H. Lo, Finite Elem. Anal. Des. 40 (2004) 1551, section 3.2",
    # facets of criss-cross cells that bend far lie flat only in finer meshes
    claims={
        f"{side} / L, criss-cross, one cell wide, f = 1": Converges(4.0, 3e-3, slack=math.inf)
        for side in ("drop", "reach")
    },
    **STRIPS,
)
def elastica_roll_up(bench: Bench, n: float) -> Iterator[Measured]:
    for kind, width, turns, words in _combined(TURNS):
        angle = 2.0 * math.pi * turns
        exact = Cantilever(math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle, angle, angle)
        moment = [{"group": "right", "moment": -angle}]
        scene = _cantilever(bench, kind, n, width, loads=moment)
        yield from _compared(bench, scene, exact, f"{words}, f = {turns:g}")


ANGLES = {"one cell": (7.1, 41.5), "0.1 L": (45.0,), "0.25 L": (41.5,)}
"""Of the chord from the clamp to the tip, degrees below the horizontal; 41.5 is the standard's."""

BENDING_LENGTH, CLOTH_DENSITY, GRAVITY = 0.02, 0.15, 9.81
"""c [m], kg/m², m/s²; the cloth's flexural rigidity is w c³ with its weight w [N/m²]."""


@case(
    "Cantilever test of cloth that bends by directors: with B = w c³ the chord must reach the angle that "
    "belongs to the overhang (41.5° at 2.0003 c)",
    source="ASTM D1388, option A, and ISO 9073-7 (angle, G = w c³); overhangs from the exact heavy elastica",
    **STRIPS,
)
def elastica_overhang(bench: Bench, n: float) -> Iterator[Measured]:
    rigidity = CLOTH_DENSITY * GRAVITY * BENDING_LENGTH**3
    for kind, width, angle, words in _combined(ANGLES):
        overhang = BENDING_LENGTH * overhang_weight(angle) ** (1.0 / 3.0)
        scene = _cantilever(bench, kind, n, width, gravity=[0, 0, -GRAVITY])
        scene["mesh"] = strip_mesh(bench, kind, n, width, overhang)
        scene["material"] = plate_material(MEMBRANE * rigidity / overhang**2, rigidity) | {
            "density": CLOTH_DENSITY
        }
        with bench.simulation(scene) as trial:
            reach, drop = _tip(trial.run())
        reached = math.degrees(math.atan2(drop, reach))
        yield Measured(f"angle of the chord, {words}, overhang for {angle:g}°", reached, angle, "°")
