"""Hanging strips: by one end, and between two supports as catenaries."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.verification.flat_plates import LENGTH, WIDTH, hung
from lyra_petsc.experiments.verification.rods import stretches
from lyra_petsc.experiments.verification.verification_case import (
    G,
    Measured,
    grid,
    isotropic,
    load_data,
    scene,
    worst_value,
)

# -- by one end ------------------------------------------------------------------------------------------

STIFFNESS = 100.0
"""N/m"""


def _by_one_end(n: int, density: float, held: dict[str, Any], **more: Any) -> dict[str, Any]:
    mesh = grid(LENGTH, WIDTH, n, 1, more.pop("pattern", "diagonal"))
    material = {"density": density, "membrane": isotropic(STIFFNESS)}
    return scene(mesh, material, handles=[held, {"group": "sheet", "axes": ["z"]}], **more)


def of_chain(e: float, bars: int) -> float:
    """Elongation over length of a chain of bars with half of each weight at both ends; e: weight over c11."""
    return float(stretches(e * (np.arange(bars) + 0.5) / bars, 1.0).mean() - 1.0)


def of_strip(e: float) -> float:
    """Elongation over length of a strip; e is its weight over c11."""
    [largest] = stretches(np.array([e]), 1.0)
    return float((0.75 * (largest**4 - 1.0) - 0.5 * (largest**2 - 1.0)) / (2.0 * e) - 1.0)


def hanging_strip_chain(bench: Bench, n: float) -> Iterator[Measured]:
    bars = int(n)
    rows = [{"nodes": [i, bars + 1 + i]} for i in range(bars + 1)]
    shares = np.full(bars + 1, 1.0 / bars)
    shares[[0, -1]] *= 0.5
    for e in (0.01, 0.1, 1.0):
        weight, exact = e * STIFFNESS * WIDTH, of_chain(e, bars) * LENGTH
        # loads instead of gravity, as all rows need the same weight and grid vertices differ in mass
        loads = [
            row | {"force": [weight * share, 0, 0]} for row, share in zip(rows, shares.tolist(), strict=True)
        ]
        with bench.simulation(_by_one_end(bars, 0.1, rows[0], loads=loads)) as trial:
            x = trial.run().x
        end = worst_value(x[[bars, 2 * bars + 1], 0] - LENGTH, exact)
        yield Measured(f"elongation, weight {e:g} of c11", end, exact, "m", LENGTH)


def hanging_strip(bench: Bench, n: float) -> Iterator[Measured]:
    for e in (0.01, 0.1, 1.0, 10.0):
        density, held = e * STIFFNESS / (G * LENGTH), {"group": "left"}
        hanging = _by_one_end(int(n), density, held, pattern="criss-cross", gravity=[G, 0, 0])
        with bench.simulation(hanging) as trial:
            x = trial.run().x
        end = float(x[[int(n), 2 * int(n) + 1], 0].mean()) - LENGTH
        yield Measured(f"elongation, weight {e:g} of c11", end, of_strip(e) * LENGTH, "m")


# -- catenaries ------------------------------------------------------------------------------------------

CATENARY = load_data("catenary")


def _middle(bench: Bench, n: float, e: float, dx: float, dz: float = 0.0) -> tuple[float, float]:
    """x and z [m] of the middle of a strip from its left support; supports at distance (dx, dz) L."""
    with bench.simulation(hung(bench, int(n), e, dx * LENGTH, dz * LENGTH)) as trial:
        x, _, z = trial.run().x[int(n) // 2]
    return float(x), float(z)


def catenary(bench: Bench, n: float) -> Iterator[Measured]:
    for span, sag in CATENARY["inextensible"]["rows"]:
        # weight over c11, which bounds the stretch; its effect is larger the less the strip sags
        low = -_middle(bench, n, 1e-5 if span == 0.5 else 1e-6, span)[1]
        yield Measured(f"sag, span {span:g} of the length", low, sag * LENGTH, "m")


def catenary_unequal(bench: Bench, n: float) -> Iterator[Measured]:
    for dx, dz, a, lowest, _, _ in CATENARY["unequal_heights"]["rows"]:
        # weight over c11, which bounds the stretch
        x, z = _middle(bench, n, 2e-6, dx, dz)
        exact = middle(a, lowest)
        supports = f"right support {dx:g} L away, {dz:g} L up"
        yield Measured(f"x of the middle, {supports}", x, exact[0] * LENGTH, "m")
        yield Measured(f"z of the middle, {supports}", z, exact[1] * LENGTH, "m")


def middle(a: float, lowest: float) -> tuple[float, float]:
    """Coordinates over L of the point at half the length of a catenary, from its left end.

    ``a`` and ``lowest`` are its parameter and the abscissa of its lowest point, over L.
    """
    x = lowest + a * math.asinh(0.5 / a - math.sinh(lowest / a))
    return x, a * (math.cosh((x - lowest) / a) - math.cosh(lowest / a))


def catenary_elastic(bench: Bench, n: float) -> Iterator[Measured]:
    for e, span, sag, _, _ in CATENARY["elastic"]["rows"]:
        name = f"sag, weight {e:g} of c11, span {span:g} of the length"
        yield Measured(name, -_middle(bench, n, e, span)[1], sag * LENGTH, "m")
