"""A run that stops and goes on from its checkpoint takes the same way, whatever steps it takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from physics import CLOTH, grid, scene_of

from lyra_petsc.recorder import Recorder
from lyra_petsc.simulation import Simulation

Array = NDArray[np.float64]

SCENE: dict[str, Any] = {
    "mesh": grid(0.6, 0.4, 5, 4, "alternating"),
    "material": CLOTH | {"bending": 1e-4, "damping": 0.01},
    "gravity": [0, 0, -9.81],
    "wind": {"velocity": [1.0, 2.0, 0.0], "density": 1.2},
    "handles": [
        {"nodes": [0, 5], "motion": "lift"},
        {"nodes": [24], "until": 0.055},
        {"nodes": [29], "from": 0.03, "stiffness": 20.0, "motion": "lift"},
    ],
    "motions": {"lift": [{"time": 0}, {"time": 0.1, "translate": [0, 0, 0.05]}]},
    "output": {"every": 0.02},
}

WAYS: dict[str, dict[str, Any]] = {
    "beuler": {"end": 0.1, "step": 0.004},
    "midpoint": {"end": 0.1, "step": 0.004, "integrator": "midpoint"},
    "alpha2": {"end": 0.1, "step": 0.004, "integrator": "alpha2"},
    "bdf2": {"end": 0.1, "step": 0.004, "integrator": "bdf2"},
    "bdf2, adaptive": {"end": 0.1, "step": "auto", "tolerance": 1e-2, "integrator": "bdf2"},
    "alpha2, adaptive": {"end": 0.1, "step": "auto", "tolerance": 1e-2, "integrator": "alpha2"},
    "beuler, adaptive": {"end": 0.1, "step": "auto", "tolerance": 5e-2},
    "static": {"analysis": "static", "step": 0.1},
}


def journey(
    scene: dict[str, Any], folder: Path, stop: int | None, *, resume: bool
) -> tuple[int, float, Array]:
    """Steps (up to ``stop``) with a direct solver and files in ``folder``: step number, time, x and v."""
    options = {"pc_type": "lu", "ksp_rtol": "1e-12"}
    for name, value in options.items():
        PETSc.Options().setValue(name, value)
    simulation = Simulation(MPI.COMM_SELF, scene_of(scene))
    recorder = Recorder(simulation)
    if resume:
        recorder.resume(folder)
    else:
        folder.mkdir()
        recorder.begin(folder)
    while not simulation.finished and simulation.step_number != stop:
        recorder.record(simulation.step())
    recorder.write_checkpoint()
    recorder.close()
    system = simulation.model.system
    left = np.concatenate([system.x, system.v])
    simulation.destroy()
    for name in [*options, *simulation.stepper.our_options]:
        PETSc.Options().delValue(name)
    return simulation.step_number, simulation.time, left


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("stop", [1, 2, 9])
def test_the_way_is_the_same(way: str, stop: int, tmp_path: Path) -> None:
    scene = SCENE | {"time": WAYS[way]}
    if way == "static":
        stop = min(stop, 2)
    steps, time, straight = journey(scene, tmp_path / "straight", None, resume=False)
    journey(scene, tmp_path / "halted", stop, resume=False)
    again = journey(scene, tmp_path / "halted", None, resume=True)
    assert again[:2] == (steps, time)
    np.testing.assert_allclose(again[2], straight, rtol=0, atol=1e-11)
    rows = (tmp_path / "halted" / "history.csv").read_text(encoding="utf-8").splitlines()
    assert [int(row.split(",")[0]) for row in rows[1:]] == list(range(steps + 1))
