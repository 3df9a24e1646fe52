"""Parts that collide separate with a tenth of their speed under every integrator, and come to rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, end_on_one_rank, finished, grid, scene_of, shape

from lyra_petsc.stepping.simulation import SteppedScene

pytestmark = pytest.mark.parallel(3)

SPEED, END = 0.5, 0.12
FLOOR: dict[str, Any] = {"plane": {"point": [0.0, 0.0, -0.021], "normal": [0.0, 0.0, 1.0]}}
UP = [{"time": 0.0}, {"time": 1.0, "translate": [0.0, 0.0, SPEED]}]
SLOWLY = [{"time": 0.0}, {"time": 1.0, "translate": [0.0, 0.0, 0.02]}]


def impact(integrator: str, step: float, *, floor_moves: bool) -> dict[str, Any]:
    """A weightless sheet that is thrown at a floor, or hit by a moving floor."""
    meets = {"motion": UP, "interpolation": "linear"} if floor_moves else {}
    return {
        "mesh": grid(0.4, 0.3, 3, 2),
        "initial": {"velocity": [0.0, 0.0, 0.0 if floor_moves else -SPEED]},
        "contact": {"gap": 0.02, "self": False},
        "obstacles": {"floor": FLOOR | meets},
        "time": {"end": END, "step": step, "integrator": integrator},
    }


@pytest.mark.parallel(1)
@pytest.mark.parametrize("floor_moves", [False, True])
@pytest.mark.parametrize(("integrator", "step"), [("beuler", 5e-4), ("alpha2", 1e-3), ("bdf2", 1e-3)])
def test_colliding_parts_hardly_rebound(
    comm: MPI.Comm, integrator: str, step: float, floor_moves: bool
) -> None:
    simulation = SteppedScene(comm, scene_of(impact(integrator, step, floor_moves=floor_moves)))
    equations, n = simulation.problem.equations, simulation.problem.points.n_owned
    before, impulse = simulation.budget.total, 0.0
    while not simulation.finished:
        taken = simulation.step()
        impulse -= taken.dt * float(simulation.energy_balance.obstacle_forces(1)[0, 2])
    own = float(equations.mass.sum()), float(equations.mass @ equations.v[:n, 2])
    mass, momentum = (float(value) for value in equations.points.global_sum(*own))
    budget = simulation.budget
    simulation.destroy()
    floor = SPEED if floor_moves else 0.0
    assert momentum / mass - floor == pytest.approx(0.1 * SPEED, rel=0.15)
    assert momentum + (0.0 if floor_moves else mass * SPEED) == pytest.approx(impulse, rel=0.01)
    unexplained = budget.total + budget.dissipation - budget.external_work - before
    # backward Euler, which takes the first steps of all, damps by itself, too
    assert abs(unexplained) < (0.08 if integrator == "beuler" else 0.02) * 0.5 * mass * SPEED**2


@pytest.mark.parallel(1)
@pytest.mark.parametrize("integrator", ["midpoint", "bdf2", "beuler"])
def test_small_gaps_need_no_more_steps(comm: MPI.Comm, integrator: str) -> None:
    """A sheet falls on a ball by hundreds of gaps per step, and vertices touch it in each step."""
    ball = {"sphere": {"center": [0.0, 0.0, -0.302], "radius": 0.3}}
    scene = {
        "mesh": grid(0.6, 0.6, 8, 8) | {"transform": {"translate": [-0.3, -0.28, 0.0]}},
        "material": CLOTH,
        "initial": {"velocity": [0.0, 0.0, -1.0]},
        "contact": {"gap": 1e-5, "self": False},
        "obstacles": {"ball": ball},
        "time": {"end": 0.04, "step": 0.005, "integrator": integrator},
    }
    simulation = SteppedScene(comm, scene_of(scene))
    before = simulation.budget.total
    while not simulation.finished:
        simulation.step()
    assert simulation.energy_balance.columns()["contacts"] > 2
    assert simulation.budget.total < before
    assert simulation.step_number == 8
    simulation.destroy()


@pytest.mark.parallel(alone=False)
def test_impacts_do_not_depend_on_ranks(comm: MPI.Comm, shared_tmp: Path) -> None:
    scene = scene_of(impact("bdf2", 1e-3, floor_moves=True))
    with finished(comm, scene) as simulation:
        x = shape(simulation)
    if (alone := end_on_one_rank(comm, scene, shared_tmp / "run", 20)) is not None:
        np.testing.assert_allclose(x, alone, rtol=0.0, atol=1e-9)


@pytest.mark.parallel(1)
def test_automatic_steps_at_their_minimum_are_not_repeated() -> None:
    """The shortest step follows the largest velocity, which differs from that when the step was planned."""
    turned = {"rotate": {"axis": [0, 1, 0], "degrees": 20}, "translate": [-0.15, -0.15, 0.108]}
    content = {
        "mesh": grid(0.3, 0.3, 8, 8, "alternating") | {"transform": turned},
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "initial": {"velocity": [0.0, 0.0, -1.4]},
        "contact": {"gap": 0.003, "friction": 0.4},
        "obstacles": {"floor": {"plane": {"point": [0, 0, 0], "normal": [0, 0, 1]}}},
        "time": {"end": 0.8, "step": "auto", "tolerance": 1e-2, "integrator": "beuler"},
    }
    simulation = SteppedScene(MPI.COMM_SELF, scene_of(content))
    while simulation.time < 0.008:
        simulation.step()
    steps, repeated = simulation.step_number, simulation.totals["rejected"]
    simulation.destroy()
    assert steps > 100
    assert repeated < 0.2 * steps


@pytest.mark.parallel(1)
@pytest.mark.parametrize("integrator", ["midpoint", "alpha2"])
def test_contacts_reached_after_the_stage_are_noticed_in_the_same_step(integrator: str) -> None:
    """In an adaptive step from outside the gap deep into it, not only in the next step."""
    content = {
        "mesh": grid(0.3, 0.3, 8, 8, "alternating") | {"transform": {"translate": [-0.15, -0.15, 0.02]}},
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "gravity": [0.0, 0.0, -9.81],
        "contact": {"gap": 0.003, "friction": 0.4},
        "obstacles": {"floor": {"plane": {"point": [0, 0, 0], "normal": [0, 0, 1]}}},
        "time": {"end": 0.6, "step": "auto", "tolerance": 1e-3, "integrator": integrator},
    }
    simulation = SteppedScene(MPI.COMM_SELF, scene_of(content))
    while not simulation.finished:
        simulation.step()
    x, steps = simulation.problem.equations.x.copy(), simulation.step_number
    simulation.destroy()
    assert steps < 300
    assert (x[:, 2] > 0.0).all()
    assert (x[:, 2] < 0.003).all()


@pytest.mark.parallel(1)
@pytest.mark.parametrize("integrator", ["midpoint", "alpha2"])
@pytest.mark.parametrize("floor_moves", [False, True])
def test_bdf2_takes_the_first_step_in_contact_with_its_history(integrator: str, floor_moves: bool) -> None:
    scene = impact(integrator, 1e-3, floor_moves=floor_moves)
    slow: dict[str, Any] = {"initial": {"velocity": [0.0, 0.0, -0.02]}}
    if floor_moves:
        slow = {"obstacles": {"floor": scene["obstacles"]["floor"] | {"motion": SLOWLY}}}
    simulation = SteppedScene(MPI.COMM_SELF, scene_of(scene | slow))
    integrators, rejected = simulation.problem.equations.integrators, 0
    while simulation.energy_balance.columns()["contacts"] == 0.0:
        past = len(integrators.in_contact.saved_state()[0])
        rejected = simulation.step().rejected
    taken, number = simulation.last_integrator.name, simulation.step_number
    simulation.destroy()
    assert (taken, rejected, past, number > 10) == ("bdf2", 1, 4, True)


@pytest.mark.parametrize(
    ("integrator", "step", "largest"),
    [
        *((name, 0.002, 0.05) for name in ("midpoint", "alpha2")),
        ("bdf2", 0.001, 0.05),
        ("midpoint", 0.0002, 0.03),
        ("beuler", 0.0002, 0.01),
        ("midpoint", 0.02, 0.05),
    ],
)
def test_a_sheet_that_lands_obliquely_is_not_thrown_back(
    comm: MPI.Comm, integrator: str, step: float, largest: float
) -> None:
    """Friction stops it, as the impulse of the floor is large enough; its springs would reverse its speed."""
    content = {
        "mesh": grid(0.1, 0.1, 3, 3) | {"transform": {"translate": [0.0, 0.0, 0.02]}},
        "material": CLOTH | {"bending": 1e-4, "damping": 0.0},
        "gravity": [0.0, 0.0, -9.81],
        "initial": {"velocity": [SPEED, 0.0, -3.8]},
        "contact": {"gap": 0.005, "friction": 0.5, "self": False},
        "obstacles": {"floor": {"plane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}}},
        "time": {"end": 0.025 + 10.0 * step, "step": step, "integrator": integrator},
    }
    simulation = SteppedScene(comm, scene_of(content))
    equations, n = simulation.problem.equations, simulation.problem.points.n_owned
    back = 0.0
    while not simulation.finished:
        simulation.step()
        mean = float(equations.points.global_sum(float(equations.v[:n, 0].sum()))[0]) / 16
        back = max(back, -mean)
    stays = comm.allreduce(float(np.abs(equations.v[:n, 0]).max(initial=0.0)), MPI.MAX)
    simulation.destroy()
    assert back < largest * SPEED
    assert stays < max(largest, 0.01) * SPEED


@pytest.mark.parametrize("step", [0.001, 0.004])
@pytest.mark.parametrize("integrator", ["midpoint", "alpha2"])
def test_an_oblique_impact_is_slowed_by_friction(comm: MPI.Comm, integrator: str, step: float) -> None:
    """By friction times the change of the normal speed, though the gap is passed within a few steps."""
    friction = 0.3
    content = {
        "mesh": grid(0.2, 0.2, 8, 8, "alternating") | {"transform": {"translate": [0.0, 0.0, 0.00587]}},
        "material": CLOTH | {"bending": 1e-4, "damping": 0.0},
        "initial": {"velocity": [2.0, 0.0, -1.0]},
        "contact": {"gap": 0.002, "friction": friction, "self": False},
        "obstacles": {"floor": {"plane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}}},
        "time": {"end": 0.06, "step": step, "integrator": integrator},
    }
    simulation = SteppedScene(comm, scene_of(content))
    equations, n = simulation.problem.equations, simulation.problem.points.n_owned
    while not simulation.finished:
        simulation.step()
    mass, *momentum = equations.points.global_sum(
        float(equations.mass.sum()), *(equations.mass @ equations.v[:n])
    )
    along, _, normal = momentum / mass
    simulation.destroy()
    assert 2.0 - along == pytest.approx(friction * (normal + 1.0), rel=1e-4)


@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit", "bdf2", "alpha2"])
def test_a_sheet_at_rest_on_an_accelerating_floor_is_pressed_but_not_damped(
    comm: MPI.Comm, integrator: str
) -> None:
    """Its velocity at the end of a step differs from the floor's mean velocity, its place at the stage from
    that of the floor on its curved path.
    """
    acceleration, gravity, end = 5.0, 9.81, 0.3
    up = {"time": end, "velocity": [0.0, 0.0, acceleration * end]}
    up["translate"] = [0.0, 0.0, 0.5 * acceleration * end**2]
    content = {
        "mesh": grid(0.2, 0.2, 4, 4) | {"transform": {"translate": [0.0, 0.0, 0.00187]}},
        "material": CLOTH | {"bending": 1e-4, "damping": 0.0},
        "gravity": [0.0, 0.0, -gravity],
        "contact": {"gap": 0.002, "self": False},
        "obstacles": {
            "floor": {"plane": {"point": [0, 0, 0], "normal": [0, 0, 1]}, "motion": [{"time": 0.0}, up]}
        },
        "time": {"end": end, "step": 0.01, "integrator": integrator},
    }
    simulation = SteppedScene(comm, scene_of(content))
    equations = simulation.problem.equations
    while not simulation.finished:
        simulation.step()
    budget, (mass,) = simulation.budget, equations.points.global_sum(float(equations.mass.sum()))
    force = -float(simulation.energy_balance.obstacle_forces(1)[0, 2])
    simulation.destroy()
    assert force == pytest.approx(mass * (gravity + acceleration), rel=1e-3)
    work = mass * (gravity + acceleration) * 0.5 * acceleration * end**2
    assert budget.external_work == pytest.approx(work, rel=1e-3)
    assert abs(budget.dissipation) < 1e-3 * work


@pytest.mark.parallel(2)
@pytest.mark.parametrize("speed", [1.0, 10.0])
@pytest.mark.parametrize("floor_moves", [False, True])
def test_steps_of_semi_implicit_in_contact_are_those_of_backward_euler(
    comm: MPI.Comm, speed: float, floor_moves: bool
) -> None:
    """One linear solve with the forces where a step starts would press the sheet far into the gap."""
    forces = []
    for integrator in ("semi-implicit", "beuler"):
        content = impact(integrator, 0.01, floor_moves=False)
        content["contact"]["gap"] = 0.002
        if floor_moves:
            rises = [{"time": 0.0}, {"time": 1.0, "translate": [0.0, 0.0, speed]}]
            content["obstacles"]["floor"] |= {"motion": rises, "interpolation": "linear"}
        else:
            content["initial"]["velocity"] = [0.0, 0.0, -speed]
        simulation = SteppedScene(comm, scene_of(content))
        forces.append([])
        while not simulation.finished:
            simulation.step()
            forces[-1].append(float(simulation.energy_balance.obstacle_forces(1)[0, 2]))
        simulation.destroy()
    once, iterated = np.array(forces)
    largest = np.abs(iterated).max()
    assert largest > 0.0
    np.testing.assert_allclose(once, iterated, atol=1e-3 * largest)


def test_a_spinning_rod_without_friction_acts_as_one_at_rest(comm: MPI.Comm) -> None:
    """Mean velocities in a step of backward Euler, chords of the rod's motion, lead into the sheet."""
    ends, spin = {"from": [-1.0, 0.0, 0.0], "to": [1.0, 0.0, 0.0], "radius": 0.1}, {"axis": [1.0, 0.0, 0.0]}
    spins = [{"time": 0.0}, {"time": 1.0, "rotate": spin | {"degrees": 3600.0}}]
    shapes = []
    for motion in ({}, {"motion": spins, "interpolation": "linear"}):
        content = {
            "mesh": grid(0.2, 0.2, 8, 8) | {"transform": {"translate": [-0.1, -0.1, 0.102]}},
            "material": CLOTH | {"bending": 1e-4, "damping": 0.0},
            "gravity": [0.0, 0.0, -9.81],
            "contact": {"gap": 0.004, "self": False},
            "obstacles": {"rod": {"capsule": ends} | motion},
            "time": {"end": 0.05, "step": 0.002},
        }
        with finished(comm, scene_of(content)) as simulation:
            shapes.append(shape(simulation))
    np.testing.assert_allclose(shapes[1], shapes[0], rtol=0.0, atol=1e-5)
