"""The note on triangles that are compressed so far that the membrane model softens."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.terms.stretch import SOFTENS_BELOW


def pressed(to: float) -> Scene:
    content: dict[str, Any] = {
        "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": 4, "ny": 4}},
        "material": {"density": 0.2, "membrane": {"c11": 100, "c22": 100, "c12": 0, "c33": 50}},
        "handles": [{"group": "sheet", "motion": "press", "interpolation": "linear"}],
        "motions": {"press": [{"time": 0.0}, {"time": 0.04, "scale": [to, 1.0, 1.5]}]},
        "time": {"end": 0.06, "step": 0.01},
        "output": {"every": None},
    }
    return Scene.model_validate(content)


def run(comm: MPI.Comm, scene: Scene) -> tuple[list[str], list[tuple[float, float]]]:
    simulation = SteppedScene(comm, scene)
    stretches = []
    while not simulation.finished:
        report = simulation.step()
        stretches.append((report.smallest_stretch, report.largest_stretch))
    simulation.destroy()
    return simulation.notes, stretches


@pytest.mark.parallel(2)
def test_one_note_names_step_and_triangle(comm: MPI.Comm) -> None:
    notes, stretches = run(comm, pressed(0.5))
    expected = [0.875, 0.75, 0.625, 0.5, 0.5, 0.5]
    np.testing.assert_allclose([smallest for smallest, _ in stretches], expected)
    np.testing.assert_allclose([largest for _, largest in stretches], 1.0)
    [note] = [note for note in notes if "softens" in note]
    assert note.startswith("step 4 (t = 0.04 s): triangle ")
    assert "compressed to 0.5 of its length" in note
    triangle = int(note.split("triangle ")[1].split()[0])
    assert 0 <= triangle < 32
    assert comm.allgather(note) == [note] * comm.size


@pytest.mark.parallel(2)
def test_no_note_above_the_limit(comm: MPI.Comm) -> None:
    notes, stretches = run(comm, pressed(SOFTENS_BELOW + 1e-3))
    assert min(smallest for smallest, _ in stretches) < SOFTENS_BELOW + 2e-3
    assert [note for note in notes if "softens" in note] == []
