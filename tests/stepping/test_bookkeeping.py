"""Forces of handles, energies of moving clamps, error estimates, tolerances and restarts."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, finished, grid, scene_of, shape

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.stepping.step_control import StepControl
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
        system, problem = simulation.problem.system, simulation.problem
        end = UpcomingStep(0.02, simulation.time, simulation.time, system.x, system.reference.at)
        here = 0.0
        for name in ("bending", "clamp"):
            term: Any = problem.terms[name]
            here += float(term.energies(system.x, term.freeze(end)).sum())
        assert simulation.budget.bending == pytest.approx(comm.allreduce(here), rel=1e-12)
        assert comm.allreduce(here) > 1e-4


def test_static_analyses_end_at_their_tolerance(comm: MPI.Comm) -> None:
    """The last proximal step must not end far above a loose tolerance, nor far below it."""
    left = []
    for tolerance in (1e-2, 1e-3, 1e-4, 1e-5):
        content = {"handles": [{"nodes": [0, 6]}], "solver": {"force_tolerance": tolerance}, "time": STATIC}
        with done(comm, **content) as simulation:
            force = simulation.problem.system.out_of_balance()[0]
            norm = np.sqrt(comm.allreduce(float(np.vdot(force, force))))
            # the largest part of the forces is hardly larger than the pull of the two handles
            left.append(norm / (tolerance * WEIGHT))
    assert max(left) < 5.0, left


def test_first_order_error_estimate_of_free_fall_is_exact(comm: MPI.Comm) -> None:
    """Backward Euler has an error of ½ g Δt² in every step, and the errors add up."""
    time = {"end": 0.2, "step": "auto", "tolerance": 0.02}
    with done(comm, time=time) as simulation:
        size = simulation.problem.whole.size
        fallen = shape(simulation)[:, 2]
        error = np.abs(fallen + 0.5 * 9.81 * 0.2**2).max() / size
        assert simulation.estimated_error == pytest.approx(error, rel=0.02)
        assert error < 1.2 * 0.02


def test_a_static_analysis_starts_in_equilibrium(comm: MPI.Comm) -> None:
    """Forces that hold the start shape decrease with the load factor."""
    still = {"gravity": [0, 0, 0], "initial": {"noise": 5e-3}, "handles": [{"nodes": [0, 6]}]}
    simulation = SteppedScene(comm, scene_of(SHEET | still | {"time": STATIC}))
    system, left = simulation.problem.system, []
    for factor in (0.0, 0.5, 1.0):
        system.applied.factor = factor
        system.begin_step(0.0, factor)
        left.append(comm.allreduce(np.abs(system.out_of_balance()[0]).max(initial=0.0), MPI.MAX))
    assert left[0] < 1e-12 * left[2]
    assert left[1] == pytest.approx(0.5 * left[2])
    simulation.destroy()


def test_second_order_if_a_load_switches() -> None:
    """Generalised-α computes new accelerations after a jump of the load."""
    soft = {"c11": 60.0, "c22": 40.0, "c12": 15.0, "c33": 12.0}  # so that Δt resolves it
    content = {
        "gravity": [0, 0, 0],
        "mesh": grid(0.5, 0.4, 3, 2, "alternating"),
        "material": {"density": 0.2, "membrane": soft, "bending": 1e-3, "damping": 0.01},
        "handles": [{"group": "left"}],
        "loads": [{"group": "right", "force": [0, 0, 0.5], "from": 0.04}],
    }
    shapes = []
    for step in (0.004, 0.002, 0.0005):
        time = {"end": 0.12, "step": step, "integrator": "alpha2"}
        with done(MPI.COMM_SELF, **content, time=time) as simulation:
            shapes.append(shape(simulation))
    coarse, fine = (np.abs(shape - shapes[-1]).max() for shape in shapes[:2])
    assert coarse / fine == pytest.approx(4.06, abs=0.3)  # 3.2 where it is not


def test_round_off_of_the_time_causes_no_tiny_step() -> None:
    control = StepControl(0.1, 0.3, None, [], 1e-5)
    assert control.next_end(0.2 - 1e-9) == 0.3
    assert control.next_end(0.1 - 1e-9) == pytest.approx(0.2 - 1e-9, abs=1e-15)
