"""Flat sheets of hinges: their effective bending stiffness, small deflections and frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.verification.answers import (
    ASSEMBLED,
    Converges,
    Exact,
    Measured,
    case,
    data,
    grid,
    scene,
)
from lyra_petsc.experiments.verification.flat_sheet import (
    hinge_blocks,
    sheet_stiffness,
    stiffness,
    strip_stiffness,
)
from lyra_petsc.experiments.verification.strips import DENSITY, strip

PATTERNS = ("diagonal", "alternating", "criss-cross")


def _plate(mesh: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A flat sheet with B = 1 N m."""
    material = {"density": 1.0, "membrane": {"c11": 1, "c22": 1, "c12": 0, "c33": 0.5}, "bending": 1.0}
    return scene(mesh, material, ASSEMBLED, **more)


# -- endless strips and sheets ---------------------------------------------------------------------------

RATIOS = {"square cells": 1.0, "cells twice as long as wide": 0.5, "cells twice as wide as long": 2.0}
"""Width of a cell over its length along the strip."""


def expected(pattern: str, ratio: float = 1.0) -> float:
    """B_effective / B of a strip with free edges, by hand from the hinges of one cell.

    Single diagonals and alternating: (1 + r²)² / ((1 + r²)² + r⁴); criss-cross:
    2 / (1 + 4 r⁴ / (1 + r²)²), r the width of a cell over its length.
    """
    square = (1.0 + ratio**2) ** 2
    if pattern == "criss-cross":
        return 2.0 / (1.0 + 4.0 * ratio**4 / square)
    return square / (square + ratio**4)


@case(
    "Bending stiffness of a strip with free edges over B, on each pattern of mesh",
    source=(
        "closed form from the hinges of one cell (lateral curvature, twist and vertex heights relaxed); for "
        "square cells 4.8 k and 6 k with k = B/6 by an independent program too"
    ),
    resolutions=(1, 2, 3, 4, 8, 16),
    claim=Exact(1e-10),
    counts="cells across the strip",
)
def hinge_strip(bench: Bench, n: float) -> Sequence[Measured]:
    found = []
    for words, ratio in RATIOS.items():
        for pattern in PATTERNS:
            with bench.simulation(_plate(grid(6.0, round(n) * ratio, 6, round(n), pattern))) as trial:
                hinges, points = hinge_blocks(trial), trial.x[:, :2]
            value = strip_stiffness(hinges, points, start=2.0, period=2.0, width=n * ratio)
            found.append(Measured(f"B_effective / B, {pattern}, {words}", value, expected(pattern, ratio)))
    return found


SHEET = data("hinge_sheet")
CELLS = 8
"""Along each side of the meshes."""

ENTRIES = {"D11": (0, 0), "D22": (1, 1), "D12": (0, 1), "D13": (0, 2), "D23": (1, 2), "D33": (2, 2)}


def _lattice(mesh: str) -> NDArray[np.float64]:
    """Edge vectors [m] of the smallest cell, as columns."""
    if mesh == "equilateral":
        return np.array([[1.0, 0.5], [0.0, np.sqrt(0.75)]])
    return np.eye(2)


def _equilateral(bench: Bench) -> dict[str, Any]:
    """A rhombus of equilateral triangles with edges of 1 m."""
    column, row = np.meshgrid(np.arange(CELLS + 1), np.arange(CELLS + 1))
    at = np.stack([column.ravel(), row.ravel()]) * 1.0
    vertices = np.column_stack([(_lattice("equilateral") @ at).T, np.zeros(at.shape[1])])
    low = (row * (CELLS + 1) + column)[:-1, :-1].ravel()
    up = low + CELLS + 1
    triangles = np.concatenate(
        [np.stack([low, low + 1, up], axis=1), np.stack([low + 1, up + 1, up], axis=1)]
    )
    return bench.mesh(vertices, triangles)


@case(
    "Bending stiffness of endless sheets, energy per area ½ κᵀDκ, κ = (κ11, κ22, 2κ12), over k = B/6",
    source=SHEET["source"],
    resolutions=(2, 4, 6),
    claim=Exact(1e-10),
    counts="cells in the period",
)
def hinge_sheet(bench: Bench, n: float) -> Sequence[Measured]:
    found = []
    for mesh, wanted in SHEET["D_over_k"].items():
        made = _equilateral(bench) if mesh == "equilateral" else grid(CELLS, CELLS, CELLS, CELLS, mesh)
        with bench.simulation(_plate(made)) as trial:
            hinges, points = hinge_blocks(trial), trial.x[:, :2]
        # k = B/6
        value = 6.0 * sheet_stiffness(hinges, points, (1.0 / n, 1.0 / n), n * _lattice(mesh))
        exact = np.array(wanted)
        found += [
            Measured(f"{name} / k, {mesh}", value[at], exact[at], scale=exact[0, 0])
            for name, at in ENTRIES.items()
        ]
    return found


