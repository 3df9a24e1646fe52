"""Cloth on a surface that moves through frames: as on the same surface with keyframes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import grid

from lyra_petsc.api.simulations import Simulation
from lyra_petsc.mesh.obstacles import BOX_TRIANGLES

pytestmark = pytest.mark.parallel

CORNERS = np.array([[x, y, z] for z in (-0.1, 0.0) for y in (-0.3, 0.3) for x in (-0.3, 0.3)])
TIMES = [0.0, 0.05, 0.1, 0.2]
SHIFTS = [[0, 0, 0], [0.01, 0, 0], [0.04, 0.01, 0.01], [0.04, 0.03, 0.03]]
KEYFRAMES = [
    {"time": time, "translate": shift}
    for time, shift in zip(
        TIMES, ([0, 0, 0], [0.01, 0, 0], [0.04, 0.01, 0.01], [0.04, 0.03, 0.03]), strict=True
    )
]


def scene(folder: Path, integrator: str, **mesh: Any) -> dict[str, Any]:
    """A sheet that lies on a box and hangs over its sides."""
    return {
        "mesh": grid(0.8, 0.8, 6, 6) | {"transform": {"translate": [-0.41, -0.39, 0.004]}},
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "gravity": [0, 0, -9.81],
        "contact": {"gap": 0.005, "friction": 0.4},
        "obstacles": {"box": {"mesh": {"file": str(folder / "box.obj")} | mesh, "interpolation": "linear"}},
        "time": {"end": 0.2, "step": 0.01, "integrator": integrator},
        "solver": {"force_tolerance": 1e-9},
    }


def write(folder: Path) -> None:
    rows = [f"v {x} {y} {z}" for x, y, z in CORNERS] + [f"f {a} {b} {c}" for a, b, c in BOX_TRIANGLES + 1]
    (folder / "box.obj").write_text("\n".join(rows) + "\n")
    shifts = np.array([frame["translate"] for frame in KEYFRAMES], dtype=np.float64)
    np.savez(folder / "walk.npz", time=TIMES, position=CORNERS + shifts[:, None])


def final(comm: MPI.Comm, content: dict[str, Any]) -> np.ndarray[Any, Any]:
    with Simulation(content, comm=comm) as simulation:
        for _ in simulation:
            pass
        positions = simulation.gather(simulation.positions)
    return np.asarray(comm.bcast(positions))


@pytest.mark.parametrize("integrator", ["beuler", "bdf2", "alpha2"])
def test_a_translation_by_frames_is_that_by_keyframes(
    comm: MPI.Comm, shared_tmp: Path, integrator: str
) -> None:
    if comm.rank == 0:
        write(shared_tmp)
    comm.barrier()
    content = scene(shared_tmp, integrator)
    content["obstacles"]["box"]["motion"] = KEYFRAMES
    by_keyframes = final(comm, content)
    by_frames = final(comm, scene(shared_tmp, integrator, frames=str(shared_tmp / "walk.npz")))
    assert np.abs(by_keyframes[:, 0]).max() > 0.4
    assert np.abs(by_frames - by_keyframes).max() < 1e-6


@pytest.mark.parametrize("whole", [False, True])
def test_vertices_pulled_by_frames_move_as_by_keyframes(
    comm: MPI.Comm, shared_tmp: Path, whole: bool
) -> None:
    content: dict[str, Any] = {
        "mesh": grid(0.8, 0.8, 6, 6),
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "handles": [{"group": "left", "motion": "pull", "interpolation": "linear"}, {"group": "right"}],
        "motions": {"pull": KEYFRAMES},
        "gravity": [0, 0, -9.81],
        "time": {"end": 0.2, "step": 0.01},
        "solver": {"force_tolerance": 1e-12},
    }
    by_keyframes = final(comm, content)
    if comm.rank == 0:
        rows = np.arange(49) if whole else 7 * np.arange(7)
        places = np.stack([rows % 7, rows // 7, 0 * rows], axis=1) * (0.8 / 6)
        np.savez(shared_tmp / "pins.npz", time=TIMES, position=places + np.array(SHIFTS)[:, None])
    comm.barrier()
    pulled = {"group": "left", "frames": str(shared_tmp / "pins.npz"), "interpolation": "linear"}
    by_frames = final(comm, content | {"handles": [pulled, {"group": "right"}]})
    assert np.abs(by_frames - by_keyframes).max() < 1e-9
