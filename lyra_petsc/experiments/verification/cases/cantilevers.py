"""Clamped strips that bend without limit: by a load at the tip, by their weight, by their rest curvature."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.verification.answers import (
    Claim,
    Converges,
    Exact,
    Measured,
    at_finest,
    case,
    isotropic,
)
from lyra_petsc.experiments.verification.cases.hinges import expected
from lyra_petsc.experiments.verification.rods import (
    Cantilever,
    cantilever,
    heavy_coupled_strip,
    overhang_weight,
)
from lyra_petsc.experiments.verification.strips import DENSITY, MEMBRANE, compared, strip, tip
from lyra_petsc.parallel import on_root

STRIPS: dict[str, Any] = {"resolutions": (16, 32, 64), "quick": 1, "counts": "cells along the strip"}

PATTERNS = ("alternating", "criss-cross")
"""Those whose bending does not twist them."""


def _tips(
    bench: Bench, n: float, runs: Iterable[tuple[dict[str, Any], Cantilever, str]]
) -> Sequence[Measured]:
    """The tips of strips against what is exact: (scene, exact, words) of each."""
    found: list[Measured] = []
    for scene, exact, words in runs:
        with bench.simulation(scene) as trial:
            found += compared(trial.run(), n, exact, words)
    return found


LOADS = (0.25, 1.0, 4.0, 10.0, 50.0)
"""α = P L² / B_effective, P per width"""


@case(
    "Clamped strip with a load at the tip, α = P L²/B_effective: tip against the elastica with the "
    "strip's stretch; error over the way of the tip",
    source=(
        "elastica by collocation; K. E. Bisshopp and D. C. Drucker, Quart. Appl. Math. 3 (1945) 272-275, "
        "with T = C (λ³ − λ)/2 for the stretch"
    ),
    claim=at_finest(2e-3),
    **STRIPS,
)
def tip_load(bench: Bench, n: float) -> Sequence[Measured]:
    def run(pattern: str, load: float) -> tuple[dict[str, Any], Cantilever, str]:
        stiffness = expected(pattern)
        # the scene's force is the total over the strip's width of one cell
        force = [{"group": "right", "force": [0, 0, -load * stiffness / n]}]
        exact = cantilever(0.0, tip_load=load, stretch=stiffness / MEMBRANE)
        return strip(pattern, n, loads=force), exact, f"{pattern}, α = {load:g}"

    return _tips(bench, n, (run(pattern, load) for pattern in PATTERNS for load in LOADS))


WEIGHTS = (0.1, 1.0, 10.0, 100.0, 1e3, 1e4)
"""Γ = w L³ / B_effective"""


@case(
    "Clamped strip under its own weight, Γ = w L³/B_effective: tip against the heavy elastica with the "
    "strip's stretch; error over the way of the tip",
    source=(
        "heavy elastica by collocation; test of Romero et al., ACM Trans. Graph. 40(4):66 (2021); with "
        "T = C (λ³ − λ)/2 for the stretch"
    ),
    claim=at_finest(2e-3),
    **STRIPS,
)
def heavy_cantilever(bench: Bench, n: float) -> Sequence[Measured]:
    def run(pattern: str, weight: float) -> tuple[dict[str, Any], Cantilever, str]:
        stiffness = expected(pattern)
        exact = cantilever(weight, stretch=stiffness / MEMBRANE)
        scene = strip(pattern, n, gravity=[0, 0, -weight * stiffness / DENSITY])
        return scene, exact, f"{pattern}, Γ = {weight:g}"

    return _tips(bench, n, (run(pattern, weight) for pattern in PATTERNS for weight in WEIGHTS))


# -- rest curvature --------------------------------------------------------------------------------------

TURNS = {"diagonal": (0.25, 1.0), "alternating": (0.25, 0.5), "criss-cross": (0.25, 0.5)}
"""Parts of a full circle for each pattern of mesh."""


def _arc(turns: float) -> Cantilever:
    """Tip of an arc of length 1 that starts horizontally and bends downwards."""
    angle = 2.0 * math.pi * turns
    return Cantilever(math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle, angle, angle)


def _part(pattern: str, turns: float) -> str:
    return f"{pattern}, {turns:g} of a circle"


def _of_arcs() -> dict[str, Claim]:
    claims: dict[str, Claim] = {}
    for turns in TURNS["criss-cross"]:
        # the arc dimples every cell, which its membrane resists: not free of energy
        for side in ("drop", "reach"):
            claims[f"{side} / L, {_part('criss-cross', turns)}"] = at_finest(5e-3)
    # there the polygon that the cells make ends where the arc does
    for side, pattern, turns in (
        ("reach", "alternating", 0.5),
        ("drop", "diagonal", 1.0),
        ("reach", "diagonal", 1.0),
    ):
        claims[f"{side} / L, {_part(pattern, turns)}"] = Exact(1e-6)
    return claims


@case(
    "Clamped strip that its rest curvature rolls up: tip against the arc; error over the way of the tip",
    source="closed form; the shape of K. Y. Sze, X. H. Liu, S. H. Lo, Finite Elem. Anal. Des. 40 (2004) 1551",
    claim=Converges(2.0, 1e-4),
    claims=_of_arcs(),
    **STRIPS,
)
def roll_up(bench: Bench, n: float) -> Sequence[Measured]:
    def run(pattern: str, turns: float) -> tuple[dict[str, Any], Cantilever, str]:
        curved = {"rest_curvature": [-2.0 * math.pi * turns, 0.0, 0.0]}
        # without tension or weight the membrane stretches nothing, and a softer one is found sooner
        return strip(pattern, n, 1e4, material=curved), _arc(turns), _part(pattern, turns)

    return _tips(bench, n, (run(pattern, turns) for pattern, parts in TURNS.items() for turns in parts))


# -- strips that twist -----------------------------------------------------------------------------------

COILING = (0.1, 1.0, 10.0, 100.0)
"""w L³ / (0.8 B)"""

STIFF = 1e7
"""C L²/B: high enough that a strip as narrow as 1/64 hardly bends in its own plane."""


@case(
    "Clamped strip of single diagonals under its own weight, Γ = w L³/(0.8 B): tip against the rod whose "
    "bending twists it; error over the way of the tip",
    source="Kirchhoff rod with bend-twist coupling, its stiffness by hand from the hinges of a cell",
    claim=at_finest(2e-3),
    **STRIPS,
)
def coiling_strip(bench: Bench, n: float) -> Sequence[Measured]:
    found: list[Measured] = []
    for weight in COILING:
        nominal = 0.8 * weight
        scene = strip("diagonal", n, STIFF, gravity=[0, 0, -nominal / DENSITY])
        with bench.simulation(scene) as trial:
            x, y, z = trial.run().x[[round(n), 2 * round(n) + 1]].mean(axis=0)
        exact = on_root(bench.comm, partial(heavy_coupled_strip, nominal, 1.0 / STIFF))
        reach, sideways, drop = exact
        way = float(np.hypot(1.0 - reach, np.hypot(sideways, drop)))
        words = f"Γ = {weight:g}"
        found += [
            Measured(f"drop / L, {words}", float(-z), drop, scale=way),
            Measured(f"reach / L, {words}", float(x), reach, scale=way),
            Measured(f"sideways / L, {words}", float(y) - 0.5 / n, sideways, scale=way),
        ]
    return found


# -- the cloth maker's test ------------------------------------------------------------------------------

ANGLES = (7.1, 41.5, 45.0)
"""Of the chord from the clamp to the tip, degrees below the horizontal; 41.5 is the standard's."""

