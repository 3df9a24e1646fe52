"""Steps that fail are repeated with a smaller Δt, under every integrator."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import CLOTH, grid, options, scene_of, shape, stepped

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.stepping.time_step import Evaluation

SCENE: dict[str, Any] = {
    "mesh": grid(0.6, 0.4, 5, 4, "alternating"),
    "material": CLOTH | {"bending": 1e-4, "damping": 0.01},
    "gravity": [0, 0, -9.81],
    "handles": [{"nodes": [0, 5]}],
    "solver": {"force_tolerance": 1e-6},
    "output": {"every": 0.12},
}


def journey(integrator: str, step: float, comm: MPI.Comm, *, fail: frozenset[int] = frozenset()) -> Any:
    """Final positions and number of rejected steps; attempts with these numbers are made to fail."""
    time = {"end": 0.12, "step": step, "integrator": integrator}
    with stepped(comm, SCENE | {"time": time}) as simulation:
        equations, attempts = simulation.problem.equations, 0
        residual = equations.forces.residual

        def spoiled(v: Array, at: Evaluation, out: Array) -> None:
            residual(v, at, out)
            if attempts in fail:
                out[:] = np.nan

        equations.forces.residual = spoiled  # type: ignore[method-assign]
        begin = equations.begin_step

        def counted(t0: float, t1: float) -> None:
            nonlocal attempts
            attempts += 1
            begin(t0, t1)

        equations.begin_step = counted  # type: ignore[method-assign]
        rejected = 0
        while not simulation.finished:
            rejected += simulation.step().rejected
        return shape(simulation), rejected


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit", "midpoint", "alpha2", "bdf2"])
def test_a_failed_step_is_repeated_without_side_effects(integrator: str, comm: MPI.Comm) -> None:
    smooth, none = journey(integrator, 0.004, comm)
    x, rejected = journey(integrator, 0.004, comm, fail=frozenset({1, 7, 8, 20}))
    coarse, _ = journey(integrator, 0.008, comm)
    assert none == 0
    assert rejected == 4
    # no further away than the error of the step itself
    assert np.abs(x - smooth).max() < 0.5 * np.abs(coarse - smooth).max()


def test_spectral_radius_by_petsc_option() -> None:
    with options({"ts_alpha_radius": "1.5"}):
        with pytest.raises(InputError, match="-ts_alpha_radius: must be from 0 to 1"):
            journey("alpha2", 0.004, MPI.COMM_SELF)
        journey("bdf2", 0.02, MPI.COMM_SELF)  # not asked for


@pytest.mark.parallel(2)
def test_one_note_reports_number_and_cause_of_repeated_steps(comm: MPI.Comm) -> None:
    PETSc.Options()["snes_max_it"] = 2
    simulation = SteppedScene(comm, scene_of(SCENE | {"time": {"end": 0.12, "step": 0.04}}))
    assert not simulation.note_of_repeats
    for _ in range(6):
        simulation.step()
    times = simulation.totals["rejected"]
    assert times > 1
    words = f"({times} attempts were repeated with a smaller Δt, down to )([0-9.e-]+) s .*-snes_max_it 2"
    found = re.match(words, simulation.note_of_repeats)
    assert found
    assert 0.0 < float(found[2]) < 0.04
    assert "6 steps were taken where 1 of the full Δt would do" in simulation.note_of_repeats
    other = SteppedScene(comm, simulation.scene)  # as a run that is resumed
    other.resume(*simulation.saved_state())
    assert other.note_of_repeats == simulation.note_of_repeats
    simulation.destroy()
    other.destroy()
