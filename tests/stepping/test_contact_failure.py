"""Contact that a step cannot resolve: failures that name the obstacle and the place, and fast obstacles."""

from __future__ import annotations

from typing import Any

import pytest
from mpi4py import MPI
from physics import grid, scene_of

from lyra_petsc.errors import SolverError
from lyra_petsc.stepping.simulation import SteppedScene

pytestmark = pytest.mark.parallel(2)

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


def test_the_obstacle_that_blocks_a_sheet_is_named(comm: MPI.Comm) -> None:
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
    assert failure.near.obstacle in SHEET["obstacles"] | {"plate": PLATE}
    # between the floor and where the plate began
    assert -0.01 < failure.near.position[2] < 0.03
    assert 0.0 < failure.near.gap < 1e-3
    assert f"{failure.near.text} {failure.near.gap:.3g} m apart" in text
    assert f"and the obstacle '{failure.near.obstacle}', around (" in text
    assert "try more space for the sheet: other or slower motions of obstacles and handles" in text
    assert failure.content()["near"]["obstacle"] == failure.near.obstacle
    assert simulation.energy_balance.columns()["smallest_gap"] > 0.0
    simulation.destroy()


def test_a_load_step_in_which_a_plate_reaches_the_sheet_is_repeated(comm: MPI.Comm) -> None:
    """Contact forces are not finite in the first attempt; smaller increments succeed."""
    scene = SHEET | {
        "obstacles": {"plate": {"plane": {"point": [0, 0, 0.03], "normal": [0, 0, -1]}, "motion": "press"}},
        "gravity": [0, 0, 0],
        "handles": [{"nodes": [0, 1]}],
        "motions": {"press": [{"time": 0.0}, {"time": 1.0, "translate": [0, 0, -0.04]}]},
        "time": {"analysis": "static", "end": 1.0, "step": 1.0},
    }
    simulation = SteppedScene(comm, scene_of(scene))
    for _ in range(2):
        simulation.step()
    assert simulation.totals["rejected"] > 1
    assert 0.5 < simulation.time < 0.75  # before the plate is where the sheet is held
    simulation.destroy()


def test_moving_obstacles_do_work(comm: MPI.Comm) -> None:
    floor = {"plane": {"point": [0, 0, -0.0199], "normal": [0, 0, 1]}, "motion": "lift"}
    scene = SHEET | {
        "obstacles": {"floor": floor},
        "motions": {"lift": [{"time": 0.0}, {"time": 0.1, "translate": [0, 0, 0.01]}]},
    }
    lost = []
    for step in (0.005, 0.0005):
        simulation = SteppedScene(comm, scene_of(scene | {"time": {"end": 0.1, "step": step}}))
        before = simulation.budget.total
        take_all_steps(simulation)
        budget = simulation.budget
        assert budget.potential == pytest.approx(0.2 * 9.81 * 0.01, rel=0.2)
        lost.append(budget.external_work - (budget.total - before) - budget.dissipation)
        simulation.destroy()
    # dissipation of backward Euler while the sheet swings on the barrier
    assert 0.0 < 2.0 * lost[1] < lost[0]


BALL: dict[str, Any] = {
    "mesh": grid(1.0, 1.0, 4, 4) | {"transform": {"translate": [-0.5, -0.48, 0.35]}},
    "contact": {"gap": 0.02},
    "obstacles": {
        "it": {"sphere": {"center": [0, 0, 0], "radius": 0.3}, "motion": "up", "interpolation": "linear"}
    },
}


@pytest.mark.parametrize("integrator", ["bdf2", "alpha2"])
def test_initial_accelerations_exclude_obstacles_that_come_later(comm: MPI.Comm, integrator: str) -> None:
    """At the stage of the first step the ball is where the sheet was at the start."""
    scene = BALL | {
        "motions": {"up": [{"time": 0.0}, {"time": 1.0, "translate": [0, 0, 100.0]}]},
        "time": {"end": 0.0025, "step": 0.0025, "integrator": integrator},
    }
    simulation = SteppedScene(comm, scene_of(scene))
    take_all_steps(simulation)
    assert simulation.energy_balance.columns()["smallest_gap"] > 0.0
    assert simulation.budget.kinetic > 0.1
    simulation.destroy()


@pytest.mark.parametrize("integrator", ["beuler", "midpoint"])
def test_a_fast_obstacle_takes_the_sheet_with_it(comm: MPI.Comm, integrator: str) -> None:
    """A ball moves by many gaps in a step, through the sheet's old place; its work is that of its force."""
    speed, step = 20.0, 0.005
    scene = BALL | {
        "motions": {"up": [{"time": 0.0}, {"time": 1.0, "translate": [0, 0, speed]}]},
        "time": {"end": 4 * step, "step": step, "integrator": integrator},
    }
    simulation = SteppedScene(comm, scene_of(scene))
    take_all_steps(simulation)
    budget = simulation.budget
    assert 0.2 * 0.5 * 0.2 * speed**2 < budget.external_work < 4.0 * 0.5 * 0.2 * speed**2
    assert budget.total + budget.dissipation < 1.02 * budget.external_work
    middle = simulation.problem.equations.x[:, 2].max(initial=-1.0)
    assert comm.allreduce(middle, MPI.MAX) > 0.3 + speed * 4 * step
    simulation.destroy()


