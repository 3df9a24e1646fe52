"""A sheet that is squeezed to nothing ends the run with what is in the way, and where."""

from __future__ import annotations

from typing import Any

import pytest
from mpi4py import MPI
from physics import grid, scene_of

from lyra_petsc.errors import SolverError
from lyra_petsc.stepping.simulation import SteppedScene

pytestmark = pytest.mark.parallel

SHEET: dict[str, Any] = {
    "mesh": grid(1.0, 1.0, 3, 3),
    "gravity": [0, 0, -9.81],
    "contact": {"gap": 0.02},
    "obstacles": {"floor": {"plane": {"point": [0, 0, -0.01], "normal": [0, 0, 1]}}},
}
PLATE = {"box": {"min": [-0.2, -0.2, 0.03], "max": [1.2, 1.2, 0.1]}, "motion": "press"}


def take_all_steps(simulation: SteppedScene) -> None:
    while not simulation.finished:
        simulation.step()


def test_what_is_in_the_way_is_named(comm: MPI.Comm) -> None:
    press = [{"time": 0.0}, {"time": 0.02, "translate": [0, 0, -0.2]}]
    scene = SHEET | {
        "obstacles": SHEET["obstacles"] | {"plate": PLATE},
        "motions": {"press": press},
        "time": {"end": 0.1, "step": 0.01},
    }
    simulation = SteppedScene(comm, scene_of(scene))
    with pytest.raises(SolverError) as caught:
        take_all_steps(simulation)
    failure, text = simulation.failure, str(caught.value)
    assert failure is not None
    assert failure.near is not None
    assert comm.allgather(text) == [text] * comm.size
    assert failure.near.blocks
    assert failure.near.obstacle == "plate"
    # between the floor and where the plate began
    assert -0.01 < failure.near.position[2] < 0.03
    assert 0.0 < failure.near.gap < 1e-3
    assert f"{failure.near.words} {failure.near.gap:.3g} m apart" in text
    assert "and the obstacle 'plate', around (" in text
    assert "try more room for the sheet: obstacles.plate.motion must leave it some" in text
    assert failure.content()["near"]["obstacle"] == "plate"
    assert simulation.ledger.columns()["smallest_gap"] > 0.0
    simulation.destroy()


def test_what_moves_does_work(comm: MPI.Comm) -> None:
    floor = {"plane": {"point": [0, 0, -0.0199], "normal": [0, 0, 1]}, "motion": "lift"}
    scene = SHEET | {
        "obstacles": {"floor": floor},
        "motions": {"lift": [{"time": 0.0}, {"time": 0.1, "translate": [0, 0, 0.01]}]},
    }
    lost = []
    for step in (0.005, 0.00125):
        simulation = SteppedScene(comm, scene_of(scene | {"time": {"end": 0.1, "step": step}}))
        before = simulation.budget.total
        take_all_steps(simulation)
        budget = simulation.budget
        assert budget.potential == pytest.approx(0.2 * 9.81 * 0.01, rel=0.2)
        lost.append(budget.external_work - (budget.total - before))
        simulation.destroy()
    # what backward Euler loses while the sheet swings on the barrier
    assert 0.0 < 2.0 * lost[1] < lost[0]
