"""Closed forms used by cases, and their meshes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from physics import reference

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.experiments.meshes import irregular_rectangle, rectangle, ring_disc
from lyra_petsc.experiments.verification.cases.hanging import middle, of_chain, of_strip
from lyra_petsc.experiments.verification.cases.membranes import answer
from lyra_petsc.experiments.verification.cases.motions import level_fall
from lyra_petsc.experiments.verification.verification_case import load_data


def test_the_level_fall_agrees_with_the_table() -> None:
    for steps, speed, z in reference("backward_euler")["terminal_velocity"]["rows"]:
        assert level_fall(100.0, 0.01 * steps) == pytest.approx((speed, -z), rel=1e-12)


def test_hanging_strips_and_chains_agree_with_the_table() -> None:
    tables = reference("hanging")
    for e, exact in tables["strip"]["rows"]:
        assert of_strip(e) == pytest.approx(exact, rel=1e-9)
    for e, bars, exact in tables["chain"]["rows"]:
        assert of_chain(e, bars) == pytest.approx(exact, rel=1e-9)


def test_stress_and_energy_agree_with_the_table() -> None:
    tables = reference("stvk_patch")
    for material, _, gradient, _, stress, _, energy in tables["rows"]:
        c = dict(zip(("c11", "c12", "c22", "c33"), tables["materials"][material], strict=True))
        computed, stored = answer(np.array(gradient), c)
        np.testing.assert_allclose(computed, stress, rtol=1e-9, atol=1e-9)
        assert stored == pytest.approx(energy, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("row", load_data("catenary")["unequal_heights"]["rows"])
def test_the_midpoint_of_a_catenary_halves_its_length(row: list[float]) -> None:
    dx, dz, a, lowest = row[:4]
    x, z = middle(a, lowest)

    def curve(at: Array) -> Array:
        return np.asarray(a * (np.cosh((at - lowest) / a) - math.cosh(lowest / a)))

    def length(low: float, high: float) -> float:
        at = np.linspace(low, high, 20001)
        return float(np.hypot(np.diff(at), np.diff(curve(at))).sum())

    assert curve(np.array([dx]))[0] == pytest.approx(dz, abs=1e-9)
    assert length(0.0, x) == pytest.approx(0.5, abs=1e-7)
    assert length(x, dx) == pytest.approx(0.5, abs=1e-7)
    assert z == pytest.approx(float(curve(np.array([x]))[0]), abs=1e-12)


def areas(vertices: Array, triangles: Ints) -> Array:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.asarray(0.5 * np.cross(b - a, c - a)[:, 2])


UNIT: list[tuple[Callable[..., tuple[Array, Ints]], tuple[Any, ...], float]] = [
    (rectangle, (4, 3, 1.0, 0.7), 0.7),
    (irregular_rectangle, (200, 200, 1.0, 0.7), 0.7),
    (ring_disc, (5,), 15.0 * math.sin(math.pi / 15.0)),
]


@pytest.mark.parametrize(("make", "arguments", "area"), UNIT)
def test_meshes_cover_their_shape_once(
    make: Callable[..., tuple[Array, Ints]], arguments: tuple[Any, ...], area: float
) -> None:
    parts = areas(*make(*arguments))
    assert parts.min() > 0.0
    assert parts.sum() == pytest.approx(area, rel=1e-14)
