"""Comparison of runs on one mesh and across meshes."""

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
from lyra_petsc.experiments.study.comparison import (
    Errors,
    RestSurface,
    Samples,
    error_history,
    interpolation,
    overall,
    read_samples,
    read_surface,
    samples_of_motion,
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
        writer.write(number, time, x, {})()
    names = "kinetic_energy,membrane_energy,bending_energy,potential_energy"
    rows = [f"{n},{TIME_KEYS[n]!r},{','.join(map(repr, row))}" for n, row in enumerate(energies)]
    (folder / "history.csv").write_text("\n".join([f"step,time,{names}", *rows]) + "\n")
    rows = [f"{n},{TIME_KEYS[n]!r},{','.join(map(repr, row.tolist()))}" for n, row in enumerate(tip)]
    (folder / "probes.csv").write_text("\n".join(["step,time,tip_x,tip_y,tip_z", *rows]) + "\n")


ENERGIES = [[0.0, 0.0, 0.0, 5.0], [1.0, 0.5, 0.0, 3.5], [2.0, 0.0, 0.0, 3.0]]
TIP = [np.zeros(3), np.array([0.0, 0.0, -0.1]), np.array([0.0, 0.0, -0.2])]


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """Two runs on one mesh; the second differs at 0.1 s by 0.05 m at one corner, and in energy and probe."""
    one, two = tmp_path / "one", tmp_path / "two"
    mesh = mesh_of(SHEET)
    states = [mesh.rest + [0, 0, -t] for t in TIME_KEYS]
    off = [x.copy() for x in states]
    off[1][0] += [0.03, 0.0, 0.04]
    energies = [[0.0, 0.0, 0.0, 5.0], [1.2, 0.5, 0.0, 3.5], [2.0, 0.0, 0.0, 3.0]]
    tip = [TIP[0], TIP[1], TIP[2] + [0.0, 0.005, 0.0]]
    write_run(one, mesh, states, ENERGIES, TIP)
    write_run(two, mesh, off, energies, tip)
    return one, two


def errors_of(run: Samples, reference: Samples) -> Errors:
    return overall(error_history(run, reference, QUANTITIES))


def test_errors_on_one_mesh(pair: tuple[Path, Path]) -> None:
    one, two = (read_samples(folder, TIME_KEYS, 0.1, [20]) for folder in pair)
    errors = errors_of(two, one)
    assert errors["position_max"] == pytest.approx(0.05 / 0.5)
    # the corner of a diagonal grid that both triangles of its cell meet in: two thirds of 0.005 m²
    share = (2.0 * 0.005 / 3.0) / 0.12
    assert errors["position_l2"] == pytest.approx(math.sqrt(share * 0.05**2 / 2.0) / 0.5)
    assert errors["energy"] == pytest.approx(0.2 / 2.0)
    assert errors["probe_tip"] == pytest.approx(0.005 / 0.5)
    assert errors_of(one, one) == dict.fromkeys(errors, 0.0)


class Falling(ExactMotion):
    """The motion of the first run."""

    def positions(self, start: Array, t: float) -> Array:
        return np.asarray(start - [0.0, 0.0, t])

    def energies(self, t: float) -> Energies:
        kinetic, membrane, _, potential = ENERGIES[round(10 * t)]
        return Energies(kinetic, membrane, potential)


def test_errors_against_an_exact_motion(pair: tuple[Path, Path]) -> None:
    one, two = (read_samples(folder, TIME_KEYS, 0.1, [20]) for folder in pair)
    assert max(errors_of(one, samples_of_motion(Falling(), one)).values()) < 1e-15
    assert errors_of(two, samples_of_motion(Falling(), two)) == pytest.approx(errors_of(two, one))


def linear(rest: Array, t: float) -> Array:
    """A field that linear interpolation reproduces exactly."""
    return np.asarray(rest @ np.array([[1.1, 0.2, 0.3], [-0.1, 0.9, 0.5], [0.0, 0.0, 1.0]]) + [t, 0.0, -t])


def test_errors_across_meshes(tmp_path: Path) -> None:
    folders = {"coarse": grid(0.3, 0.4, 3, 2), "fine": grid(0.3, 0.4, 7, 9, "criss-cross")}
    for name, source in folders.items():
        mesh = mesh_of(source)
        write_run(tmp_path / name, mesh, [linear(mesh.rest, t) for t in TIME_KEYS], ENERGIES, TIP)
    coarse, fine = (
        read_samples(tmp_path / name, TIME_KEYS, 0.1, [count])
        for name, count in (("coarse", 12), ("fine", 143))
    )
    for errors in (errors_of(coarse, fine), errors_of(fine, coarse)):
        assert errors["position_max"] < 1e-14
        assert errors["energy"] == 0.0


def surface(mesh: Mesh) -> RestSurface:
    return RestSurface(mesh.rest, mesh.triangles, np.ones(mesh.n_vertices))


def test_coincident_sheets_are_distinguished() -> None:
    coarse, fine = mesh_of(*2 * [grid(1.0, 1.0, 2, 2)]), mesh_of(*2 * [grid(1.0, 1.0, 4, 4)])
    corner, weight = interpolation(surface(coarse), [9, 9], surface(fine), [25, 25])
    for point in range(18):
        used = corner[point][weight[point] > 1e-12]
        assert (used < 25).all() == (point < 9)


def test_curved_surfaces_are_projected() -> None:
    def cylinder(n: int) -> Mesh:
        mesh = mesh_of(grid(1.0, 1.0, n, n))
        angle = mesh.rest[:, 0].copy()
        mesh.rest = np.column_stack([np.sin(angle), mesh.rest[:, 1], np.cos(angle)])
        return mesh

    coarse, fine = cylinder(5), cylinder(23)
    corner, weight = interpolation(surface(coarse), [36], surface(fine), [576])
    projected = np.einsum("nc,nci->ni", weight, fine.rest[corner])
    assert np.linalg.norm(projected - coarse.rest, axis=1).max() < (1.0 / 23.0) ** 2 / 8.0
    assert weight.min() >= 0.0
    assert np.allclose(weight.sum(axis=1), 1.0)


def test_different_meshes_are_recognised(tmp_path: Path) -> None:
    one, two = surface(mesh_of(SHEET)), surface(mesh_of(grid(0.3, 0.4, 3, 4, "alternating")))
    assert one.same_as(one)
    assert not one.same_as(two)
    moved = RestSurface(one.rest + [0, 0, 1e-12], one.triangles, one.areas)
    assert one.same_as(moved)
    assert not one.same_as(RestSurface(one.rest * 1.001, one.triangles, one.areas))


def test_missing_samples_are_named(pair: tuple[Path, Path]) -> None:
    with pytest.raises(InputError, match=r"no state at t = 0.05 s, .* output.every = 0.05"):
        read_samples(pair[0], [0.0, 0.05, 0.1], 0.05)
    with pytest.raises(InputError, match="no such folder"):
        read_samples(pair[0] / "nowhere", TIME_KEYS, 0.1)
    (pair[0] / "mesh.h5").write_bytes(b"no HDF5")
    with pytest.raises(InputError, match=r"mesh\.h5: cannot be read"):
        read_surface(pair[0])
    with pytest.raises(InputError, match=r"mesh\.h5: cannot be read"):
        read_samples(pair[0], TIME_KEYS, 0.1)
