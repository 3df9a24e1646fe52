"""Equilibria with friction do not depend on the increments of the load, nor on the solvers' way to them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from physics import gathered, grid, scene_of

from lyra_petsc.stepping.simulation import SteppedScene

Array = NDArray[np.float64]

MEMBRANE = {"c11": 2000.0, "c22": 2000.0, "c12": 600.0, "c33": 700.0}
FLOOR = {"floor": {"plane": {"point": [0, 0, 0], "normal": [0, 0, 1]}}}
ROD = {"rod": {"capsule": {"from": [0.2, -0.5, 0.03], "to": [0.2, 0.5, 0.03], "radius": 0.03}}}


def clamped(
    obstacles: dict[str, Any], height: float, bending: float, weight: float, friction: float, model: str
) -> dict[str, Any]:
    """A sheet clamped at one side that lands on an obstacle under its weight [kg/m²]."""
    return {
        "mesh": grid(0.4, 0.08, 12, 2, "alternating") | {"transform": {"translate": [0, 0, height]}},
        "material": {
            "density": weight,
            "membrane": MEMBRANE,
            "bending": bending,
            "bending_model": model,
        },
        "gravity": [0, 0, -9.81],
        "handles": [{"box": [[-1, -1, -1], [0.05, 1, 1]]}],
        "contact": {"friction": friction, "gap": 2e-3, "self": False},
        "obstacles": obstacles,
        "time": {"analysis": "static", "step": 1.0},
    }


SCENES = {
    "plate on a plane, hinges": lambda: clamped(FLOOR, 0.05, 1e-3, 1.0, 0.3, "hinge"),
    "plate on a plane, midedge": lambda: clamped(FLOOR, 0.05, 1e-3, 1.0, 0.3, "midedge"),
    "cloth over a rod": lambda: clamped(ROD, 0.08, 2e-4, 0.187, 0.3, "midedge"),
    "soft cloth over a rough rod": lambda: clamped(ROD, 0.08, 5e-5, 0.187, 0.6, "hinge"),
}


@pytest.fixture
def options() -> Iterator[dict[str, str]]:
    """PETSc options of a run, removed at the end."""
    given: dict[str, str] = {}
    yield given
    for name in given:
        PETSc.Options().delValue(name)


def at_rest(
    comm: MPI.Comm, scene: dict[str, Any], options: dict[str, str], more: Mapping[str, str]
) -> tuple[Array, float, list[str]]:
    """Positions in mesh order at the end, energy [J] without friction, and notes."""
    for name, value in more.items():
        options[name] = value
        PETSc.Options().setValue(name, value)
    simulation = SteppedScene(comm, scene_of(scene))
    while not simulation.finished:
        simulation.step()
        normal, friction = simulation.energy_balance.obstacle_forces(1)[0, 6:]
        mu = scene["contact"]["friction"]
        assert friction <= mu * normal * (1.0 + 2e-6) + 1e-9
    equations = simulation.problem.equations
    terms = [
        term for term in equations.active.elastic if term.name in ("membrane", "hinge", "bending", "midedge")
    ]
    energy = sum(float(term.energies(equations.x, equations.step.frozen[term]).sum()) for term in terms)
    found = gathered(simulation.problem.points, equations.x), comm.allreduce(energy), simulation.notes
    simulation.destroy()
    return found


@pytest.mark.parallel(2)
@pytest.mark.parametrize("name", SCENES)
def test_default_increments_lead_to_the_energy_of_100(
    comm: MPI.Comm, name: str, options: dict[str, str]
) -> None:
    _, energy, _ = at_rest(comm, SCENES[name](), options, {})
    scene = SCENES[name]()
    scene["time"]["step"] = 0.01
    _, fine, _ = at_rest(comm, scene, options, {"ts_adapt_dt_max": "0.01"})
    assert energy == pytest.approx(fine, rel=1e-2)


@pytest.mark.parallel(2)
def test_friction_of_each_contact_is_at_most_mu_times_its_normal_force(comm: MPI.Comm) -> None:
    """On a plane each vertex has one contact; those of a plate that lands slide."""
    scene = SCENES["plate on a plane, hinges"]()
    simulation = SteppedScene(comm, scene_of(scene))
    while not simulation.finished:
        simulation.step()
    equations, terms = simulation.problem.equations, simulation.problem.terms
    equations.begin_step(simulation.time, simulation.time + 1e-9)  # with the normal forces in the equilibrium
    normal, friction = (
        equations.forces.sum([terms[name]], equations.x, equations.step.frozen)
        for name in ("contact", "friction")
    )
    allowed, used = scene["contact"]["friction"] * -normal[:, 2], np.linalg.norm(friction, axis=1)
    touching, sliding = comm.allreduce(np.array([np.sum(allowed > 0.0), np.sum(used > 0.999 * allowed)]))
    simulation.destroy()
    assert touching > 3
    assert (used <= allowed * (1.0 + 1e-5)).all()
    assert sliding > 0


@pytest.mark.parametrize("more", [{"snes_rtol": "1e-4"}, {"ksp_type": "gmres"}, {"snes_max_it": "12"}])
def test_options_that_change_the_iterations_do_not_change_the_shape(
    more: dict[str, str], options: dict[str, str]
) -> None:
    name = "plate on a plane, hinges"
    x, energy, _ = at_rest(MPI.COMM_SELF, SCENES[name](), options, {})
    other, changed, _ = at_rest(MPI.COMM_SELF, SCENES[name](), options, more)
    assert changed == pytest.approx(energy, rel=1e-3)
    np.testing.assert_allclose(other, x, atol=2e-5)
