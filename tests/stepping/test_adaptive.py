"""Adaptive steps and increments of the load factor."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import grid, shape, stepped

from lyra_petsc.arrays import Array
from lyra_petsc.stepping import accuracy
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.stepping.step_control import StepControl, ToleranceControl

pytestmark = pytest.mark.parallel(2)

SWING: dict[str, Any] = {
    "mesh": grid(0.5, 0.1, 5, 1),
    "material": {"density": 0.2, "membrane": {"c11": 200.0, "c22": 200.0, "c12": 0.0, "c33": 100.0}},
    "gravity": [0, 0, -9.81],
    "handles": [{"box": [[0, 0, 0], [0, 1, 0]]}],
    "output": {"every": 0.05},
}
END = 0.2
SIZE = float(np.hypot(0.5, 0.1))


def simulated(
    comm: MPI.Comm, petsc: dict[str, str] | None = None, **content: Any
) -> AbstractContextManager[SteppedScene]:
    return stepped(comm, SWING | content, **{"ksp_rtol": "1e-8"} | (petsc or {}))


@pytest.fixture(scope="module")
def converged() -> Array:
    """Positions at the end, with an error in time far below every tolerance of the tests."""
    shapes, comm = [], MPI.COMM_WORLD
    for step in (1e-3, 5e-4):
        time = {"end": END, "step": step, "integrator": "midpoint"}
        with simulated(comm, time=time) as simulation:
            while not simulation.finished:
                simulation.step()
            shapes.append(shape(simulation))
    return (4.0 * shapes[1] - shapes[0]) / 3.0


@pytest.mark.parametrize(
    ("integrator", "tolerance"),
    [("bdf2", 1e-2), ("bdf2", 1e-3), ("alpha2", 1e-3), ("midpoint", 1e-3), ("beuler", 1e-2)],
)
def test_the_error_keeps_the_tolerance(
    integrator: str, tolerance: float, comm: MPI.Comm, converged: Array
) -> None:
    time = {"end": END, "step": "auto", "tolerance": tolerance, "integrator": integrator}
    with simulated(comm, time=time) as simulation:
        lengths = []
        while not simulation.finished:
            lengths.append(simulation.step().dt)
        error = np.linalg.norm(shape(simulation) - converged, axis=1).max() / SIZE
        assert 0.05 * tolerance < error < 2.0 * tolerance
        assert simulation.accuracy is not None
        assert simulation.accuracy.estimated < tolerance
    assert max(lengths) > 1.5 * min(lengths)


def test_steps_end_at_output_times_and_events(comm: MPI.Comm) -> None:
    handles = [*SWING["handles"], {"nodes": [5], "until": 0.07}]
    time = {"end": END, "step": "auto", "integrator": "bdf2"}
    with simulated(comm, handles=handles, time=time) as simulation:
        ends = []
        while not simulation.finished:
            ends.append(simulation.step().time)
    for landing in (0.05, 0.07, 0.1, 0.15, END):
        assert min(abs(np.array(ends) - landing)) < 1e-12


def test_smallest_and_largest_step_are_kept_with_a_note(comm: MPI.Comm) -> None:
    options = {"ts_adapt_dt_min": "0.004", "ts_adapt_dt_max": "0.008", "ts_dt": "0.005"}
    time = {"end": 0.1, "step": "auto", "tolerance": 1e-7, "integrator": "bdf2"}
    with simulated(comm, options, time=time) as simulation:
        lengths = []
        while not simulation.finished:
            lengths.append(simulation.step().dt)
        assert [note for note in simulation.notes if "time.tolerance is not reached" in note]
    assert lengths[0] == pytest.approx(0.005, rel=0.3)
    assert min(lengths) > 0.0019
    assert max(lengths) <= 0.008 + 1e-12


@pytest.mark.parametrize(("integrator", "notes"), [("beuler", 1), ("bdf2", 0)])
def test_many_steps_of_first_order_are_noted(
    integrator: str, notes: int, comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(accuracy, "FIRST_ORDER_STEPS", 3)
    time = {"end": END, "step": "auto", "integrator": integrator}
    with simulated(comm, time=time) as simulation:
        for _ in range(5):
            simulation.step()
        assert sum("bdf2 or alpha2 take fewer steps" in note for note in simulation.notes) == notes


def test_a_large_error_shortens_the_step_and_a_small_one_lengthens_it() -> None:
    control = ToleranceControl(0.01, 0.1, 1.0, None, [], 1e-6)
    assert control.accept(0.01, 0.01, 2)
    assert control.next_end(0.0) == pytest.approx(0.02)
    assert not control.accept(0.02, 4.0, 2)
    assert control.next_end(0.0) == pytest.approx(0.02 * 0.85 / 2.0)
    assert not control.accept(0.01, 1e9, 2)
    assert control.next_end(0.0) == pytest.approx(0.002)


def test_no_tiny_step_remains_before_an_output_time() -> None:
    control = ToleranceControl(0.01, 0.1, 1.0, 0.05, [], 1e-6)
    assert control.next_end(0.035) == pytest.approx(0.0425)
    # a shortened step does not shorten later ones
    assert control.accept(0.0075, 0.9, 2)
    assert control.factor * control.step == pytest.approx(0.0075 * 0.85 / 0.9**0.5)
    assert control.accept(0.0001, 1e-6, 2)
    assert control.factor * control.step >= 0.0067


def test_after_a_repeated_step_in_contact_the_next_is_not_longer() -> None:
    for touches in (False, True):
        control = ToleranceControl(0.01, 0.1, 1.0, None, [], 1e-6)
        assert not control.accept(0.01, 3.0, 2, touches=touches)
        assert control.accept(0.005, 0.01, 2, touches=touches)
        assert control.next_end(0.0) == pytest.approx(0.005 if touches else 0.01)
        assert control.accept(0.005, 0.01, 2, touches=touches)
        assert control.next_end(0.0) == pytest.approx(0.01)


def test_first_order_error_estimate_of_free_fall_is_exact(comm: MPI.Comm) -> None:
    """Backward Euler has an error of ½ g Δt² in every step, and the errors add up."""
    time = {"end": END, "step": "auto", "tolerance": 0.02}
    with simulated(comm, handles=[], time=time) as simulation:
        while not simulation.finished:
            simulation.step()
        fallen = shape(simulation)[:, 2]
        error = np.abs(fallen + 0.5 * 9.81 * END**2).max() / SIZE
        assert simulation.accuracy is not None
        assert simulation.accuracy.estimated == pytest.approx(error, rel=0.02)
        assert error < 1.2 * 0.02


def test_round_off_of_the_time_causes_no_tiny_step() -> None:
    control = StepControl(0.1, 0.3, None, [], 1e-5)
    assert control.next_end(0.2 - 1e-9) == 0.3
    assert control.next_end(0.1 - 1e-9) == pytest.approx(0.2 - 1e-9, abs=1e-15)


def test_no_tiny_step_is_left_between_times_on_which_steps_end() -> None:
    """Of frames in single precision beside states, and of frames at 29.97 Hz."""
    for frames, every, least in (
        (np.arange(1, 30, dtype=np.float32) * np.float32(0.03), 0.03, 0.99),
        (np.arange(1, 300) / 29.97, None, 0.1),
        ([0.5, 0.5 + 1e-9, 0.7], 0.5 - 1e-9, 0.99),
    ):
        control, ends = StepControl(0.01, 10.0, every, map(float, frames), 1e-6), [0.0]
        while ends[-1] < 0.9:
            ends.append(control.next_end(ends[-1]))
        assert np.diff(ends).min() > least * 0.01
        assert np.diff(ends).max() < 1.0001 * 0.01
        for frame in frames:
            assert frame > 0.9 or np.abs(np.array(ends) - frame).min() < 1e-8
        assert every is None or sum(map(control.writes_at, ends)) == int(0.9 / every + 1e-5) + 1


@pytest.mark.parametrize("every", [None, 0.04, 0.1, 0.03, 2.0])
@pytest.mark.parametrize("step", [0.01, 0.03, 0.25, 1.0])
def test_the_planned_number_of_steps_is_that_of_a_run(step: float, every: float | None) -> None:
    control = StepControl(step, 1.0, every, [0.015, 0.5, 0.7, 3.0], 1e-5)
    time, steps, states = 0.0, 0, 1
    while not control.is_end(time):
        time, steps = control.next_end(time), steps + 1
        states += control.writes_at(time)
    assert control.planned_steps() == steps
    assert every is None or states == math.ceil(1.0 / every - 1e-9) + 1


@pytest.mark.parametrize("step", [0.01, 0.004, 0.3])
def test_steps_end_at_the_same_times_however_often_states_are_written(step: float) -> None:
    """To the last digit, if the interval is a multiple of the step."""

    def ends(every: float | None) -> list[float]:
        control, times = StepControl(step, 60.0 * step, every, [], 1e-9), [0.0]
        while not control.is_end(times[-1]):
            times.append(control.next_end(times[-1]))
        return times

    for multiple in (1, 2, 3, 5, 20):
        assert ends(multiple * step) == ends(None)
