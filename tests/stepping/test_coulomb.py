"""Coulomb's law in every step: contact pushes, and friction is at most μ times the normal force."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from physics import CLOTH, grid, obj_file, scene_of

from lyra_petsc.contact import impacts
from lyra_petsc.stepping.simulation import SteppedScene

Array = NDArray[np.float64]

pytestmark = pytest.mark.parallel(3)

G, GAP, SIDE = 9.81, 0.005, 0.4
OTHERS = ("semi-implicit", "midpoint", "alpha2")
STIFF = {
    "density": 0.187,
    "membrane": {"c11": 2000, "c22": 2000, "c12": 600, "c33": 500},
    "bending": 1e-2,
    "damping": 0.005,
}


def floor(above: float) -> dict[str, Any]:
    return {"floor": {"plane": {"point": [0.0, 0.0, -above], "normal": [0.0, 0.0, 1.0]}}}


def thrown(
    above: float, friction: float, velocity: list[float], end: float, step: float, integrator: str
) -> Any:
    """A stiff sheet that starts at a height [m] above a plane."""
    return {
        "mesh": grid(SIDE, SIDE, 4, 4),
        "material": STIFF,
        "gravity": [0.0, 0.0, -G],
        "contact": {"friction": friction, "gap": GAP},
        "obstacles": floor(above),
        "initial": {"velocity": velocity},
        "time": {"end": end, "step": step, "integrator": integrator},
    }


class Mean:
    """Mean position and velocity of a simulation's sheet, and its weight [N]."""

    def __init__(self, simulation: SteppedScene) -> None:
        self._equations = simulation.problem.equations
        self.weight = G * self._sum(np.ones((self._equations.points.n_owned, 1)))[0]

    def _sum(self, values: Array) -> Array:
        return self._equations.points.global_sum(
            *(self._equations.mass @ values[: self._equations.points.n_owned])
        )

    @property
    def position(self) -> Array:
        return self._sum(self._equations.x) * G / self.weight

    @property
    def velocity(self) -> Array:
        return self._sum(self._equations.v) * G / self.weight


def steps_by_coulombs_law(simulation: SteppedScene, friction: float, weight: float) -> None:
    """Run to the end; contact pushes, friction is below its limit and makes heat in every step."""
    work = 0.0
    while not simulation.finished:
        simulation.step()
        (load,) = simulation.energy_balance.obstacle_forces(1)
        assert load[6] >= -1e-9 * weight
        assert load[7] <= friction * load[6] * (1.0 + 1e-6) + 1e-9 * weight
        assert np.linalg.norm(load[:3]) <= math.hypot(load[6], load[7]) * (1.0 + 1e-6) + 1e-9 * weight
        before, work = work, simulation.energy_balance.columns()["friction_work"]
        assert work >= before


CASES = [  # height above the plane, friction, speeds along and down, step
    (0.7 * GAP, 2.0, 2.0, 0.0, 0.002),
    (0.6 * GAP, 0.3, 1.0, 0.0, 0.005),
    (1.1 * GAP, 0.3, 3.0, 3.0, 0.005),
    (1.1 * GAP, 0.3, 2.0, 1.0, 0.02),
]
RUNS = [*itertools.product(("beuler", "bdf2"), CASES), *((name, CASES[2]) for name in OTHERS)]


@pytest.mark.parallel(1)
@pytest.mark.parametrize(("integrator", "case"), RUNS)
def test_a_thrown_sheet_slides_as_far_as_the_balance_of_momentum_says(
    comm: MPI.Comm, integrator: str, case: tuple[float, ...]
) -> None:
    """Friction is μ times the normal force, so v_x + μ v_z falls by μ g t, however the sheet bounces."""
    above, friction, along, down, step = case
    end = along / (friction * G) + 0.1
    content = thrown(above, friction, [along, 0.0, -down], end, step, integrator)
    simulation = SteppedScene(comm, scene_of(content))
    mean = Mean(simulation)
    start = mean.position
    steps_by_coulombs_law(simulation, friction, mean.weight)
    moved = mean.position - start
    simulation.destroy()
    exact = (along - friction * down) ** 2 / (2.0 * friction * G) - friction * moved[2]
    assert moved[0] == pytest.approx(exact, abs=0.02 * exact + along * step)