BENDING_LENGTH, CLOTH_DENSITY, GRAVITY = 0.02, 0.15, 9.81
"""c [m], kg/m², m/s²; the cloth's flexural rigidity is w c³ with its weight w [N/m²]."""


@case(
    "Cantilever test of cloth: with B = w c³, corrected for the mesh, the chord must reach the angle "
    "that belongs to the overhang (41.5° at 2.0003 c)",
    source="ASTM D1388, option A, and ISO 9073-7 (angle, G = w c³); overhangs from the exact heavy elastica",
    claim=at_finest(2e-3),
    **STRIPS,
)
def cloth_overhang(bench: Bench, n: float) -> Sequence[Measured]:
    found = []
    rigidity = CLOTH_DENSITY * GRAVITY * BENDING_LENGTH**3
    for pattern in PATTERNS:
        for angle in ANGLES:
            overhang = BENDING_LENGTH * overhang_weight(angle) ** (1.0 / 3.0)
            material = {
                "density": CLOTH_DENSITY,
                "membrane": isotropic(MEMBRANE * rigidity / overhang**2),
                # what the mesh makes of B is known, hence corrected
                "bending": rigidity / expected(pattern),
            }
            scene = strip(pattern, n, material=material, gravity=[0, 0, -GRAVITY])
            scene["mesh"]["grid"] |= {"width": overhang, "height": overhang / round(n)}
            with bench.simulation(scene) as trial:
                reach, drop = tip(trial.run(), n)
            reached = math.degrees(math.atan2(drop, reach))
            words = f"angle of the chord, {pattern}, overhang for {angle:g}°"
            found.append(Measured(words, reached, angle, "°"))
    return found