ON_A_TABLE: dict[str, Any] = {
    "mesh": grid(1.0, 1.0, 6, 6, "alternating") | {"transform": {"translate": [-0.5, -0.5, 0.05]}},
    "material": {"cloth": "gray-interlock"},
    "contact": {"gap": 0.02},
    "obstacles": {"it": {"box": {"min": [-0.3, -0.3, -0.05], "max": [0.3, 0.3, 0]}}},
    "initial": {"velocity": [0, 0, -5.0]},
}


@pytest.mark.parametrize(("integrator", "step"), [("bdf2", 0.001), ("alpha2", 0.02), ("midpoint", 0.005)])
def test_impacts_create_no_energy(comm: MPI.Comm, integrator: str, step: float) -> None:
    """Histories of other integrators are not valid across an impact; backward Euler takes these steps."""
    time = {"end": 0.04, "step": step, "integrator": integrator}
    simulation = SteppedScene(comm, scene_of(ON_A_TABLE | {"time": time}))
    start, most = simulation.budget.total, 0.0
    while not simulation.finished:
        simulation.step()
        most = max(most, simulation.budget.total + simulation.budget.dissipation)
        assert simulation.problem.equations.integrator.name == integrator
    assert most < 1.005 * start
    if integrator == "bdf2":  # backward Euler takes the long steps of the others, and some energy
        assert simulation.budget.total + simulation.budget.dissipation > 0.8 * start
    simulation.destroy()


@pytest.mark.parametrize("integrator", ["alpha2", "semi-implicit"])
def test_adaptive_steps_are_not_shortened_without_end_by_an_impact(comm: MPI.Comm, integrator: str) -> None:
    scene = BALL | {
        "obstacles": {"it": {"sphere": {"center": [0, 0, 0], "radius": 0.3}}},
        "initial": {"velocity": [0, 0, -100.0]},
        "time": {"end": 0.001, "step": "auto", "tolerance": 1e-4, "integrator": integrator},
    }
    simulation = SteppedScene(comm, scene_of(scene))
    start = simulation.budget.total
    while not simulation.finished:
        simulation.step()
        assert simulation.budget.total < 1.01 * start
    assert simulation.step_number < 1000
    simulation.destroy()


def test_an_obstacle_that_turns_past_the_sheet_is_stopped(comm: MPI.Comm) -> None:
    """A blade turns by 120° in a step; before and after it, it is on different sides of the sheet's edge."""
    blade = {"capsule": {"from": [-0.1, 0, 0], "to": [0.5, 0, 0], "radius": 0.01}, "motion": "turn"}
    scene = {
        "mesh": grid(0.2, 0.2, 2, 2)
        | {"transform": {"rotate": {"axis": [1, 0, 0], "degrees": 90}, "translate": [-0.1, 0.42, -0.1]}},
        "contact": {"gap": 0.02},
        "obstacles": {"blade": blade | {"interpolation": "linear"}},
        "motions": {
            "turn": [{"time": 0.0, "rotate": {"axis": [0, 0, 1], "degrees": 30}},
                     {"time": 1.0, "rotate": {"axis": [0, 0, 1], "degrees": 30 + 1200}}],
        },
        "time": {"end": 0.1, "step": 0.1},
    }  # fmt: skip
    simulation = SteppedScene(comm, scene_of(scene))
    take_all_steps(simulation)
    assert simulation.totals["rejected"] > 0
    # the blade has hit the sheet
    assert simulation.budget.kinetic > 0.01
    simulation.destroy()


def test_the_nearest_obstacle_is_named_even_if_sheets_are_nearer(comm: MPI.Comm) -> None:
    far, near = ({"floor": {"plane": {"point": [0, 0, z], "normal": [0, 0, 1]}}} for z in (-9.0, -0.015))
    other = SHEET["mesh"] | {"transform": {"translate": [0.1, 0.1, 0.006]}}
    scene = SHEET | {"mesh": [SHEET["mesh"], other], "time": {"end": 0.1, "step": 0.001}}
    for obstacles, name in ((far, None), (near, "floor")):
        simulation = SteppedScene(comm, scene_of(scene | {"obstacles": obstacles}))
        simulation.step()
        equations = simulation.problem.equations
        report = equations.contact.report(equations.evaluated.x, equations.step.frozen)
        nearest, obstacle = report.nearest(), report.nearest_obstacle()
        assert nearest is not None
        assert not nearest.obstacle
        assert (None if obstacle is None else obstacle.obstacle) == name
        assert simulation.energy_balance.columns()["friction_work"] == 0.0
        simulation.destroy()