@pytest.mark.parametrize("integrator", ["beuler", "midpoint"])
def test_friction_of_a_sheet_that_lands_is_below_its_limit_on_round_and_flat_meshes(
    comm: MPI.Comm, shared_tmp: Path, integrator: str
) -> None:
    if comm.rank == 0:
        corners = [[-1.0, -1.0, -0.01], [2.0, -1.0, -0.01], [-1.0, 2.0, -0.01], [2.0, 2.0, -0.01]]
        obj_file(shared_tmp / "floor.obj", corners, [(0, 1, 2), (1, 3, 2)])
    comm.Barrier()
    centre = [0.5 * SIDE, 0.5 * SIDE, -0.31]
    for shape in (
        {"sphere": {"center": centre, "radius": 0.3}},
        {"mesh": {"file": str(shared_tmp / "floor.obj")}},
    ):
        content = thrown(0.0, 0.4, [1.0, 0.5, -1.0], 0.1, 0.005, integrator)
        content["material"] = CLOTH
        content["obstacles"] = {"body": shape}
        simulation = SteppedScene(comm, scene_of(content))
        steps_by_coulombs_law(simulation, 0.4, Mean(simulation).weight)
        (load,) = simulation.energy_balance.obstacle_forces(1)
        simulation.destroy()
        assert load[7] > 0.0


@pytest.mark.parametrize("integrator", ["beuler", "bdf2"])
def test_friction_between_sheets_is_below_its_limit(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch, integrator: str
) -> None:
    """In the arrays of contacts, and with backward Euler by the change of momentum."""
    friction, step = 0.3, 0.005
    checked = []
    coulomb = impacts._coulomb

    def watched(pairs: Any, *given: Any) -> Any:
        force, sticks = coulomb(pairs, *given)
        size = np.linalg.norm(force, axis=1)
        assert (size <= friction * pairs.pairs.force * (1.0 + 1e-6)).all()
        checked.append(int(np.count_nonzero(size)))
        return force, sticks

    monkeypatch.setattr(impacts, "_coulomb", watched)
    low = grid(0.8, 0.8, 5, 5) | {"transform": {"translate": [-0.2, -0.2, 0.0]}}
    upper = grid(0.3, 0.3, 3, 3) | {"transform": {"translate": [0.0, 0.0, 1.2 * GAP]}}
    content = {
        "mesh": [low, upper],
        "material": STIFF,
        "contact": {"friction": friction, "gap": GAP},
        "handles": [{"nodes": list(range(36))}],
        "time": {"end": 0.08, "step": step, "integrator": integrator},
    }
    simulation = SteppedScene(comm, scene_of(content))
    equations, layout = simulation.problem.equations, simulation.problem.points
    moves = (layout.mesh_vertices >= 36)[:, None]
    equations.v[: layout.n_vertices] = np.where(moves, [1.5, 0.0, -1.0], 0.0)
    equations.state.update_ghosts()
    simulation.energy_balance.measure()
    mass = np.where(moves[:, 0], equations.mass[: layout.n_vertices], 0.0)

    def momentum() -> Array:
        return layout.global_sum(*(mass @ equations.v[: layout.n_vertices]))

    before = momentum()
    size = float(np.abs(before).max())
    while not simulation.finished:
        simulation.step()
        now = momentum()
        along, normal = now[0] - before[0], now[2] - before[2]
        if integrator == "beuler":
            assert abs(along) <= friction * abs(normal) * (1.0 + 1e-3) + 1e-6 * size
        before = now
    slowed = 1.5 - before[0] / layout.global_sum(float(mass.sum()))[0]
    rebound = before[2] / layout.global_sum(float(mass.sum()))[0]
    simulation.destroy()
    assert comm.allreduce(sum(checked)) > 10
    assert slowed == pytest.approx(friction * (1.0 + rebound), rel=0.02)