# -- deflections and frequencies -------------------------------------------------------------------------


def _wide(pattern: str, across: int) -> str:
    return f"deflection over that with B_effective, {pattern}, {across} cells wide"


@case(
    "Clamped strips 2 and 4 square cells wide under a small uniform load: mean deflection of the end "
    "against the beam's with B_effective",
    source="Euler-Bernoulli beam, closed form: w = q L⁴/(8 B)",
    resolutions=(32, 64, 128),
    # near the clamp, over about the strip's width, curvature across is missing
    claim=Converges(1.0, 1.3e-2),
    claims={_wide("alternating", 2): Converges(2.0, 1e-4)},
    counts="cells along the strip",
)
def wide_strip(bench: Bench, n: float) -> Sequence[Measured]:
    """The clamp keeps the strip from curving across, which hinges want to."""
    found = []
    along = round(n)
    for across in (2, 4):
        for pattern in PATTERNS:
            mesh = grid(1.0, across / along, along, across, pattern)
            with bench.simulation(strip(pattern, n) | {"mesh": mesh}) as trial:
                operator, mass = stiffness(trial), trial.mass
            height = operator.solve(mass / DENSITY)
            tips = [row * (along + 1) + along for row in range(across + 1)]
            beam = 1.0 / (8.0 * expected(pattern))
            found.append(Measured(_wide(pattern, across), float(height[tips].mean() / beam), 1.0))
    return found


PLATES = data("hinge_plate")
SIDES = ("left", "right", "bottom", "top")
HANDLES: dict[str, list[dict[str, Any]]] = {
    "CCCC": [{"group": side, "clamp": True} for side in SIDES],
    "SSSS": [{"group": side} for side in SIDES],
    "CFFF": [{"group": "left", "clamp": True}],
}
PLACE = {"CCCC": (0.5, 0.5), "SSSS": (0.5, 0.5), "CFFF": (1.0, 0.5)}
"""Where the deflection is taken."""


def square_plate(edges: str, pattern: str, n: int) -> dict[str, Any]:
    """A unit square with B = 1 and a weight of 1 N/m²."""
    return _plate(grid(1.0, 1.0, n, n, pattern), handles=HANDLES[edges])


@case(
    "Linear plates (C clamped, S supported, F free edges) under uniform load: how far hinges are off "
    "the exact deflection, against what is predicted for the mesh",
    source=PLATES["source"],
    resolutions=(8, 16, 32, 64),
    claim=Exact(1e-7),  # round-off: the condition number grows with n⁴
)
def hinge_plate(bench: Bench, n: float) -> Sequence[Measured]:
    found = []
    for edges, pattern, *errors in PLATES["rows"]:
        with bench.simulation(square_plate(edges, pattern, round(n))) as trial:
            operator, points, mass = stiffness(trial), trial.x[:, :2], trial.mass
        height = operator.solve(mass)
        at = int(np.argmin(np.linalg.norm(points - PLACE[edges], axis=1)))
        error = height[at] / PLATES["deflection"][edges] - 1.0
        predicted = errors[hinge_plate.resolutions.index(n)]
        found.append(Measured(f"error of the deflection, {edges} {pattern}", error, predicted, scale=1.0))
    return found


BETA_L = (1.8751040687119611, 4.694091132974175, 7.854757438237613)
"""Roots of cos βL cosh βL = −1."""


@case(
    "Clamped strip: frequencies from the assembled K and M against the beam's with B_effective",
    source="Euler-Bernoulli beam, closed form: ω = (βL)² √(B/(ρ L⁴))",
    resolutions=(16, 32, 64),
    claim=Converges(2.0, 2e-3),
    quick=3,
    counts="cells along the strip",
)
def strip_vibration(bench: Bench, n: float) -> Sequence[Measured]:
    found = []
    for pattern in PATTERNS:
        with bench.simulation(strip(pattern, n)) as trial:
            operator, mass = stiffness(trial), trial.mass
        root = np.sqrt(mass[~operator.held])
        squares = np.linalg.eigvalsh(operator.dense() / np.outer(root, root))
        for number, beta in enumerate(BETA_L):
            exact = beta**2 * np.sqrt(expected(pattern) / DENSITY)
            value = float(np.sqrt(squares[number]))
            found.append(Measured(f"ω{number + 1}, {pattern}", value, float(exact), "rad/s"))
    return found
