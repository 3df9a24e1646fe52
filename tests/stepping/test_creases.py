"""Creases in equilibrium and in motion: angles, works, ranks, resuming, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folded_strips import strip
from mpi4py import MPI
from physics import end_on_changing_ranks, end_on_one_rank, finished, scene_of, shape, stepped

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.terms.rest import RestShape

pytestmark = [pytest.mark.parallel, pytest.mark.quick]

MEMBRANE = {"c11": 1e4, "c22": 1e4, "c12": 0.0, "c33": 5e3}
MODELS = ("hinge", "midedge")
WIDTH = 0.5
"""Of the strips, which are made of squares of 0.25 m [m]."""

FLAT = {"group": "fold", "angle": 0.0, "stiffness": 1e-3}


def paper(model: str) -> dict[str, Any]:
    return {"density": 0.2, "membrane": MEMBRANE, "bending": 0.01, "bending_model": model}


def folded(
    comm: MPI.Comm, folder: Path, model: str, creases: list[dict[str, Any]], at: dict[str, int], nx: int = 4
) -> dict[str, Any]:
    """A strip of which the squares of the first column are held, with creases at columns of vertices."""
    if comm.rank == 0:
        strip(folder / "strip.msh", at, nx)
    comm.Barrier()
    return {
        "mesh": {"file": str(folder / "strip.msh")},
        "material": paper(model),
        "handles": [{"box": [[-1.0, -1.0, -1.0], [0.25, 1.0, 1.0]]}],
        "creases": creases,
        "time": {"analysis": "static", "step": 0.125},
    }


def angles(x: Array, nx: int) -> Array:
    """Directions [°] of the columns of squares (nx,) in the xz plane."""
    dx = np.diff(x[: nx + 1], axis=0)
    return np.degrees(np.unwrap(np.arctan2(dx[:, 2], dx[:, 0])))


@pytest.mark.parametrize("model", MODELS)
def test_creases_take_their_rest_angles_of_both_signs(comm: MPI.Comm, model: str, shared_tmp: Path) -> None:
    creases = [
        {"group": "valley", "angle": 120.0, "stiffness": 1e-3},
        {"group": "mountain", "angle": [[0.0, 0.0], [0.5, -20.0], [1.0, -75.0]], "stiffness": 2e-3},
    ]
    content = folded(comm, shared_tmp, model, creases, {"valley": 1, "mountain": 3}, nx=5)
    with finished(comm, content) as simulation:
        found = angles(shape(simulation), 5)
        work, energy = simulation.budget.external_work, simulation.budget.total
    np.testing.assert_allclose(found, [0.0, 120.0, 120.0, 45.0, 45.0], atol=1e-6)
    assert abs(work) < 1e-12
    assert abs(energy) < 1e-12


@pytest.mark.parametrize("model", MODELS)
def test_the_panels_plasticity_and_friction_leave_creases_free(
    comm: MPI.Comm, model: str, shared_tmp: Path
) -> None:
    creases = [{"group": "valley", "angle": 120.0, "stiffness": 1e-3}]
    content = folded(comm, shared_tmp, model, creases, {"valley": 1, "mountain": 3}, nx=5)
    content["material"] |= {"yield_curvature": 0.1, "hardening": 0.1}
    if model == "midedge":
        content["material"]["friction_moment"] = 1e-3
    with finished(comm, content) as simulation:
        found = angles(shape(simulation), 5)
        heat = simulation.budget.dissipation
    np.testing.assert_allclose(found, [0.0, 120.0, 120.0, 120.0, 120.0], atol=1e-4)
    assert abs(heat) < 1e-9


@pytest.mark.parametrize("model", MODELS)
def test_a_crease_opens_under_a_moment_by_its_stiffness(comm: MPI.Comm, model: str, shared_tmp: Path) -> None:
    # a force F on the end of a rigid arm L: k l θ = F L cos θ
    content = folded(comm, shared_tmp, model, [FLAT | {"stiffness": 0.1}], {"fold": 1}, nx=2)
    force, arm = 0.2, 0.25
    end = {"box": [[0.49, -1.0, -1.0], [0.51, 1.0, 1.0]]}
    content["loads"] = [end | {"force": [0.0, 0.0, force]}]
    rigid = {name: 100.0 * value for name, value in MEMBRANE.items()}
    content["material"] |= {"membrane": rigid, "bending": 1e4}
    with finished(comm, content) as simulation:
        theta = np.radians(angles(shape(simulation), 2)[1])
        bending, work = simulation.budget.bending, simulation.budget.external_work
    assert 0.1 * WIDTH * theta == pytest.approx(force * arm * np.cos(theta), rel=1e-5)
    assert bending == pytest.approx(0.5 * 0.1 * WIDTH * theta**2, rel=1e-5)
    assert work == pytest.approx(bending, rel=0.05)  # by the trapezoidal rule over load steps


@pytest.mark.parametrize("model", MODELS)
def test_changing_rest_angles_do_the_work_that_is_stored(
    comm: MPI.Comm, model: str, shared_tmp: Path
) -> None:
    # both sides of the crease are held flat
    content = folded(comm, shared_tmp, model, [FLAT | {"angle": 60.0}], {"fold": 1}, nx=2)
    content["handles"] = [{"box": [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]}]
    with finished(comm, content) as simulation:
        stored = 0.5 * 1e-3 * WIDTH * np.radians(60.0) ** 2
        assert simulation.budget.bending == pytest.approx(stored, rel=1e-12)
        assert simulation.budget.external_work == pytest.approx(stored, rel=1e-9)


def swinging(
    comm: MPI.Comm, folder: Path, model: str, integrator: str, step: float, angle: Any = 70.0
) -> dict[str, Any]:
    """A strip that swings about its crease, started flat."""
    content = folded(comm, folder, model, [FLAT | {"angle": angle, "stiffness": 0.05}], {"fold": 1}, nx=3)
    return content | {"time": {"end": 0.24, "step": step, "integrator": integrator}}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("integrator", ["midpoint", "beuler"])
def test_a_swinging_fold_keeps_its_energy(
    comm: MPI.Comm, model: str, integrator: str, shared_tmp: Path
) -> None:
    curve = [[0.0, 70.0], [0.1, 70.0], [0.2, 20.0]]
    lost, work = [], []
    for step in (0.004, 0.002):
        scene = scene_of(swinging(comm, shared_tmp, model, integrator, step, curve))
        with stepped(comm, scene) as simulation:
            start = simulation.budget.total
            while not simulation.finished:
                simulation.step()
            budget = simulation.budget
            lost.append(abs(start + budget.external_work - budget.dissipation - budget.total) / start)
            work.append(budget.external_work / start)
    assert abs(work[1]) > 0.05
    if integrator == "midpoint":
        assert lost[1] < 0.4 * lost[0]
        assert lost[1] < 1e-3
    else:
        assert lost[1] < 0.7 * lost[0]


@pytest.mark.parallel(alone=False)
@pytest.mark.parametrize("model", MODELS)
def test_ranks_agree_and_a_run_goes_on_on_another_number(
    comm: MPI.Comm, model: str, shared_tmp: Path
) -> None:
    curve = [[0.0, 10.0], [0.05, 60.0], [0.2, -20.0]]
    scene = scene_of(swinging(comm, shared_tmp, model, "midpoint", 0.01, curve))
    with finished(comm, scene) as simulation:
        x = shape(simulation)
    with finished(MPI.COMM_SELF, scene) as alone:
        np.testing.assert_allclose(x, shape(alone), rtol=0.0, atol=1e-7)
    assert np.ptp(x[:, 2]) > 0.05
    resumed = end_on_one_rank(comm, scene, shared_tmp / "run", 7)
    if resumed is not None:
        np.testing.assert_allclose(resumed, x, rtol=0.0, atol=1e-7)


def on_a_floor(comm: MPI.Comm, folder: Path, model: str, integrator: str) -> dict[str, Any]:
    """A strip with a valley and a mountain that falls on a floor, and yields."""
    creases = [
        {"group": "valley", "angle": [[0.0, 0.0], [0.1, 60.0], [0.2, 30.0]], "stiffness": 0.05},
        {"group": "mountain", "angle": [[0.0, 0.0], [0.15, -100.0]], "stiffness": 0.1},
    ]
    content = folded(comm, folder, model, creases, {"valley": 1, "mountain": 3}, nx=5)
    content["material"] |= {"bending": 0.05, "yield_curvature": 0.05, "hardening": 0.1}
    if model == "midedge":
        content["material"]["friction_moment"] = 1e-3
    return content | {
        "gravity": [0.0, 0.0, -9.81],
        "obstacles": {"floor": {"plane": {"point": [0, 0, -0.1], "normal": [0, 0, 1]}, "friction": 0.3}},
        "contact": {"gap": 0.02},
        "time": {"end": 0.2, "step": 0.01, "integrator": integrator},
    }


@pytest.mark.parametrize(("model", "integrator"), [("hinge", "beuler"), ("midedge", "midpoint")])
def test_creases_touch_and_panels_yield_on_changing_ranks(
    comm: MPI.Comm, model: str, integrator: str, shared_tmp: Path
) -> None:
    scene, touched = scene_of(on_a_floor(comm, shared_tmp, model, integrator)), 0
    with stepped(comm, scene) as simulation:
        while not simulation.finished:
            simulation.step()
            touched += simulation.problem.equations.contact_end.touches
        x, heat = shape(simulation), simulation.budget.dissipation
    turned = angles(x, 5)
    assert touched > 5
    assert heat > 1e-3
    assert x[:, 2].min() > -0.1
    assert np.diff(turned)[1] > 5.0  # by yielding of the panel, up against its weight
    assert np.diff(turned)[0] < -5.0
    assert np.diff(turned)[2] < -5.0
    parts = [(1, 7), (min(2, comm.size), 14), (comm.size, None)]
    resumed = end_on_changing_ranks(comm, scene, shared_tmp / "run", parts)
    if resumed is not None:
        np.testing.assert_allclose(resumed, x, rtol=0.0, atol=1e-6)


@pytest.mark.parallel(1)
class TestSelection:
    """Of edges, on one process."""

    @staticmethod
    def built(folder: Path, creases: list[dict[str, Any]], **changes: Any) -> SteppedScene:
        content = folded(MPI.COMM_SELF, folder, "hinge", creases, {"fold": 2, "again": 2, "edge": 0})
        return SteppedScene(MPI.COMM_SELF, scene_of(content | changes))

    def test_edges_of_a_group_of_curves_and_between_vertices_of_another(self, tmp_path: Path) -> None:
        simulation = self.built(tmp_path, [FLAT])
        assert simulation.problem.terms["creases"].n_elements == 2
        hinges = simulation.problem.terms["bending"].n_elements
        simulation.destroy()
        simulation = self.built(tmp_path, [FLAT | {"group": "sheet"}])
        assert simulation.problem.terms["creases"].n_elements == hinges + 2
        assert "bending" not in simulation.problem.terms
        simulation.destroy()

    def test_a_group_without_an_interior_edge_is_noted(self, tmp_path: Path) -> None:
        simulation = self.built(tmp_path, [FLAT | {"group": "edge"}])
        assert any("creases[0]: no edge between two triangles" in note for note in simulation.notes)
        simulation.destroy()

    def test_a_sheet_that_will_be_folded_is_not_noted_as_staying_as_it_is(self, tmp_path: Path) -> None:
        for angle, stays in ((0.0, True), (30.0, False), ([[0.0, 0.0], [0.5, 9.0], [1.0, 0.0]], False)):
            simulation = self.built(tmp_path, [FLAT | {"angle": angle}])
            assert any("nothing acts on the sheet" in note for note in simulation.notes) == stays
            simulation.destroy()

    def test_an_edge_in_two_creases_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"'again' and in creases\[0\] 'fold'"):
            self.built(tmp_path, [FLAT, FLAT | {"group": "again"}])

    def test_an_unknown_group_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="no group 'foldd'"):
            self.built(tmp_path, [FLAT | {"group": "foldd"}])

    def test_without_creases_no_edge_is_one(self, tmp_path: Path) -> None:
        simulation = self.built(tmp_path, [])
        assert "creases" not in simulation.problem.terms
        assert simulation.problem.mesh is not None
        assert (RestShape(simulation.scene, simulation.problem.mesh).crease_of == -1).all()
        simulation.destroy()
