"""PETSc options with contact: preconditioners, ``-contact_monitor``, ``-ksp_view``."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from physics import direct_solver, gathered, grid, scene_of

from lyra_petsc.stepping.energy_balance import EnergyBalance
from lyra_petsc.stepping.simulation import SteppedScene

Array = NDArray[np.float64]

pytestmark = pytest.mark.parallel(2)

SIDE, CELLS, STEPS = 0.2, 6, 6
PLANE = {"plane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}}
SCENE: dict[str, Any] = {
    "mesh": grid(SIDE, SIDE, CELLS, CELLS) | {"transform": {"translate": [0.0, 0.0, 0.012]}},
    "material": {"cloth": "gray-interlock", "damping": 0.01},
    "initial": {"velocity": [0.5, 0.0, -1.0]},
    "gravity": [0.0, 0.0, -9.81],
    "contact": {"gap": 0.01, "friction": 0.3},
    "obstacles": {"floor": PLANE},
    "time": {"end": 1.0, "step": 0.005},
}
"""A sheet thrown on a floor, which every vertex touches."""

ABOVE = grid(0.1, 0.1, 2, 2) | {"transform": {"translate": [0.04, 0.05, 0.023]}}
"""A smaller sheet above it: blocks of pairs are added to the matrix."""

KINDS: dict[str, dict[str, str]] = {
    "jacobi": {"pc_type": "jacobi"},
    "pbjacobi": {"pc_type": "pbjacobi"},
    "asm": {"pc_type": "asm"},
    "gasm": {"pc_type": "gasm"},
    "gamg": {"pc_type": "gamg"},
    "mg": {"pc_type": "mg"},
    "mumps": {"pc_type": "lu", "pc_factor_mat_solver_type": "mumps"},
    "the program's choice": {},
}


def thrown(comm: MPI.Comm, options: dict[str, str]) -> Array:
    """Positions (V, 3) after the steps, in mesh order, when every vertex has touched."""
    for name, value in options.items():
        PETSc.Options().setValue(name, value)
    simulation = SteppedScene(comm, scene_of(SCENE | {"mesh": [SCENE["mesh"], ABOVE]}))
    contacts = 0.0
    for _ in range(STEPS):
        simulation.step()
        contacts = max(contacts, simulation.energy_balance.columns()["contacts"])
    assert contacts >= (CELLS + 1) ** 2
    x = gathered(simulation.problem.points, simulation.problem.equations.x)
    simulation.destroy()
    for name in options:
        PETSc.Options().delValue(name)
    return x


@pytest.fixture(scope="module")
def expected() -> Array:
    return thrown(MPI.COMM_SELF, direct_solver(MPI.COMM_SELF))


@pytest.mark.parametrize("kind", KINDS)
def test_every_preconditioner_works_with_contact(comm: MPI.Comm, kind: str, expected: Array) -> None:
    if kind == "mumps" and not PETSc.Sys.hasExternalPackage("mumps"):
        pytest.skip("PETSc has no MUMPS")
    x = thrown(comm, KINDS[kind] | {"ksp_rtol": "1e-10"})
    np.testing.assert_allclose(x, expected, rtol=0.0, atol=1e-7 * SIDE)


def test_the_monitor_shows_contact_and_friction(comm: MPI.Comm, capfd: pytest.CaptureFixture[str]) -> None:
    PETSc.Options().setValue("contact_monitor", "")
    PETSc.Options().setValue("ksp_view", "")
    simulation = SteppedScene(comm, scene_of(SCENE))
    touching, iterations, weights = [], [], []
    capfd.readouterr()
    for _ in range(STEPS):
        iterations.append(simulation.step().newton_iterations)
        columns = simulation.energy_balance.columns()
        touching.append((columns["contacts"], columns["smallest_gap"]))
        # the monitor shows forces of the barrier only
        damped = comm.allreduce(float(simulation.problem.equations.contact_end.impulses.loads[:, 2].sum()))
        weights.append(simulation.energy_balance.obstacle_forces(1)[0, 2] - damped)
    PETSc.Sys.syncFlush(comm)
    out = capfd.readouterr().out
    simulation.destroy()
    lines = [line for line in out.splitlines() if " CONTACT " in line]
    if comm.rank > 0:
        assert lines == []
        return
    numbers = [int(line.split()[0]) for line in lines]
    solves = [at for at, number in enumerate(numbers) if at + 1 == len(numbers) or numbers[at + 1] == 0]
    # a line for each iterate of the one or more solves of a step
    totals = np.cumsum([numbers[at] for at in solves]).tolist()
    ends = [solves[totals.index(total)] for total in np.cumsum(iterations)]
    assert len(solves) > len(ends)
    most_rubbing = 0
    for at, (contacts, gap) in zip(ends, touching, strict=True):
        line = lines[at]
        assert f"CONTACT {contacts:.0f} contacts" in line
        assert float(re.findall(r"smallest gap (\S+) m", line)[0]) == pytest.approx(gap, rel=1e-5)
        stick, slide = map(int, re.findall(r"(\d+) stick, (\d+) slide", line)[0])
        most_rubbing = max(most_rubbing, stick + slide)
    assert most_rubbing == (CELLS + 1) ** 2
    now = float(re.findall(r"now (\S+) N", lines[-1])[0])
    assert now == pytest.approx(abs(weights[-1]), rel=1e-5)
    assert float(re.findall(r"step limit (\S+);", lines[-1])[0]) == 1.0
    shown = re.findall(r"blocks: (\d+) of the mesh, (\d+) of pairs that act \((.*)\)", out)
    assert shown
    assert "contact " in shown[-1][2]
    assert "friction " in shown[-1][2]


@pytest.mark.parametrize("rate", [20.0, 0.0])
def test_linear_systems_are_solved_accurately_while_a_sheet_buckles(comm: MPI.Comm, rate: float) -> None:
    """A sheet on a floor that contracts in its plane; its Hessian is then indefinite."""
    material = {"young": 1e6, "poisson": 0.3, "thickness": 5e-4, "density": 0.2, "damping": 0.002}
    mesh = grid(0.5, 0.5, 12, 12) | {"transform": {"translate": [-0.25, -0.25, 0.004]}}
    content = {"material": material, "mesh": mesh, "contact": {}, "initial": {}, "solver": {}}
    simulation = SteppedScene(comm, scene_of(SCENE | content))
    equations, tolerances = simulation.problem.equations, []
    x, v = (state[: simulation.problem.points.n_owned].copy() for state in (equations.x, equations.v))
    v[:, :2] = -rate * x[:, :2]
    waves = 1.0 - np.cos([37.0, 27.3] * x[:, :2] + [1.9, 0.6])
    x[:, 2] += 0.002 * waves.prod(axis=1)
    equations.state.set(x, v)
    simulation.stepper.start(0.0, 0)
    simulation.energy_balance = EnergyBalance(equations)
    simulation.step()  # the first step does not know the Hessian of one before
    simulation.stepper.solver.snes.getKSP().setMonitor(
        lambda ksp, *_: tolerances.append(ksp.getTolerances()[0])
    )
    simulation.step()
    assert max(tolerances) <= 1e-3
    assert (1e-5 in tolerances) == (rate > 0.0)
    simulation.destroy()
