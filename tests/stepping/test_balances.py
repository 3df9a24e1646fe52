"""Balances of energy and momentum in every step, under all kinds of loads and handles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, Simulation, finished, grid, stepped

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.energy_balance import EnergyBalance
from lyra_petsc.terms.protocols import MovingTargets

pytestmark = pytest.mark.parallel(2)

DT = 0.01

BASE: dict[str, Any] = {
    "mesh": grid(1.0, 0.8, 5, 4, "alternating"),
    "material": CLOTH | {"bending": 2e-3},
    "initial": {
        "velocity": [0.2, -0.1, 0.3],
        "angular_velocity": [1.0, 0.5, -2.0],
        "noise": 0.005,
        "seed": 2,
    },
}
TURN = [
    {"time": 0},
    {"time": 0.3, "rotate": {"axis": [0, 1, 0], "degrees": 40}, "translate": [0.0, 0.1, 0.05]},
]
SIDE = {"box": [[-0.01, -0.1, -0.1], [0.01, 1.0, 0.1]]}

SCENES: dict[str, dict[str, Any]] = {
    "free": {},
    "gravity": {"gravity": [0, 0, -9.81]},
    "damping": {"material": CLOTH | {"bending": 2e-3, "damping": 0.05}},
    "wind": {"wind": {"velocity": [1, 3, 6], "density": 1.2, "drag": 0.4}},
    "held": {"gravity": [0, 0, -9.81], "handles": [{"nodes": [0, 29]}, {"nodes": [5], "axes": ["z"]}]},
    "moving": {"gravity": [0, 0, -9.81], "handles": [SIDE | {"motion": "turn"}], "motions": {"turn": TURN}},
    "spring": {"handles": [SIDE | {"motion": "turn", "stiffness": 100.0}], "motions": {"turn": TURN}},
    "loads": {"loads": [{"nodes": [3], "force": [0, 1, 2]}, {"pressure": 8.0}, {"traction": [0, 0.5, 0]}]},
    "clamp": {"gravity": [0, 0, -9.81], "handles": [SIDE | {"clamp": True}]},
    "moving clamp": {"handles": [SIDE | {"clamp": True, "motion": "turn"}], "motions": {"turn": TURN}},
    "released clamp": {
        "handles": [SIDE | {"clamp": True, "motion": "turn", "until": 0.06}],
        "motions": {"turn": TURN},
    },
}
SCENES["all"] = SCENES["moving"] | SCENES["wind"] | SCENES["loads"] | SCENES["damping"]


def bracket(simulation: Simulation, before: Array) -> float:
    """E(x_{n+1}) − E(x_n) − ∇E(x_{n+1})·Δx [J] of the shell's elastic terms, in the last step, less the work
    of moving targets by the mean of the forces on them.
    """
    equations = simulation.equations
    n = equations.points.n_owned
    change = 0.0
    gradient = np.zeros_like(equations.x)
    for term in equations.active.elastic:
        if term.name != "spring":
            frozen = equations.step.frozen[term]
            change += float(term.energies(equations.x, frozen).sum())
            if isinstance(term, MovingTargets):
                start = term.freeze(equations.targets_at(equations.step.start))
                change -= float(term.energies(before, start).sum())
                (place, force), (old, old_force) = (
                    term.targets(x, at) for x, at in ((equations.x, frozen), (before, start))
                )
                change -= 0.5 * float(np.vdot(force + old_force, place - old))
            else:
                change -= float(term.energies(before, frozen).sum())
            term.add_gradient(equations.x, frozen, gradient)
    change -= float(np.vdot(gradient[:n], equations.x[:n] - before[:n]))
    return float(simulation.comm.allreduce(change))


@pytest.mark.parametrize(
    "name", [name if name != "all" else pytest.param(name, marks=pytest.mark.quick) for name in SCENES]
)
def test_energy_identity_of_backward_euler_in_every_step(comm: MPI.Comm, name: str) -> None:
    with Simulation(BASE | SCENES[name], comm) as simulation:
        equations = simulation.equations
        n = equations.points.n_owned
        energy_balance = EnergyBalance(equations)
        size = max(energy_balance.budget.total, 0.1)
        for _ in range(10):
            x, v, old = equations.x.copy(), equations.v[:n].copy(), energy_balance.budget
            simulation.step(DT)
            energy_balance.record(x[:n])
            new = energy_balance.budget
            jump = equations.mass[:, None] * (equations.v[:n] - v) ** 2
            lost = 0.5 * comm.allreduce(float(jump.sum(where=equations.step.prescribed.free)))
            heat, work = new.dissipation - old.dissipation, new.external_work - old.external_work
            change = new.total - old.total
            assert change == pytest.approx(-lost - heat + bracket(simulation, x) + work, abs=1e-9 * size)
            assert heat >= 0.0
            if name == "damping":
                assert heat > 1e-9


@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit", "midpoint", "alpha2", "bdf2"])
def test_a_handle_that_starts_at_once_does_the_work_of_its_vertices(comm: MPI.Comm, integrator: str) -> None:
    # all vertices are held: the work is their kinetic energy, also after further jumps
    content = BASE | {
        "initial": {},
        "handles": [{"box": [[-1, -1, -1], [2, 2, 2]], "motion": "run", "interpolation": "linear"}],
        "motions": {"run": [{"time": 0}, {"time": 0.05, "translate": [0.1, 0, 0]}, {"time": 1}]},
        "time": {"end": 0.1, "step": 0.01, "integrator": integrator},
    }
    with stepped(comm, content) as simulation:
        for _ in range(4):
            simulation.step()
        budget = simulation.budget
        assert budget.kinetic == pytest.approx(0.5 * 0.2 * 0.8 * 2.0**2)
        assert budget.external_work == pytest.approx(budget.total, rel=1e-9)
        while not simulation.finished:
            simulation.step()
        budget = simulation.budget
        assert budget.kinetic < 0.01
        assert budget.external_work == pytest.approx(budget.total, abs=1e-9)


@pytest.mark.parametrize("name", ["free", "damping"])
def test_a_free_sheet_gains_energy_only_by_its_bracket(comm: MPI.Comm, name: str) -> None:
    with Simulation(BASE | SCENES[name], comm) as simulation:
        equations = simulation.equations
        n = equations.points.n_owned
        energy_balance = EnergyBalance(equations)
        first = energy_balance.budget.total
        fed = 0.0
        for _ in range(10):
            x = equations.x.copy()
            simulation.step(DT)
            energy_balance.record(x[:n])
            fed += max(0.0, bracket(simulation, x))
        assert energy_balance.budget.external_work == pytest.approx(0.0, abs=1e-12)
        assert energy_balance.budget.total < first + fed
        assert energy_balance.budget.total > 0.0


@pytest.mark.parametrize("name", [name for name in SCENES if "clamp" not in name])
def test_forces_and_reactions_equal_the_change_of_momentum(comm: MPI.Comm, name: str) -> None:
    with Simulation(BASE | SCENES[name], comm) as simulation:
        equations = simulation.equations
        n = equations.points.n_owned
        energy_balance = EnergyBalance(equations)
        for _ in range(5):
            x, v = equations.x[:n].copy(), equations.v[:n].copy()
            simulation.step(DT)
            energy_balance.record(x)
            parts = dict(equations.forces_at_stage())
            applied = sum(parts[key] for key in ("loads", "wind", "springs") if key in parts)
            outer = energy_balance.reaction - applied
            force = comm.allreduce(outer.sum(axis=0))
            momentum = comm.allreduce((equations.mass[:, None] * (equations.v[:n] - v)).sum(axis=0))
            np.testing.assert_allclose(momentum / DT, force, atol=1e-7 * max(1.0, np.abs(force).max()))


def test_reactions_of_a_sheet_at_rest_carry_its_weight(comm: MPI.Comm) -> None:
    content = BASE | {
        "initial": {},
        "gravity": [0, -9.81, 0],
        "handles": [{"box": [[-1, 0.79, -1], [2, 1, 1]]}],
    }
    with Simulation(content, comm) as simulation:
        equations = simulation.equations
        n = equations.points.n_owned
        energy_balance = EnergyBalance(equations)
        for _ in range(12):
            x = equations.x[:n].copy()
            simulation.step(10.0)
        energy_balance.record(x)
        reaction = comm.allreduce(energy_balance.reaction.sum(axis=0))
        np.testing.assert_allclose(reaction, [0.0, 0.2 * 0.8 * 9.81, 0.0], atol=1e-7)
        # only where a handle holds
        held = np.abs(energy_balance.reaction).max(axis=1, initial=0.0) > 0.0
        assert comm.allreduce(int(held.sum())) == 6
        assert energy_balance.budget.kinetic < 1e-15


def test_impulses_of_friction_work_from_outside(comm: MPI.Comm) -> None:
    """Friction slows a sheet on a plane at rest: backward Euler's identity holds with its impulses."""
    scene = {
        "mesh": grid(0.1, 0.1, 3, 3, "alternating") | {"transform": {"translate": [0.0, 0.0, 0.004]}},
        "material": {"young": 1e6, "poisson": 0.3, "thickness": 1e-3, "density": 0.3},
        "gravity": [0.0, 0.0, -9.81],
        "contact": {"gap": 0.005, "friction": 0.3},
        "obstacles": {"floor": {"plane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}}},
        "initial": {"velocity": [1.0, 0.0, 0.0]},
        "time": {"end": 0.05, "step": 0.005, "integrator": "beuler"},
    }
    with finished(comm, scene) as simulation:
        assert simulation.guard is not None
        found = simulation.guard.content()
    parts = found["identity"]["velocity_changes"] - found["identity"]["bracket"]
    assert parts == pytest.approx(found["numerical_dissipation"], rel=1e-3)
