"""Checkpoints by steps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mpi4py import MPI
from physics import CLOTH, grid, scene_of

from lyra_petsc.output import recorder as module
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.output.stored import import_h5py
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.load import load_scene
from lyra_petsc.stepping.simulation import SteppedScene

pytestmark = pytest.mark.parallel


@pytest.mark.parametrize(("every", "expected"), [(3, [0, 3, 6, 8]), (None, [0, 8]), (1, list(range(9)))])
def test_checkpoints_by_steps(
    every: int | None,
    expected: list[int],
    comm: MPI.Comm,
    shared_tmp: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "MIN_COST_RATIO", float("inf"))  # none because it costs little
    checkpoint = {} if every is None else {"steps": every}
    scene = scene_of(
        {
            "mesh": grid(0.6, 0.4, 3, 2),
            "material": CLOTH,
            "gravity": [0, 0, -9.81],
            "handles": [{"nodes": [0]}],
            "time": {"end": 0.08, "step": 0.01},
            "output": {"every": 0.08, "checkpoint": checkpoint},
        }
    )
    simulation = SteppedScene(comm, scene)
    recorder = Recorder(simulation)
    recorder.begin(shared_tmp)
    steps = [written(comm, shared_tmp)]
    while not simulation.finished:
        recorder.record(simulation.step())
        recorder.flush()
        steps.append(written(comm, shared_tmp))
    recorder.close()
    simulation.destroy()
    assert sorted(set(steps)) == expected


def written(comm: MPI.Comm, folder: Path) -> int:
    """Step of the newest checkpoint."""
    step = None
    if comm.rank == 0:
        with import_h5py().File(folder / "checkpoint.h5", "r") as file:
            step = int(json.loads(file["entries"][64:].tobytes())["scalars"]["step"])
    return int(comm.bcast(step))


def test_the_written_scene_has_their_intervals(tmp_path: Path) -> None:
    text = "mesh: {grid: {width: 1, height: 1, nx: 1, ny: 1}}\nmaterial: {cloth: gray-interlock}\n"
    text += "time: {end: 1, step: 0.1}\noutput: {checkpoint: {steps: 7}}\n"
    (tmp_path / "scene.yaml").write_text(text)
    scene = load_scene(tmp_path / "scene.yaml")
    assert (scene.output.checkpoint.steps, scene.output.checkpoint.seconds) == (7, 60.0)
    (tmp_path / "again.yaml").write_text(dump_scene(scene))
    assert load_scene(tmp_path / "again.yaml").output.checkpoint.steps == 7
