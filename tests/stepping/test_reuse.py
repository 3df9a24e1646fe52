"""Preconditioners that are reused in several steps."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, grid, shape, stepped

from lyra_petsc.stepping.newton.linear_system import SET_UP, Reuse

MASK = np.zeros((1, 3), dtype=bool)


def system(c: float = 0.01, mask: object = MASK) -> Any:
    return SimpleNamespace(stage=SimpleNamespace(c=c), prescribed=SimpleNamespace(mask=mask))


def test_a_preconditioner_is_kept_until_the_average_cost_would_grow() -> None:
    reuse, kept = Reuse(enabled=True), []
    for iterations in (10, 11, 12, 13, 14, 15, 16, 17):
        kept.append(reuse.begin_solve(system()))
        reuse.end_solve(iterations)
    # (8 + 10 + 11 + 12 + 13) / 4 = 13.5 > 13, (54 + 14) / 5 = 13.6 < 14
    assert SET_UP == 8.0
    assert kept == [False, True, True, True, True, False, True, True]


def test_another_step_length_or_other_prescribed_unknowns_need_a_new_one() -> None:
    reuse = Reuse(enabled=True)
    for other in (system(), system(c=0.02), system(0.02, MASK.copy()), system(mask=MASK)):
        assert not reuse.begin_solve(other)
        reuse.end_solve(10)
        assert reuse.begin_solve(other)
        reuse.end_solve(10)
    never = Reuse(enabled=False)
    never.end_solve(10)
    assert not never.begin_solve(system())


@pytest.mark.parallel(2)
@pytest.mark.parametrize("kind", ["", "pbjacobi", "gamg"])
def test_steps_equal_those_with_a_preconditioner_per_step(comm: MPI.Comm, kind: str) -> None:
    scene = {
        "mesh": grid(0.6, 0.4, 6, 5, "alternating"),
        "material": CLOTH | {"bending": 1e-4, "damping": 0.01},
        "gravity": [0, 0, -9.81],
        "handles": [{"nodes": [0]}, {"nodes": [6], "from": 0.05, "until": 0.15}],
        "time": {"end": 0.3, "step": 0.01, "integrator": "semi-implicit"},
    }
    ends = []
    for lag in (None, 1):
        given = ({"pc_type": kind} if kind else {}) | ({"snes_lag_preconditioner": lag} if lag else {})
        with stepped(comm, scene, **given) as simulation:
            reused = 0
            while not simulation.finished:
                simulation.step()
                reused += simulation.stepper.linear.reuse.reused
            assert (reused > 10) == (lag is None)
            ends.append(shape(simulation))
    # the linear tolerance of a step is 1e-6 of its change of velocities
    np.testing.assert_allclose(*ends, atol=1e-6)
