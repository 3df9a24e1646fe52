"""Wall times of the phases of a run."""

import numba
import pytest
from petsc4py import PETSc

from lyra_petsc.kernels.compilation import COMPILATION
from lyra_petsc.phases import COMPILE, Phases


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_time_of_a_nested_phase_is_not_counted_in_the_outer_one():
    clock = Clock()
    phases = Phases(clock)
    clock.now += 1
    with phases("solve"):
        clock.now += 2
        with phases("assembly"):
            clock.now += 4
        clock.now += 8
    clock.now += 16
    assert phases.seconds() == {"solve": 10.0, "assembly": 4.0, "other": 17.0}
    assert sum(phases.seconds().values()) == phases.total == 31.0


def test_the_current_phase_is_included_and_phases_accumulate():
    clock = Clock()
    phases = Phases(clock)
    for _ in range(3):
        with phases("output"):
            clock.now += 1
    with phases("solve"):
        clock.now += 5
        assert phases.seconds() == {"output": 3.0, "solve": 5.0, "other": 0.0}


def test_an_exception_ends_its_phase():
    clock = Clock()
    phases = Phases(clock)
    with pytest.raises(RuntimeError):
        fail_inside(phases, clock)
    clock.now += 2
    assert phases.seconds() == {"solve": 1.0, "other": 2.0}


def fail_inside(phases: Phases, clock: Clock) -> None:
    with phases("solve"):
        clock.now += 1
        raise RuntimeError


def test_compilation_of_a_kernel_is_a_phase_and_an_event(monkeypatch: pytest.MonkeyPatch) -> None:
    phases = Phases()
    monkeypatch.setattr(COMPILATION, "begins", phases.begin_compilation)
    monkeypatch.setattr(COMPILATION, "ends", phases.end_compilation)
    PETSc.Log.begin()
    before = COMPILE.getPerfInfo()["count"]
    assert numba.njit(lambda number: number + 1)(2) == 3
    assert COMPILE.getPerfInfo()["count"] == before + 1
    assert 0.0 < phases.seconds()["compilation"] <= phases.total
