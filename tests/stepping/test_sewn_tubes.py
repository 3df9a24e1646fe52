"""Seams of rolled rectangles and of tubes: against closed tubes, and with closed curves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import finished, scene_of, shape
from sewn_tubes import LENGTH, RADIUS, tube

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.mesh.seams import sewn_curves

pytestmark = [pytest.mark.parallel]

AROUND = 16
MEMBRANE = {"c11": 1200.0, "c22": 1000.0, "c12": 300.0, "c33": 400.0}
LINE = {"between": ["one", "other"]}


def written(comm: MPI.Comm, path: Path, around: int = AROUND, **tube_arguments: Any) -> dict[str, Any]:
    """The mesh of a tube, written on one rank."""
    if comm.rank == 0:
        tube(path, around, **tube_arguments)
    comm.Barrier()
    return {"file": str(path)}


def inflated(mesh: dict[str, Any], model: str, bending: float, seams: list[dict[str, Any]]) -> dict[str, Any]:
    """A tube under pressure, held at three lines at its back."""
    material = {"density": 0.2, "membrane": MEMBRANE, "bending": bending, "bending_model": model}
    return {
        "mesh": mesh,
        "material": material,
        "handles": [{"group": "back"}],
        "loads": [{"pressure": 200.0}],
        "time": {"analysis": "static", "step": 0.25},
    } | ({"seams": seams} if seams else {})


def final(comm: MPI.Comm, content: dict[str, Any]) -> Array:
    with finished(comm, content) as simulation:
        return shape(simulation)


@pytest.mark.parametrize("model", ["hinge", "midedge"])
@pytest.mark.parametrize("flat", [True, False])
def test_a_rolled_rectangle_that_is_sewn_equals_the_closed_tube(
    comm: MPI.Comm, model: str, flat: bool, shared_tmp: Path
) -> None:
    closed = final(
        comm, inflated(written(comm, shared_tmp / "closed.obj", closed=True, flat=flat), model, 1e-3, [])
    )
    seam = LINE | {"angle": 0.0 if flat else "rest"}
    sewn = final(comm, inflated(written(comm, shared_tmp / "open.obj", flat=flat), model, 1e-3, [seam]))
    np.testing.assert_allclose(sewn, closed, rtol=0.0, atol=1e-9 * LENGTH)
    assert np.ptp(sewn[:, 1]) > 2.02 * RADIUS
    if model == "hinge" and flat:
        free = final(comm, inflated(written(comm, shared_tmp / "free.obj"), model, 1e-3, [LINE]))
        assert np.abs(free - closed).max() > 1e-3 * LENGTH


def two_tubes(comm: MPI.Comm, folder: Path, gap: float, **seam: Any) -> dict[str, Any]:
    """Tubes one after the other, of different numbers of edges, sewn end to end."""
    meshes = [
        written(comm, folder / "first.obj", 8, closed=True, along=2) | {"name": "first"},
        written(comm, folder / "second.obj", 12, closed=True, along=2, begin=LENGTH + gap)
        | {"name": "second"},
    ]
    return {
        "mesh": meshes,
        "material": {"density": 0.2, "membrane": MEMBRANE, "bending": 1e-4, "damping": 0.01},
        "handles": [{"group": "first/left"}],
        "seams": [{"between": ["first/right", "second/left"], "start": [LENGTH, RADIUS, 0.0]} | seam],
        "gravity": [0.0, 0.0, -9.81],
        "time": {"end": 0.12, "step": 0.01},
    }


def test_closed_curves_begin_at_the_start_and_run_in_the_nearer_direction(
    comm: MPI.Comm, shared_tmp: Path
) -> None:
    angle = 2.0 * np.pi / 8.0
    point = [LENGTH, RADIUS * np.cos(angle), RADIUS * np.sin(angle)]
    for reverse in (False, True):
        scene = scene_of(two_tubes(comm, shared_tmp, 0.01, start=point, reverse=reverse))
        mesh = build_scene_mesh(scene)
        (sewn,) = sewn_curves(scene, mesh)
        first, second = (mesh.positions[side.vertices] for side in sewn.sides)
        assert sewn.tied == 1
        assert len(sewn.ties.stencil) == 12
        np.testing.assert_allclose(first[0], point, atol=1e-12)
        assert np.linalg.norm(second[0] - point) < np.pi * RADIUS / 12 + 0.01
        turned = [np.arctan2(x[1:, 2], x[1:, 1]) - np.arctan2(x[:-1, 2], x[:-1, 1]) for x in (first, second)]
        turned = [np.sign(np.angle(np.exp(1j * steps)).sum()) for steps in turned]
        assert (turned[0] == turned[1]) != reverse
