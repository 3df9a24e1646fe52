"""obstacles.csv and contact_pressure of a sheet at rest, on any number of ranks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import grid, obj_file
from resumed_runs import simulate_until

from lyra_petsc.output.read_run import StoredRun

pytestmark = pytest.mark.parallel

WEIGHT = 0.2 * 9.81
SCENE: dict[str, Any] = {
    "mesh": grid(1.0, 1.0, 2, 2),
    "gravity": [0, 0, -9.81],
    "contact": {"gap": 0.02},
    "obstacles": {
        "a far, ball": {"sphere": {"center": [0, 0, 5], "radius": 1}},
        "floor": {"plane": {"point": [0, 0, -0.0199], "normal": [0, 0, 1]}},
    },
    "time": {"end": 1.0, "step": 0.02},
    "output": {"every": 0.5, "fields": ["contact_pressure"]},
}


@pytest.mark.parallel(2)
def test_forces_on_obstacles_equal_the_weight_at_rest(comm: MPI.Comm, shared_tmp: Path) -> None:
    simulate_until(comm, SCENE, shared_tmp / "run", None)
    if comm.rank > 0:
        return
    run = StoredRun(shared_tmp / "run")
    rows = {name: np.asarray(run.obstacles[name]) for name in run.obstacles}
    assert list(rows) == [
        "step",
        "time",
        "obstacle",
        "fx",
        "fy",
        "fz",
        "tx",
        "ty",
        "tz",
        "normal",
        "friction",
    ]
    assert rows["obstacle"].tolist() == ["a far, ball", "floor"] * 51
    assert rows["step"].tolist() == np.repeat(np.arange(51), 2).tolist()
    force = np.column_stack([rows[name] for name in ("fx", "fy", "fz", "tx", "ty", "tz")])
    assert not force[::2].any()
    first, last = force[1], force[-1]
    assert -1e-1 < first[2] < 0.0  # it begins at nearly the whole gap
    # the weight at its middle, x = y = 1/2
    expected = WEIGHT * np.array([0.0, 0.0, -1.0, -0.5, 0.5, 0.0])
    np.testing.assert_allclose(last, expected, atol=1e-5 * WEIGHT)
    np.testing.assert_allclose(run.field("contact_pressure")[-1], WEIGHT, rtol=5e-5)


def test_pressure_is_uniform_on_irregular_meshes(comm: MPI.Comm, shared_tmp: Path) -> None:
    """Triangles of various sizes and shapes, so stiff that they could carry each other's weight."""
    n = 8
    if comm.rank == 0:
        along = np.linspace(0.0, 1.0, n + 1) ** 2
        corners = [(x, y, 0.0) for y in along for x in along]
        first = [j * (n + 1) + i for j in range(n) for i in range(n)]
        faces = [(a, a + 1, a + n + 2) for a in first] + [(a, a + n + 2, a + n + 1) for a in first]
        obj_file(shared_tmp / "graded.obj", corners, faces)
    comm.Barrier()
    mesh = {"file": str(shared_tmp / "graded.obj"), "transform": {"translate": [0.0, 0.0, -0.0199 + 0.005]}}
    stiff = {"density": 0.2, "membrane": {"c11": 1200.0, "c22": 800.0, "c12": 300.0, "c33": 250.0}}
    scene = SCENE | {"mesh": mesh, "material": stiff | {"bending": 0.1}, "contact": {"gap": 0.007}}
    simulate_until(comm, scene | {"time": {"end": 1.0, "step": 0.05}}, shared_tmp / "run", None)
    if comm.rank == 0:
        pressure = StoredRun(shared_tmp / "run").field("contact_pressure")[-1]
        np.testing.assert_allclose(pressure, WEIGHT, rtol=1e-3)


@pytest.mark.parallel(2)
def test_resume_removes_later_rows(comm: MPI.Comm, shared_tmp: Path) -> None:
    scene = SCENE | {"time": {"end": 0.1, "step": 0.01}}
    simulate_until(comm, scene, shared_tmp / "whole", None)
    simulate_until(comm, scene, shared_tmp / "parts", 4)
    if comm.rank == 0:
        with open(shared_tmp / "parts" / "obstacles.csv", "a", encoding="utf-8") as table:
            table.write("7,0.035,a far")
    comm.Barrier()
    simulate_until(comm, scene, shared_tmp / "parts", None, resume=True)
    if comm.rank == 0:
        whole, parts = (StoredRun(shared_tmp / name).obstacles for name in ("whole", "parts"))
        assert list(whole["obstacle"]) == list(parts["obstacle"])
        assert list(whole["step"]) == list(parts["step"])
        np.testing.assert_allclose(parts["fz"], whole["fz"], rtol=1e-6, atol=1e-9)
