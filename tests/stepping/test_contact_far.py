"""Cost of contact if nothing is near: the same solves as without contact, and few searches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, gathered, grid, scene_of

from lyra_petsc.contact.contact_search import ContactSearch
from lyra_petsc.stepping.simulation import SteppedScene

SCENE: dict[str, Any] = {
    "mesh": grid(0.5, 0.5, 12, 12),
    "material": CLOTH | {"damping": 0.01},
    "handles": [{"nodes": [0, 12]}],
    "gravity": [0.0, 0.0, -9.81],
}
FAR = {
    "contact": {"friction": 0.3},
    "obstacles": {"ball": {"sphere": {"center": [0.0, 0.0, -9.0], "radius": 0.3}}},
}
STEPS = 8


def timed(integrator: str) -> dict[str, Any]:
    return {"time": {"end": 1.0, "step": 0.005, "integrator": integrator}, "solver": {}}


def test_linear_solves_are_those_of_a_step_without_contact() -> None:
    found = []
    for more in ({}, FAR):
        simulation = SteppedScene(MPI.COMM_SELF, scene_of(SCENE | more | timed("semi-implicit")))
        linear = sum(simulation.step().linear_iterations for _ in range(STEPS))
        found.append((linear, gathered(simulation.problem.points, simulation.problem.equations.x)))
        simulation.destroy()
    assert found[1][0] == found[0][0]
    np.testing.assert_allclose(found[1][1], found[0][1], rtol=0.0, atol=1e-12)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["semi-implicit", "midpoint", "alpha2"])
def test_one_search_serves_several_steps(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch, integrator: str
) -> None:
    """If vertices move by more than the gap, gravity bends their paths, and forces are evaluated within the
    step: searches look 1, 2, 3, 4, 4, … steps ahead.
    """
    searches, search = 0, ContactSearch.near_pairs

    def counted(*given: Any) -> Any:
        nonlocal searches
        searches += 1
        return search(*given)

    monkeypatch.setattr(ContactSearch, "near_pairs", counted)
    thrown = {"handles": [], "initial": {"velocity": [0.0, 0.0, -6.0]}}
    simulation = SteppedScene(comm, scene_of(SCENE | FAR | thrown | timed(integrator)))
    searches = 0
    for _ in range(1 + 2 + 3 + 4 + 4):
        simulation.step()
    simulation.destroy()
    assert searches == 5


@pytest.mark.parametrize("integrator", ["midpoint", "alpha2"])
def test_falling_by_many_gaps_per_step_needs_no_shorter_steps(integrator: str) -> None:
    """The search before the step does not cover the displacement after the stage, hundreds of gaps."""
    falls = {"handles": [], "initial": {"velocity": [0.0, 0.0, -1.0]}, "contact": {"gap": 1e-5}}
    simulation = SteppedScene(MPI.COMM_SELF, scene_of(SCENE | FAR | falls | timed(integrator)))
    assert not sum(simulation.step().rejected for _ in range(STEPS))
    simulation.destroy()


@pytest.mark.parallel
@pytest.mark.parametrize("shape", ["sphere", "capsule"])
def test_an_obstacle_of_huge_radius_acts_as_a_plane(comm: MPI.Comm, shape: str) -> None:
    """With a distant centre, nearest points and distances lose digits."""
    radius, side = 1e4, 0.4
    ends = {"from": [-5.0, 0.0, -radius], "to": [5.0, 1.0, -radius]}
    place = ends if shape == "capsule" else {"center": [0.0, 0.0, -radius]}
    sheet = grid(side, side, 6, 6) | {"transform": {"translate": [-0.5 * side, -0.5 * side, 0.007]}}
    content = {
        "mesh": sheet,
        "material": {"cloth": "gray-interlock"},
        "gravity": [0.0, 0.0, -9.81],
        "contact": {"gap": 0.005, "friction": 0.3},
        "obstacles": {"hill": {shape: place | {"radius": radius}}},
        "time": {"end": 0.3, "step": 0.01},
        "solver": {},
    }
    simulation, iterations = SteppedScene(comm, scene_of(content)), []
    while not simulation.finished:
        step = simulation.step()
        assert not step.rejected
        iterations.append(step.newton_iterations)
    weight = 9.81 * comm.allreduce(float(simulation.problem.equations.mass.sum()))
    force = simulation.energy_balance.obstacle_forces(1)[0, :3]
    simulation.destroy()
    np.testing.assert_allclose(force, [0.0, 0.0, -weight], atol=1e-6 * weight)
    assert np.mean(iterations) < 3.0
