"""Verdicts on constructed records: good ones pass, each kind of bad one fails for its own reason."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from lyra_petsc.experiments.stress.step_balance import StepBalance
from lyra_petsc.experiments.stress.stress_runner import StressOutcome
from lyra_petsc.experiments.stress.stress_scenes import StressCase, base_scene
from lyra_petsc.experiments.stress.verdicts import RunRecord, judge_physics, judge_speed
from lyra_petsc.stepping.energy_balance import Budget, StepAccount
from lyra_petsc.stepping.simulation import StepReport

ACCOUNT = StepAccount(
    Budget(), Budget(kinetic=-0.5), external=0.1, moved_at_start=0.0, moved=0.0,
    heat=0.1, damping_heat=0.1, fabric_heat=0.0, inertia=0.3,
)  # fmt: skip
"""Its bracket is −0.2 J."""

GOOD = StepBalance(
    account=ACCOUNT, turned_over=1.2, defect=1e-10,
    tolerance=1e-9, residual=1e-6, promised=2e-6, floor=1e-12, driving=1.0, displacement=1e-3, momentum=1e-8,
    momentum_tolerance=1e-7, angular=1e-8, angular_tolerance=1e-7,
)  # fmt: skip
STEP = StepReport(1, 0.01, 0.01, 5, 100, 0, 1e-6, 0.1, 0.9, 1.1)
NOTE = "step 1: triangle 3 …; below 0.577 the St. Venant-Kirchhoff model softens"


def record(balance: StepBalance = GOOD, report: StepReport = STEP, **more: object) -> RunRecord:
    """Three steps, of which the middle one is given."""
    good = RunRecord(3, 0.01, 0.03, 1.0, [STEP, report, STEP], [GOOD, balance, GOOD])
    return replace(good, **more)  # type: ignore[arg-type]


def failures(run: RunRecord) -> dict[str, str]:
    return {name: verdict.message for name, verdict in judge_physics(run).items() if not verdict.passed}


def test_a_good_record_passes() -> None:
    assert set(judge_physics(record())) == {
        "converged",
        "equations",
        "resolved",
        "energy",
        "no gain",
        "momentum",
        "softening",
    }
    assert failures(record()) == {}


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"defect": 1.1e-9}, "energy"),
        ({"defect": -1.1e-9}, "energy"),
        ({"defect": math.nan}, "energy"),
        ({"tolerance": math.nan}, "energy"),
        ({"tolerance": 0.0}, "energy"),
        ({"residual": 2.1e-6}, "equations"),
        ({"residual": math.nan}, "equations"),
        ({"driving": 0.9e-5}, "resolved"),
        ({"driving": math.nan}, "resolved"),
        ({"account": replace(ACCOUNT, after=Budget(kinetic=0.1 + 1.1e-9), inertia=-0.3)}, "no gain"),
        ({"account": replace(ACCOUNT, damping_heat=-1e-6)}, "no gain"),
        ({"momentum": 1.1e-7}, "momentum"),
        ({"angular": 1.1e-7}, "momentum"),
        ({"angular": math.nan}, "momentum"),
    ],
)
def test_each_violated_balance_fails_its_verdict(change: dict[str, Any], name: str) -> None:
    broken = failures(record(replace(GOOD, **change)))
    assert name in broken
    assert set(broken) <= {name, "no gain", "resolved" if name == "equations" else name}
    if name != "no gain":
        assert "step 2" in broken[name]


@pytest.mark.parametrize(("left", "good"), [(0.9e-4, True), (1.1e-4, False), (math.nan, False)])
def test_large_residuals_at_round_off_are_allowed_if_they_move_nothing(left: float, good: bool) -> None:
    stiff = replace(GOOD, residual=1e-6, driving=1e-6, promised=1e-9, floor=2e-6)
    messages = failures(record(stiff, replace(STEP, remaining=left)))
    assert ("resolved" in messages) is not good


def test_a_gain_is_allowed_where_the_energy_is_not_convex() -> None:
    buckling = replace(GOOD, account=replace(ACCOUNT, after=Budget(kinetic=0.4)))
    assert failures(record(buckling)) == {}
    assert "buckling" in judge_physics(record(buckling))["no gain"].message


def test_a_residual_at_round_off_is_reported_as_such() -> None:
    words = judge_physics(record(replace(GOOD, promised=1e-12, residual=1e-12)))["equations"].message
    assert "floor of round-off" in words


def test_a_run_that_stopped_has_not_converged() -> None:
    assert "step 4 failed" in failures(record(stop_reason="step 4 failed"))["converged"]
    assert "converged" in failures(RunRecord(3, 0.01, 0.03))


def test_rejected_steps_are_allowed_and_reported() -> None:
    verdict = judge_physics(record(report=replace(STEP, rejected=2, dt=0.0025)))["converged"]
    assert verdict.passed
    assert "2 attempts rejected" in verdict.message
    assert "0.0025 s" in verdict.message


def test_softening_must_be_noted() -> None:
    pressed = replace(STEP, smallest_stretch=0.57)
    assert "NOTHING" in failures(record(report=pressed))["softening"]
    assert failures(record(report=pressed, notes=[NOTE])) == {}


@pytest.mark.parametrize(
    ("newton", "wall_ratio", "cpu_ratio", "good"),
    [
        ([10, 10, 30], 5.0, 9.0, True),
        ([10, 10, 30], 9.0, 5.0, True),
        ([10, 10, 31], 1.0, 1.0, False),
        ([11, 11, 11], 1.0, 1.0, False),
        ([1, 1, 1], 5.1, 5.1, False),
        ([1, 1, 1], math.nan, math.nan, False),
    ],
)
def test_speed_is_judged_by_iterations_and_time(
    newton: list[int], wall_ratio: float, cpu_ratio: float, good: bool
) -> None:
    reports = [replace(STEP, newton_iterations=n) for n in newton]
    assert judge_speed(record(reports=reports), wall_ratio, cpu_ratio).passed is good


def test_a_stopped_run_has_no_speed() -> None:
    assert not judge_speed(record(stop_reason="at once"), 1.0, 1.0).passed


@pytest.mark.parametrize(
    ("integrator", "dissipation", "gained", "good", "word"),
    [
        ("beuler", 0.01, 0.0, True, "right"),
        ("beuler", 0.7, 0.0, True, "solved"),
        ("midpoint", 0.01, 0.2, False, "FAILED"),
        ("semi-implicit", 0.02, 0.01, True, "right"),
        ("semi-implicit", 0.95, 0.0, False, "FAILED"),
    ],
)
def test_the_whole_run_is_judged(
    integrator: str, dissipation: float, gained: float, good: bool, word: str
) -> None:
    balance = {"numerical_dissipation": dissipation, "numerical_gain": gained, "repeated": 2}
    run = replace(record(integrator=integrator), balance=balance)
    verdicts = judge_physics(run)
    assert verdicts["whole run"].passed is good
    assert "2 attempts repeated" in verdicts["whole run"].message
    assert StressOutcome(StressCase("a", "b", base_scene), verdicts, record=run).verdict == word
