"""Comparison of runs on one mesh and across meshes, in slabs, on any number of ranks."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from physics import grid, scene_of

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.exact_motions import Energies, ExactMotion
from lyra_petsc.experiments.study import comparison
from lyra_petsc.experiments.study.comparison import (
    RestSurface,
    barycentric,
    make_interpolation,
    motion_errors,
    read_local,
    read_samples,
    read_surface,
    run_errors,
)
from lyra_petsc.experiments.study.plan import ENERGY, POSITION, probe_quantity
from lyra_petsc.mesh.build import build_mesh
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.output.mesh_file import write_mesh
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.states import StateWriter

pytest.importorskip("scipy")

TIME_KEYS = (0.0, 0.1, 0.2)
QUANTITIES = [*POSITION, ENERGY, probe_quantity("tip")]
SHEET = grid(0.3, 0.4, 3, 4)  # diagonal 0.5 m


def mesh_of(*sources: object) -> Mesh:
    return build_mesh(scene_of({"mesh": list(sources)}).mesh)


def write_run(
    folder: Path, mesh: Mesh, states: list[Array], energies: list[list[float]], tip: list[Array]
) -> None:
    """Write the files of a run that a comparison reads."""
    folder.mkdir()
    write_mesh(folder, mesh, MPI.COMM_SELF)
    order = FileOrder(MPI.COMM_SELF, np.arange(mesh.n_vertices), mesh.n_vertices)
    writer = StateWriter(folder, order, n_triangles=mesh.n_triangles)
    for number, (time, x) in enumerate(zip(TIME_KEYS, states, strict=True)):
        writer.write(number, time, x, {})
    names = "kinetic_energy,membrane_energy,bending_energy,potential_energy"
    rows = [f"{n},{TIME_KEYS[n]!r},{','.join(map(repr, row))}" for n, row in enumerate(energies)]
    (folder / "history.csv").write_text("\n".join([f"step,time,{names}", *rows]) + "\n")
    rows = [f"{n},{TIME_KEYS[n]!r},{','.join(map(repr, row.tolist()))}" for n, row in enumerate(tip)]
    (folder / "probes.csv").write_text("\n".join(["step,time,tip_x,tip_y,tip_z", *rows]) + "\n")


ENERGIES = [[0.0, 0.0, 0.0, 5.0], [1.0, 0.5, 0.0, 3.5], [2.0, 0.0, 0.0, 3.0]]
TIP = [np.zeros(3), np.array([0.0, 0.0, -0.1]), np.array([0.0, 0.0, -0.2])]


@pytest.fixture
def pair(shared_tmp: Path, comm: MPI.Comm) -> tuple[Path, Path]:
    """Two runs on one mesh; the second differs at 0.1 s by 0.05 m at one corner, and in energy and probe."""
    one, two = shared_tmp / "one", shared_tmp / "two"
    if comm.rank == 0:
        mesh = mesh_of(SHEET)
        states = [mesh.rest + [0, 0, -t] for t in TIME_KEYS]
        off = [x.copy() for x in states]
        off[1][0] += [0.03, 0.0, 0.04]
        energies = [[0.0, 0.0, 0.0, 5.0], [1.2, 0.5, 0.0, 3.5], [2.0, 0.0, 0.0, 3.0]]
        tip = [TIP[0], TIP[1], TIP[2] + [0.0, 0.005, 0.0]]
        write_run(one, mesh, states, ENERGIES, TIP)
        write_run(two, mesh, off, energies, tip)
    comm.Barrier()
    return one, two


@pytest.mark.parallel(2)
def test_errors_on_one_mesh(pair: tuple[Path, Path], comm: MPI.Comm) -> None:
    one, two = (read_samples(comm, folder, TIME_KEYS, 0.1, [20]) for folder in pair)
    errors = run_errors(comm, two, one, QUANTITIES)
    assert errors["position_max"] == pytest.approx(0.05 / 0.5)
    # the corner of a diagonal grid that both triangles of its cell meet in: two thirds of 0.005 m²
    share = (2.0 * 0.005 / 3.0) / 0.12
    assert errors["position_l2"] == pytest.approx(math.sqrt(share * 0.05**2 / 2.0) / 0.5)
    assert errors["energy"] == pytest.approx(0.2 / 2.0)
    assert errors["probe_tip"] == pytest.approx(0.005 / 0.5)
    assert run_errors(comm, one, one, QUANTITIES) == dict.fromkeys(errors, 0.0)


class Falling(ExactMotion):
    """The motion of the first run."""

    def positions(self, start: Array, t: float) -> Array:
        return np.asarray(start - [0.0, 0.0, t])

    def energies(self, t: float) -> Energies:
        kinetic, membrane, _, potential = ENERGIES[round(10 * t)]
        return Energies(kinetic, membrane, potential)


@pytest.mark.parallel(2)
def test_errors_against_an_exact_motion(pair: tuple[Path, Path], comm: MPI.Comm) -> None:
    one, two = (read_samples(comm, folder, TIME_KEYS, 0.1, [20]) for folder in pair)
    exact = motion_errors(comm, one, Falling(), QUANTITIES)
    assert max(exact.values()) < 1e-15
    errors = motion_errors(comm, two, Falling(), QUANTITIES)
    assert errors == pytest.approx(run_errors(comm, two, one, QUANTITIES))


def linear(rest: Array, t: float) -> Array:
    """A field that linear interpolation reproduces exactly."""
    return np.asarray(rest @ np.array([[1.1, 0.2, 0.3], [-0.1, 0.9, 0.5], [0.0, 0.0, 1.0]]) + [t, 0.0, -t])


@pytest.mark.parallel(2)
@pytest.mark.parametrize("rows_at_once", [7, 1 << 16])
def test_errors_across_meshes(
    shared_tmp: Path, comm: MPI.Comm, rows_at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparison, "ROWS_AT_ONCE", rows_at_once)
    folders = {"coarse": grid(0.3, 0.4, 3, 2), "fine": grid(0.3, 0.4, 7, 9, "criss-cross")}
    if comm.rank == 0:
        for name, source in folders.items():
            mesh = mesh_of(source)
            write_run(shared_tmp / name, mesh, [linear(mesh.rest, t) for t in TIME_KEYS], ENERGIES, TIP)
    comm.Barrier()
    coarse, fine = (
        read_samples(comm, shared_tmp / name, TIME_KEYS, 0.1, [count])
        for name, count in (("coarse", 12), ("fine", 143))
    )
    for errors in (
        run_errors(comm, coarse, fine, QUANTITIES),
        run_errors(comm, fine, coarse, QUANTITIES),
    ):
        assert errors["position_max"] < 1e-14
        assert errors["energy"] == 0.0


def surface(mesh: Mesh) -> RestSurface:
    return RestSurface(mesh.rest, mesh.triangles, np.ones(mesh.n_vertices))


@pytest.mark.parallel(2)
def test_coincident_sheets_are_distinguished(comm: MPI.Comm, shared_tmp: Path) -> None:
    two = [grid(1.0, 1.0, 2, 2), grid(1.0, 1.0, 2, 2)]
    finer = [grid(1.0, 1.0, 4, 4), grid(1.0, 1.0, 4, 4)]
    coarse, fine = mesh_of(*two), mesh_of(*finer)
    transfer = make_interpolation(comm, surface(coarse), [9, 9], surface(fine), [25, 25])
    first, last = comm.rank * 18 // comm.size, (comm.rank + 1) * 18 // comm.size
    numbers = transfer.wanted[transfer.corner]
    for row, point in enumerate(range(first, last)):
        used = numbers[row][transfer.weight[row] > 1e-12]
        assert (used < 25).all() == (point < 9)


def test_curved_surfaces_are_projected() -> None:
    def cylinder(n: int) -> Mesh:
        mesh = mesh_of(grid(1.0, 1.0, n, n))
        angle = mesh.rest[:, 0].copy()
        mesh.rest = np.column_stack([np.sin(angle), mesh.rest[:, 1], np.cos(angle)])
        return mesh

    coarse, fine = cylinder(5), cylinder(23)
    transfer = make_interpolation(MPI.COMM_SELF, surface(coarse), [36], surface(fine), [576])
    found = np.einsum("nc,nci->ni", transfer.weight, fine.rest[transfer.wanted[transfer.corner]])
    assert np.linalg.norm(found - coarse.rest, axis=1).max() < (1.0 / 23.0) ** 2 / 8.0
    assert transfer.weight.min() >= 0.0
    assert np.allclose(transfer.weight.sum(axis=1), 1.0)


def test_weights_of_the_nearest_point() -> None:
    corners = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]] * 4)
    points = np.array([[0.25, 0.25, 0.3], [0.5, -1.0, 0.0], [2.0, 2.0, 0.0], [-1.0, -1.0, 0.5]])
    expected = [[0.5, 0.25, 0.25], [0.5, 0.5, 0], [0, 0.5, 0.5], [1, 0, 0]]
    assert np.allclose(barycentric(points, corners), expected)


def test_different_meshes_are_recognised(tmp_path: Path) -> None:
    one, two = surface(mesh_of(SHEET)), surface(mesh_of(grid(0.3, 0.4, 3, 4, "alternating")))
    assert one.same_as(one)
    assert not one.same_as(two)
    moved = RestSurface(one.rest + [0, 0, 1e-12], one.triangles, one.areas)
    assert one.same_as(moved)
    assert not one.same_as(RestSurface(one.rest * 1.001, one.triangles, one.areas))


def test_missing_samples_are_named(pair: tuple[Path, Path]) -> None:
    with pytest.raises(InputError, match=r"no state at t = 0.05 s, .* output.every = 0.05"):
        read_local(pair[0], [0.0, 0.05, 0.1], 0.05)
    with pytest.raises(InputError, match="no such folder"):
        read_local(pair[0] / "nowhere", TIME_KEYS, 0.1)
    (pair[0] / "mesh.h5").write_bytes(b"no HDF5")
    with pytest.raises(InputError, match=r"mesh\.h5: cannot be read"):
        read_surface(pair[0])
    with pytest.raises(InputError, match=r"mesh\.h5: cannot be read"):
        read_local(pair[0], TIME_KEYS, 0.1)


def test_areas_are_thirds_of_rest_areas(pair: tuple[Path, Path]) -> None:
    areas = read_surface(pair[0]).areas
    assert areas.sum() == pytest.approx(0.12)
    assert areas[0] == pytest.approx(2 * 0.005 / 3.0)
