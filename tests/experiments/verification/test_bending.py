"""References of the bending cases, and tools for the stiffness of flat sheets."""

from __future__ import annotations

import math
from typing import Any

import pytest
from mpi4py import MPI
from physics import reference

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.verification.cases import CASES, hinges
from lyra_petsc.experiments.verification.cases.hinges import (
    expected,
    hinges_of,
    strip_stiffness,
)
from lyra_petsc.experiments.verification.flat_plates import hinged_strip
from lyra_petsc.experiments.verification.rods import (
    cantilever,
    column_shape,
    heavy_coupled_strip,
    overhang_weight,
    tall_cantilever,
)
from lyra_petsc.experiments.verification.verification_case import run_case

PUBLISHED = reference("cantilevers")


@pytest.mark.parametrize("row", PUBLISHED["tip_load"]["rows"], ids=lambda row: f"{row[0]:g}")
def test_the_loaded_elastica_agrees_with_the_published_one(row: list[float]) -> None:
    load, angle, shortening, drop = row
    tip = cantilever(0.0, tip_load=load)
    shape = (tip.angle, 1.0 - tip.reach, tip.drop)
    assert shape == pytest.approx((angle, shortening, drop), abs=PUBLISHED["tip_load"]["tolerance"])


@pytest.mark.parametrize("row", PUBLISHED["own_weight"]["rows"], ids=lambda row: f"{row[0]:g}")
def test_the_heavy_elastica_agrees_with_the_published_one(row: list[float]) -> None:
    weight, drop, reach, angle, curvature = row
    tip = cantilever(weight)
    tolerance = PUBLISHED["own_weight"]["tolerance"]
    assert (tip.drop, tip.reach, tip.angle) == pytest.approx((drop, reach, angle), abs=tolerance)
    assert tip.clamp_curvature == pytest.approx(curvature, rel=tolerance)


@pytest.mark.parametrize("row", PUBLISHED["stretching"]["rows"], ids=lambda row: f"{row[0]:g} {row[1]:g}")
def test_the_stretching_elastica_agrees_with_the_published_one(row: list[float]) -> None:
    weight, thickness, drop, reach, angle = row
    tip = cantilever(weight, stretch=thickness**2 / 12.0)
    tolerance = PUBLISHED["stretching"]["tolerance"]
    assert (tip.drop, tip.reach, tip.angle) == pytest.approx((drop, reach, angle), abs=tolerance)


def test_overhangs_agree_with_published_ones() -> None:
    for degrees, weight in PUBLISHED["overhang"]["rows"]:
        assert overhang_weight(degrees) == pytest.approx(weight, rel=PUBLISHED["overhang"]["tolerance"])


def test_a_light_strip_of_hinges_bends_with_four_fifths_of_b() -> None:
    weight = 1e-3
    _, sideways, drop = heavy_coupled_strip(0.8 * weight)
    assert drop == pytest.approx(weight / 8.0, rel=1e-5)
    # κ = −Γ (1 − s)²/2 twists by τ = −κ/5; y'' = −κ ∫τ
    assert sideways == pytest.approx(weight**2 / 60.0 * (1.0 / 4.0 - 1.0 / 7.0), rel=1e-4)


def test_a_strongly_bent_strip_of_hinges_is_stiffer_than_four_fifths_of_b() -> None:
    _, sideways, drop = heavy_coupled_strip(8.0)
    assert sideways > 0.05
    assert drop < cantilever(10.0).drop - 0.005


def test_buckled_columns() -> None:
    """Slightly above the critical load: P/P_c = 1 + a²/16, height 2 a/π, with the angle a at the ends."""
    load, height = column_shape(shortening=1e-4)
    angle = 2.0 * math.sqrt(1e-4)  # a²/4 for a sine
    assert load / math.pi**2 - 1.0 == pytest.approx(angle**2 / 8.0, rel=1e-3)
    assert height == pytest.approx(angle / math.pi, rel=1e-3)
    assert column_shape(load=load)[1] == pytest.approx(height, rel=1e-9)


def test_a_tall_cantilever_tips_at_the_published_load() -> None:
    factor, turn = tall_cantilever(0.5)
    assert factor == pytest.approx(4.013, abs=5e-4)
    assert turn == pytest.approx(math.sqrt(0.5) * tall_cantilever(1.0)[1], rel=1e-12)
    # suppressed warping shortens the way along which it twists
    assert tall_cantilever(0.5, 1e-4)[0] / factor - 1.0 == pytest.approx(2.0 * 0.01, rel=0.1)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("pattern", hinges.PATTERNS)
def test_bending_over_the_factor_of_the_mesh_gives_b(comm: MPI.Comm, pattern: str) -> None:
    scene: dict[str, Any] = hinged_strip(
        pattern, 8, material={"bending": 1.0, "bending_scale": 1.0 / expected(pattern)}
    )
    with Bench(comm).simulation(scene) as trial:
        hinges, points = hinges_of(trial), trial.x[:, :2]
    stiffness = strip_stiffness(hinges, points, start=0.25, period=0.25, width=0.125)
    assert stiffness == pytest.approx(1.0, rel=1e-10)


@pytest.mark.parallel(2)
def test_a_stiffness_other_than_predicted_fails(comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hinges, "expected", lambda pattern, ratio=1.0: 1.0)
    outcome = run_case(comm, CASES.load("hinge-strip"), quick=True)
    verdicts = {quantity: verdict.passed for quantity, verdict in outcome.verdicts.items()}
    assert not verdicts["B_effective / B, diagonal, square cells"]
    assert verdicts["B_effective / B, criss-cross, square cells"]
    assert not outcome.passed
