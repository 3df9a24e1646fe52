"""Forces of handles, and energies of moving clamps."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, finished, grid

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.terms.term import UpcomingStep

pytestmark = pytest.mark.parallel(2)

SHEET: dict[str, Any] = {
    "mesh": grid(1.0, 0.8, 6, 5, "alternating"),
    "material": CLOTH | {"bending": 1e-3},
    "gravity": [0, 0, -9.81],
}
WEIGHT = 0.2 * 0.8 * 9.81
STATIC = {"analysis": "static"}


def done(comm: MPI.Comm, **content: Any) -> AbstractContextManager[SteppedScene]:
    return finished(comm, SHEET | content)


def handle_sums(comm: MPI.Comm, handles: list[dict[str, Any]]) -> Array:
    with done(comm, handles=handles, time=STATIC) as simulation:
        return np.array(simulation.energy_balance.handle_forces(len(handles)))


@pytest.mark.parametrize("stiffness", [None, 40.0])
def test_handle_forces_carry_the_weight(stiffness: float | None, comm: MPI.Comm) -> None:
    """Forces of each handle on the sheet, prescribed or by springs, on any number of ranks."""
    soft = {} if stiffness is None else {"stiffness": stiffness}
    handles = [{"nodes": [corner]} | soft for corner in (0, 6, 35, 41)]
    forces = handle_sums(comm, handles)
    np.testing.assert_allclose(forces.sum(axis=0), [0.0, 0.0, WEIGHT], rtol=0, atol=1e-6 * WEIGHT)
    assert (forces[:, 2] > 0.2 * WEIGHT).all()
    np.testing.assert_allclose(forces, handle_sums(MPI.COMM_SELF, handles), rtol=0, atol=1e-6 * WEIGHT)


@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit", "midpoint", "alpha2", "bdf2"])
def test_a_handle_that_accelerates_pulls_with_mass_times_acceleration(
    integrator: str, comm: MPI.Comm
) -> None:
    acceleration, end = 5.0, 0.4
    there = {"translate": [0.5 * acceleration * end**2, 0, 0], "velocity": [acceleration * end, 0, 0]}
    scene = {
        "material": CLOTH | {"damping": 0.02},
        "gravity": [0, 0, 0],
        "handles": [{"group": "right", "motion": "away"}],
        "motions": {"away": [{"time": 0}, {"time": end} | there]},
        "time": {"end": 0.39, "step": 0.01, "integrator": integrator},
    }
    with done(comm, **scene) as simulation:
        mass = WEIGHT / 9.81
        force = simulation.energy_balance.handle_forces(1)[0]
        np.testing.assert_allclose(
            force, [mass * acceleration, 0, 0], rtol=0, atol=2e-3 * mass * acceleration
        )
        assert simulation.budget.external_work == pytest.approx(
            0.5 * mass * (acceleration * 0.39) ** 2, rel=2e-3
        )


@pytest.mark.parametrize("integrator", ["beuler", "midpoint", "alpha2", "bdf2"])
def test_energy_of_a_turning_clamp_uses_targets_of_the_same_time(integrator: str, comm: MPI.Comm) -> None:
    """Energies of a state use the targets at its time, not those at the time of the stage."""
    turned = {"rotate": {"axis": [0, 1, 0], "degrees": -60}}
    handles = [{"group": "left", "clamp": True, "motion": "turn"}]
    motions = {"turn": [{"time": 0}, {"time": 0.1} | turned]}
    time = {"end": 0.03, "step": 0.01, "integrator": integrator}
    material = CLOTH | {"bending": 0.1}
    scene = {"handles": handles, "motions": motions, "time": time, "material": material}
    with done(comm, **scene) as simulation:
        equations, problem = simulation.problem.equations, simulation.problem
        end = UpcomingStep(0.02, simulation.time, simulation.time, equations.x, equations.reference.at)
        here = 0.0
        for name in ("bending", "clamp"):
            term: Any = problem.terms[name]
            here += float(term.energies(equations.x, term.freeze(end)).sum())
        assert simulation.budget.bending == pytest.approx(comm.allreduce(here), rel=1e-12)
        assert comm.allreduce(here) > 1e-4
