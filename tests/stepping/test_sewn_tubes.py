"""Seams of rolled rectangles and of tubes: against closed tubes, with closed curves, on ranks, resumed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import end_on_one_rank, finished, scene_of, shape
from sewn_tubes import GAPING, LENGTH, RADIUS, tube

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.mesh.seams import AT_VERTEX, sewn_curves
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.terms.seam import SeamThreads

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


def largest_gap(simulation: SteppedScene) -> float:
    """Of all seams [m], over the mean edge of the mesh."""
    term = simulation.problem.terms["seam"]
    assert isinstance(term, SeamThreads)
    here = simulation.problem.equations.here()
    rows = term.table_rows(here.x, here.frozen[term])
    return max(float(gap) for _, gap, *_ in rows) / simulation.problem.whole.spacing


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


@pytest.mark.parametrize(("model", "bending"), [("hinge", 1e-3), ("midedge", 1e-5)])
def test_a_rolled_rectangle_that_is_pulled_together_equals_the_closed_tube(
    comm: MPI.Comm, model: str, bending: float, shared_tmp: Path
) -> None:
    closed = final(comm, inflated(written(comm, shared_tmp / "closed.obj", closed=True), model, bending, []))
    seam = LINE | {"angle": 0.0, "close": {"until": 0.5}}
    content = inflated(written(comm, shared_tmp / "open.obj", front=GAPING), model, bending, [seam])
    mesh = build_scene_mesh(scene_of(content))
    gaps = mesh.positions[mesh.groups["one"].vertices] - mesh.positions[mesh.groups["other"].vertices]
    np.testing.assert_allclose(np.linalg.norm(gaps, axis=1), 0.05 * 2 * np.pi * RADIUS, rtol=0.03)
    sewn = final(comm, content).reshape(-1, AROUND + 1, 3)
    np.testing.assert_allclose(sewn[:, :-1].reshape(-1, 3), closed, rtol=0.0, atol=1e-4 * LENGTH)
    np.testing.assert_allclose(sewn[:, -1], closed[::AROUND], rtol=0.0, atol=1e-4 * LENGTH)


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


CLOSING = {"close": {"until": 0.06}}


@pytest.mark.parametrize("integrator", ["semi-implicit", "midpoint"])
def test_tubes_are_sewn_end_to_end(comm: MPI.Comm, integrator: str, shared_tmp: Path) -> None:
    content = two_tubes(comm, shared_tmp, 0.01, angle=0.0, **CLOSING)
    content["time"]["integrator"] = integrator
    with finished(comm, content) as simulation:
        assert largest_gap(simulation) < AT_VERTEX
        x = shape(simulation)
    assert x[:, 0].max() < 2.0 * LENGTH + 0.005


def test_tubes_are_sewn_end_to_end_in_equilibrium(comm: MPI.Comm, shared_tmp: Path) -> None:
    content = two_tubes(comm, shared_tmp, 0.01, angle=0.0, close={"until": 0.5})
    content["loads"], content["gravity"] = [{"pressure": 50.0}], [0.0, 0.0, 0.0]
    content["time"] = {"analysis": "static", "step": 0.25}
    with finished(comm, content) as simulation:
        assert largest_gap(simulation) < AT_VERTEX


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


@pytest.mark.parallel(alone=False)
@pytest.mark.parametrize(
    ("model", "integrator", "steps"),
    [("hinge", "beuler", 9), ("midedge", "bdf2", 3), ("hinge", "midpoint", 3)],
)
def test_ranks_agree_and_a_run_goes_on_on_another_number(
    comm: MPI.Comm, model: str, integrator: str, steps: int, shared_tmp: Path
) -> None:
    """From a checkpoint while the seam closes, and from one after that."""
    content = two_tubes(comm, shared_tmp, 0.01, angle=0.0, **CLOSING)
    content["time"]["integrator"] = integrator
    content["material"] |= {"bending_model": model, "bending": 1e-2}  # soft tubes buckle, one way or another
    scene = scene_of(content)
    with finished(comm, scene) as simulation:
        x = shape(simulation)
    with finished(MPI.COMM_SELF, scene) as alone:
        np.testing.assert_allclose(x, shape(alone), rtol=0.0, atol=1e-7)
    resumed = end_on_one_rank(comm, scene, shared_tmp / "run", steps)
    if resumed is not None:
        np.testing.assert_allclose(resumed, x, rtol=0.0, atol=1e-7)
