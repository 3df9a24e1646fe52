"""Orders, Pareto front and recommendations from constructed rows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lyra_petsc.experiments.study.jobs import Result, Timing
from lyra_petsc.experiments.study.plan import Axis, make_combinations
from lyra_petsc.experiments.study.study_report import (
    advise,
    choose_recommended,
    mark_front,
    mark_orders,
)
from lyra_petsc.experiments.study.study_runner import (
    Chain,
    EstimatedError,
    StudyRow,
    estimate_chain,
    mark_unresolved,
    richardson,
    sum_estimates,
)

AXES = [
    Axis("integrator", "time.integrator", ("beuler", "bdf2")),
    Axis("dt", "time.step", (0.04, 0.02, 0.01)),
]


def made_up(own_errors: float = 0.0) -> list[StudyRow]:
    """Rows: backward Euler with error Δt in 1 s/(100 Δt), BDF2 with 25 Δt² in twice the time."""
    rows = []
    for combination in make_combinations(AXES):
        integrator, dt = combination.values
        assert isinstance(dt, float)
        first = integrator == "beuler"
        seconds = (0.01 if first else 0.02) / dt
        timings = [Timing(0.5, seconds * factor) for factor in (1.0, 0.95, 1.3)]
        result = Result("", integrator=str(integrator), steps=round(1.0 / dt), end=1.0, timings=timings)
        row = StudyRow(combination, result=result, errors={"position_max": dt if first else 25.0 * dt * dt})
        row.own_errors = {"position_max": own_errors}
        mark_unresolved(row)
        rows.append(row)
    return rows


def test_orders_between_neighbours() -> None:
    rows = made_up()
    mark_orders(rows, AXES, ["position_max"])
    assert ("dt", "position_max") not in rows[0].orders
    assert rows[2].orders["dt", "position_max"] == pytest.approx(1.0)
    assert rows[5].orders["dt", "position_max"] == pytest.approx(2.0)


def test_orders_use_the_mean_length_of_the_steps_taken() -> None:
    rows = made_up()
    for row in rows:  # as if the longest steps had been cut to half
        row.result.steps *= 2 if row.case.settings["dt"] == 0.04 else 1
    mark_orders(rows[:3], AXES, ["position_max"])
    assert not rows[1].orders  # both took the same steps
    assert rows[2].orders["dt", "position_max"] == pytest.approx(1.0)


def test_the_pareto_front() -> None:
    rows = made_up()
    mark_front(rows, "position_max")
    # beuler 0.04 in .25 s, 0.02 in .5, 0.01 in 1.; bdf2 0.04 in .5, 0.01 in 1., 0.0025 in 2.
    assert [row.on_front for row in rows] == [True, True, True, False, True, True]


def test_the_recommendation_names_the_fastest() -> None:
    rows = made_up()
    advice = advise(rows, ["position_max"])
    assert [one.target for one in advice] == [0.1, 0.01, 0.001]
    assert advice[0].text == "For 10 % choose beuler, Δt 40 ms: 250 ms (error 4 %)."
    assert advice[1].row is not None
    assert advice[1].row.run_time == pytest.approx(1.0)
    assert advice[2].row is None
    assert "nothing that ran is accurate enough" in advice[2].text
    assert "bdf2, Δt 10 ms, error 0.25 %, in 2 s" in advice[2].text
    star = choose_recommended(advice)
    assert star is advice[1].row
    assert star.recommended


def test_errors_below_that_of_the_reference_are_not_resolved() -> None:
    rows = made_up(own_errors=1.5e-3)
    assert rows[5].unresolved == {"position_max"}  # 0.0025 < 2 · 0.0015
    assert math.isnan(rows[5].resolved("position_max"))
    assert rows[4].unresolved == set()
    assert rows[4].error_bound("position_max") == pytest.approx(0.0115)
    assert rows[5].error_bound("position_max") == pytest.approx(0.0045)
    mark_orders(rows, AXES, ["position_max"])
    assert rows[4].orders
    assert not rows[5].orders
    mark_front(rows, "position_max")
    assert rows[5].on_front  # it is more accurate than all others, however much
    words = advise(rows, ["position_max"])[1].text
    assert "choose bdf2, Δt 10 ms: 2 s (error below 0.45 %)" in words


def test_the_largest_error_is_reported_with_the_mean() -> None:
    rows = made_up()
    for row in rows:
        row.errors["position_l2"] = row.errors["position_max"] / 4.0
    words = advise(rows, ["position_l2"])[1].text
    assert "For 1 % choose beuler, Δt 40 ms: 250 ms (error 1 %, at most 4 % anywhere)" in words
    for row in rows:
        row.own_errors = {"position_l2": 0.0, "position_max": 0.002}
    words = advise(rows, ["position_l2"])[1].text
    assert "at most 4.2 % anywhere" in words, "the reference's own largest error is left out"
    for row in rows:
        row.own_errors["position_max"] = 0.03
        mark_unresolved(row)
    assert "at most 9 % anywhere" in advise(rows, ["position_l2"])[1].text


def test_a_second_quantity_that_misses_the_accuracy_is_named() -> None:
    rows = made_up()
    for row in rows:
        first = row.integrator == "beuler"
        row.errors |= {"energy": 14.0 * row.errors["position_max"] if first else 1e-3}
        row.errors |= {"probe_tip": row.errors["position_max"]}
    quantities = ["position_max", "energy", "probe_tip"]
    coarse, fine = advise(rows, quantities)[:2]
    # 4 % in position and 56 % in energy; bdf2 with Δt 40 ms has 4 % and 0.1 %
    assert coarse.text.endswith(
        " Its error is 56 % in energy; for 10 % in all choose bdf2, Δt 40 ms: 500 ms."
    )
    assert fine.text.endswith(" Its error is 14 % in energy; for 1 % in all choose bdf2, Δt 20 ms: 1 s.")
    for row in rows:
        row.errors["energy"] = 1e-3
    assert all("in energy" not in one.text for one in advise(rows, quantities))
    for row in rows:
        row.errors["energy"], row.own_errors["energy"] = 0.01, 0.1
        mark_unresolved(row)
    words = advise(rows, quantities)[0].text
    assert words.endswith(" Its error is below 30 % in energy; nothing that ran reaches 10 % in all.")


def test_failed_rows_are_omitted() -> None:
    rows = made_up()
    for row in rows[:3]:
        row.result.problem, row.result.timings, row.errors = "no", [], {}
    mark_front(rows, "position_max")
    assert not any(row.on_front for row in rows[:3])
    assert "beuler" not in advise(rows, ["position_max"])[0].text
    assert advise(rows[:3], ["position_max"]) == []


@pytest.mark.parametrize("order", [1, 2])
def test_richardson_finds_the_error_of_a_converging_sequence(order: int) -> None:
    value = [1.0 + 0.3 * h**order for h in (0.1, 0.2, 0.4)]
    estimate = richardson(abs(value[0] - value[1]), abs(value[1] - value[2]), order)
    assert estimate.error == pytest.approx(value[0] - 1.0)
    assert estimate.order == pytest.approx(order)
    assert estimate.trusted


def test_richardson_limits_the_order_and_refuses_divergence() -> None:
    fast = richardson(1.0, 16.0, 2)
    assert fast.error == pytest.approx(16.0 / 4.0 / 3.0)  # the estimate of the coarser pair
    slow = richardson(1.0, 2.0, 2)
    assert slow.error == pytest.approx(1.0)
    away = richardson(2.0, 1.0, 2)
    assert not away.trusted
    assert away.error > 2.0
    assert richardson(0.0, 0.0, 2).error == 0.0


def test_errors_in_time_and_space_add_up() -> None:
    both = sum_estimates([{"a": EstimatedError(1.0, 2.0, True)}, {"a": EstimatedError(0.5, 2.0, False)}])
    assert both["a"].error == 1.5
    assert not both["a"].trusted
    two = estimate_chain([{"a": np.array([0.1, 0.2])}], Chain((), 0))
    assert two["a"].error == 0.2


def test_a_largest_error_that_changes_place_is_not_underestimated() -> None:
    """One vertex has the largest difference of the coarser runs, another that of the finer runs."""
    first, second = np.array([0.75, 0.45]), np.array([6.0, 1.2])  # at two samples
    chain = Chain((), 2)
    largest = estimate_chain([{"position_max": first}, {"position_max": second}], chain)["position_max"].error
    slowest = first[1] / (second[1] / first[1] - 1.0)  # the second sample converges slowly
    assert largest >= 1.25 * slowest
    whole = estimate_chain([{"position_l2": first}, {"position_l2": second}], chain)["position_l2"].error
    assert whole < largest
