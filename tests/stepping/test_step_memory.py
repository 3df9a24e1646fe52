"""Temporary memory of a step."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import grid, scene_of

from lyra_petsc.stepping.simulation import SteppedScene


def hanging(n: int) -> SteppedScene:
    content: dict[str, Any] = {
        "mesh": grid(1.0, 1.0, n, n, "alternating"),
        "material": {"cloth": "gray-interlock", "bending_model": "midedge", "damping": 0.03},
        "handles": [{"nodes": [0, n]}],
        "gravity": [0.0, 0.0, -9.81],
        "time": {"end": 1.0, "step": 0.005, "integrator": "semi-implicit"},
    }
    return SteppedScene(MPI.COMM_SELF, scene_of(content))


def end(simulation: SteppedScene) -> None:
    simulation.destroy()
    for name in simulation.stepper.our_options:
        PETSc.Options().delValue(name)


def test_parts_of_the_forces_are_computed_one_at_a_time() -> None:
    simulation = hanging(4)
    simulation.step()
    parts = simulation.problem.system.forces_at_stage()
    seen: list[tuple[str, Any]] = []
    for name, part in parts:
        assert all(gone() is None for _, gone in seen)
        seen.append((name, weakref.ref(part)))
        del part
    assert [name for name, _ in seen] == ["inertia", "loads", "damping", "internal"]
    end(simulation)


def test_a_new_state_does_not_overwrite_the_old_arrays() -> None:
    simulation = hanging(2)
    state = simulation.problem.system.state
    x, kept = state.x, state.x.copy()
    state.set(x + 1.0, state.v)
    np.testing.assert_array_equal(x, kept)
    np.testing.assert_array_equal(state.x, kept + 1.0)
    end(simulation)


def test_forces_at_the_end_of_a_linear_step_are_reused_in_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are computed once per step, with the frames of its end, and again after a rejected step."""
    simulation = hanging(4)
    simulation.step()
    term, system = simulation.problem.terms["midedge"], simulation.problem.system
    asked: list[int] = []
    compute = term.add_gradient
    monkeypatch.setattr(term, "add_gradient", lambda *given: (asked.append(1), compute(*given)))
    for _ in range(3):
        asked.clear()
        simulation.step()
        assert len(asked) == 1
        assert system.evaluated.internal is not None
        found = system.gradient_of(system.active.sheet, system.x)
        np.testing.assert_allclose(system.evaluated.internal, found, rtol=0.0, atol=1e-15)
        assert term.frames is system.active.frozen[term]
    assert simulation.guard is not None
    verdicts, accept = iter([False, True]), simulation.guard.accept
    monkeypatch.setattr(
        simulation.guard, "accept", lambda *given, **how: accept(*given, **how) and next(verdicts)
    )
    asked.clear()
    assert simulation.step().rejected == 1
    assert len(asked) == 3
    end(simulation)
