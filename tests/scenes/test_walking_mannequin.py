"""A skirt on a mannequin of 20,000 triangles that walks 120 frames: crossings, and the time it takes."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from physics import shape, stepped

from lyra_petsc.contact.joined import crossings_beside_seams
from lyra_petsc.contact.overlaps import find_overlaps
from lyra_petsc.mesh.obstacles import Solid, build_obstacles
from lyra_petsc.mesh.seams import tied_pairs
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.handles.motion import Motion

ROOT = Path(__file__).resolve().parents[2]
STILL = {"obstacles.body.mesh.frames": None}
WAIT = 1.2
"""Time [s] at which it begins to walk."""


def worn(scene: Scene) -> tuple[float, int]:
    """CPU time [s] of the steps after `WAIT`, and the number of states with crossings, of every fourth."""
    seconds, crossed = 0.0, 0
    with stepped(MPI.COMM_SELF, scene) as simulation:
        mesh = simulation.problem.mesh
        assert mesh is not None
        (body,) = build_obstacles(scene, mesh.obstacles, Motion)
        assert isinstance(body, Solid)
        tied, triangles = tied_pairs(scene, mesh), mesh.triangles
        while not simulation.finished:
            began = time.process_time()
            simulation.step()
            seconds += (time.process_time() - began) * (simulation.time > WAIT)
            if simulation.step_number % 4 == 0 or simulation.finished:
                x = shape(simulation)
                inside = find_overlaps(body, x, triangles, simulation.time, is_box=False)
                pairs = crossings_beside_seams(x, triangles, tied)
                crossed += bool(len(pairs) or any(len(part) for part in inside))
    return seconds, crossed


@pytest.mark.slow
def test_a_skirt_on_a_walking_body_takes_at_most_five_times_as_long(tmp_path: Path) -> None:
    words = ["--triangles", "20000", "--frames", "120", "--fps", "30", "--wait", str(WAIT)]
    subprocess.run([sys.executable, ROOT / "scripts" / "mannequin.py", tmp_path, *words], check=True)
    with np.load(tmp_path / "walk.npz") as walk:
        assert walk["position"].shape[0] == 120
        end = float(walk["time"][-1])
    settings = "mesh.size=0.04", f"obstacles.body.mesh.file={tmp_path / 'body.obj'}", f"time.end={end}"
    frames = f"obstacles.body.mesh.frames={tmp_path / 'walk.npz'}"
    walking = worn(load_scene(ROOT / "configs" / "skirt.yaml", (*settings, frames)))
    standing = worn(load_scene(ROOT / "configs" / "skirt.yaml", (*settings, frames)).changed(STILL))
    print(f"walking {walking[0]:.1f} s, standing {standing[0]:.1f} s, {walking[0] / standing[0]:.2f} times")
    assert walking[1] == standing[1] == 0
    assert walking[0] < 5.0 * standing[0]
