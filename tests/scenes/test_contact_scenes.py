"""Shipped scenes with contact, reduced: a physical number each, and no crossings in any state."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import direct_solver, options

from lyra_petsc.api.run_loop import ProgressCallbacks, simulate
from lyra_petsc.arrays import Array
from lyra_petsc.cli.check_run import crossings_of, run_ties
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.run_folder import FolderChoice
from lyra_petsc.scene.load import load_scene
from lyra_petsc.show.obstacle_surfaces import run_obstacles

pytestmark = pytest.mark.parallel

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def run_of(comm: MPI.Comm, folder: Path, name: str, *settings: str) -> StoredRun | None:
    """Run a shipped scene with settings; returns the run, without crossings, on rank 0; collective."""
    scene = load_scene(CONFIGS / f"{name}.yaml", settings)
    simulate(comm, scene, FolderChoice(folder / "run"), ProgressCallbacks(), lambda: 0)
    if comm.rank > 0:
        return None
    run = StoredRun(folder / "run")
    obstacles, tied = run_obstacles(run), run_ties(run)
    for state in range(len(run)):
        pairs, at_corners, overlaps = crossings_of(run, obstacles, state, tied=tied)
        inside = [part for overlap in overlaps.values() for part in overlap]
        assert not any(len(found) for found in (pairs, at_corners, *inside))
    assert np.median(np.asarray(run.history["newton_iterations"])[1:]) <= 20
    return run


def linking_number(one: Array, other: Array) -> float:
    """Linking number of closed polygons (n, 3), (m, 3), by Gauss's integral, exact for segments.

    Klenin & Langowski, Computation of writhe in modeling of supercoiled DNA, Biopolymers 54 (2000) 307-317,
    method 1a.
    """
    a, b = one[:, None], np.roll(one, -1, axis=0)[:, None]
    c, d = other[None], np.roll(other, -1, axis=0)[None]
    faces = [np.cross(u, v) for u, v in ((c - a, d - a), (d - a, d - b), (d - b, c - b), (c - b, c - a))]
    normals = [face / np.maximum(np.linalg.norm(face, axis=-1, keepdims=True), 1e-300) for face in faces]
    area = np.zeros((len(one), len(other)))
    for k in range(4):
        area += np.arcsin(np.clip(np.sum(normals[k] * normals[(k + 1) % 4], axis=-1), -1.0, 1.0))
    sign = np.sign(np.sum(np.cross(d - c, b - a) * (c - a), axis=-1))
    return float(np.sum(area * sign) / (4.0 * np.pi))


def column(table: Any, name: str) -> Array:
    return np.asarray(table[name], dtype=np.float64)


@pytest.mark.parallel(2, alone=False)
def test_a_flag_moves_as_without_contact_until_it_meets_itself(comm: MPI.Comm, shared_tmp: Path) -> None:
    settings = ("mesh.size=0.1", "time.end=0.25", "time.step=0.003125")
    if (run := run_of(comm, shared_tmp, "flag-contact", *settings)) is None:
        return
    tip = [column(run.probes, f"tip_{axis}")[-1] for axis in "xyz"]
    np.testing.assert_allclose(tip, [1.4778, 0.2017, 0.7594], atol=2e-3)  # as flag.yaml, with finer steps


@pytest.mark.parallel(3, alone=False)
def test_a_table_carries_the_weight_of_its_cloth_which_is_pulled_off(
    comm: MPI.Comm, shared_tmp: Path
) -> None:
    settings = ("mesh.grid.nx=10", "mesh.grid.ny=10", "time.step=0.02")
    if (run := run_of(comm, shared_tmp, "tablecloth", *settings)) is None:
        return
    push, time = (column(run.obstacles, name) for name in ("fz", "time"))
    assert push[time < 0.99][-1] == pytest.approx(-0.187 * 1.2**2 * 9.81, rel=5e-3)
    assert push[-1] == 0.0
    assert run.positions[-1][:, 0].min() > 0.4


@pytest.mark.parallel(1)
def test_a_stack_loads_its_box_with_its_weight(comm: MPI.Comm, shared_tmp: Path) -> None:
    coarse = [f"mesh[{sheet}].grid.{n}=2" for sheet in range(20) for n in ("nx", "ny")]
    if (run := run_of(comm, shared_tmp, "stack", *coarse, "time.step=0.02", "time.end=2")) is None:
        return
    weight = 20 * 0.187 * 0.3**2 * 9.81
    assert column(run.obstacles, "fz")[-1] == pytest.approx(-weight, rel=1e-3)
    heights = run.positions[-1][:, 2].reshape(20, 9).mean(axis=1)
    assert (np.diff(heights) > 0.0).all()  # in the order in which they fell


@pytest.mark.parallel(1)
def test_a_twisted_cloth_has_eight_turns(comm: MPI.Comm, shared_tmp: Path) -> None:
    settings = ("mesh.grid.nx=12", "mesh.grid.ny=3", "time.step=0.02")
    if (run := run_of(comm, shared_tmp, "twist", *settings)) is None:
        return
    x = run.positions[-1].reshape(4, 13, 3)
    # each long edge is closed far away on its own side
    closed = []
    for edge, side in ((x[0], -9.0), (x[-1], 9.0)):
        far = [[9.0, *edge[-1, 1:]], [9.0, side, 0.0], [-9.0, side, 0.0], [-9.0, *edge[0, 1:]]]
        closed.append(np.concatenate([edge, far]))
    # nothing else tells that they did not pass through each other on the way
    assert linking_number(*closed) == pytest.approx(8.0, abs=1e-9)


@pytest.mark.parallel(1)
def test_a_reef_knot_holds(comm: MPI.Comm, shared_tmp: Path) -> None:
    if (run := run_of(comm, shared_tmp, "reef-knot", "time.step=0.02", "output.reactions=true")) is None:
        return
    pull = [column(run.reactions, f"handle{number}_x")[-1] for number in range(4)]
    assert pull[0] + pull[1] == pytest.approx(-0.75, abs=0.1)
    assert sum(pull) == pytest.approx(0.0, abs=0.02)
    # from bight to bight; steps of 10 and 5 ms: 0.0644, 0.0722
    x, left = run.positions[-1], run.rest[:, 1] < 0.5
    assert x[left, 0].max() - x[~left, 0].min() == pytest.approx(0.068, abs=6e-3)


def test_a_skirt_is_sewn_and_worn(comm: MPI.Comm, shared_tmp: Path) -> None:
    settings = "mesh.size=0.08", "time.step=0.05", "time.end=1.1", "output.every=0.1"
    with options(direct_solver(comm)):
        run = run_of(comm, shared_tmp, "skirt", *settings)
    if run is None:
        return
    waist, hem = (column(run.probes, f"{name}_z") for name in ("waist", "hem"))
    # the waist rests on the hips, which are wider below; the weight begins to act at 0.7 s
    assert waist[-1] == pytest.approx(1.0898, abs=1e-3)
    assert hem[-1] == pytest.approx(0.6045, abs=1e-3)
    assert waist[0] > waist[-1] + 0.01
    gap = column(run.seams, "gap")
    assert gap[0] == pytest.approx(0.3)
    assert gap[-2:].max() < 1e-5


def test_a_shirt_is_sewn_round_its_wearer_who_carries_it(comm: MPI.Comm, shared_tmp: Path) -> None:
    settings = ("mesh.size=0.07", "time.step=0.02", "time.end=1.5")
    if (run := run_of(comm, shared_tmp, "shirt", *settings)) is None:
        return
    uv, edge = run.corner_uv, 0.07
    assert uv is not None
    one, other = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = 0.5 * float(np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).sum())
    assert column(run.obstacles, "fz")[-1] == pytest.approx(-0.187 * area * 9.81, rel=5e-3)
    seams = run.seams
    assert len(seams[seams["step"] == 0]) == 12
    closed = seams[seams["time"] >= 1.0]
    assert closed["gap"].max() < 1e-3 * edge
    # no seam pulls more than a third of the weight once the shirt hangs
    assert seams["opening"].iloc[-12:].max() < 0.5


@pytest.mark.parallel(1)
def test_a_shirt_that_starts_inside_its_wearer_by_5_mm_is_untangled(comm: MPI.Comm, shared_tmp: Path) -> None:
    # the front is 5 mm behind the foremost point of the chest, at y = 0.14 m
    inside = ("contact.untangle=true", "mesh.transform.translate=[0, -0.035, 0]")
    if (run := run_of(comm, shared_tmp, "shirt", "mesh.size=0.06", "time.end=0.15", *inside)) is None:
        return
    start = run.summary["untangled"]
    assert start["pairs"] > 10
    assert 0.003 < start["depth"] < 0.009
    assert start["largest_displacement"] < 0.012
