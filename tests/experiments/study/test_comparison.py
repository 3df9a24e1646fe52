"""Runs compared on one mesh and across meshes."""

from __future__ import annotations

import math
from pathlib import Path

import h5py
import numpy as np
import pytest
from physics import grid, scene_of

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.exact_motions import Energies, ExactMotion
from lyra_petsc.experiments.study.comparison import (
    against_motion,
    against_run,
    barycentric,
    located,
    read_samples,
    same_mesh,
    vertex_areas,
)
from lyra_petsc.experiments.study.plan import ENERGY, POSITION, probe_quantity
from lyra_petsc.mesh.build import build_mesh
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.output.stored import StoredMesh

pytest.importorskip("scipy")

TIMES = (0.0, 0.1, 0.2)
QUANTITIES = [*POSITION, ENERGY, probe_quantity("tip")]
SHEET = grid(0.3, 0.4, 3, 4)  # diagonal 0.5 m


def mesh_of(*sources: object) -> Mesh:
    return build_mesh(scene_of({"mesh": list(sources)}).mesh)


def write_run(
    folder: Path, mesh: Mesh, states: list[Array], energies: list[list[float]], tip: list[Array]
) -> None:
    """The files of a run as far as a comparison reads them."""
    folder.mkdir()
    with h5py.File(folder / "mesh.h5", "w") as file:
        file["mesh/rest"], file["mesh/triangles"] = mesh.rest, mesh.triangles
        file["mesh/corner_uv"] = mesh.triangle_uv
    for number, (time, x) in enumerate(zip(TIMES, states, strict=True)):
        with h5py.File(folder / f"states-{number:04d}.h5", "w") as file:
            file[f"states/{number:06d}/position"] = x
            file[f"states/{number:06d}"].attrs["time"] = time
            file[f"states/{number:06d}"].attrs["step"] = number
    names = "kinetic_energy,membrane_energy,bending_energy,potential_energy"
    rows = [f"{n},{TIMES[n]!r},{','.join(map(repr, row))}" for n, row in enumerate(energies)]
    (folder / "history.csv").write_text("\n".join([f"step,time,{names}", *rows]) + "\n")
    rows = [f"{n},{TIMES[n]!r},{','.join(map(repr, row.tolist()))}" for n, row in enumerate(tip)]
    (folder / "probes.csv").write_text("\n".join(["step,time,tip_x,tip_y,tip_z", *rows]) + "\n")


ENERGIES = [[0.0, 0.0, 0.0, 5.0], [1.0, 0.5, 0.0, 3.5], [2.0, 0.0, 0.0, 3.0]]
TIP = [np.zeros(3), np.array([0.0, 0.0, -0.1]), np.array([0.0, 0.0, -0.2])]


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """Two runs on one mesh: the second is off by 0.05 m in one corner at 0.1 s, and in energy and probe."""
    one, two = tmp_path / "one", tmp_path / "two"
    mesh = mesh_of(SHEET)
    states = [mesh.rest + [0, 0, -t] for t in TIMES]
    off = [x.copy() for x in states]
    off[1][0] += [0.03, 0.0, 0.04]
    energies = [[0.0, 0.0, 0.0, 5.0], [1.2, 0.5, 0.0, 3.5], [2.0, 0.0, 0.0, 3.0]]
    tip = [TIP[0], TIP[1], TIP[2] + [0.0, 0.005, 0.0]]
    write_run(one, mesh, states, ENERGIES, TIP)
    write_run(two, mesh, off, energies, tip)
    return one, two


def test_errors_on_one_mesh(pair: tuple[Path, Path]) -> None:
    one, two = (read_samples(folder, TIMES, 0.1, [20]) for folder in pair)
    errors = against_run(two, one, QUANTITIES)
    assert errors["position_max"] == pytest.approx(0.05 / 0.5)
    # the corner of a diagonal grid that both triangles of its cell meet in: two thirds of 0.005 m²
    share = (2.0 * 0.005 / 3.0) / 0.12
    assert errors["position_l2"] == pytest.approx(math.sqrt(share * 0.05**2 / 2.0) / 0.5)
    assert errors["energy"] == pytest.approx(0.2 / 2.0)
    assert errors["probe_tip"] == pytest.approx(0.005 / 0.5)
    assert against_run(one, one, QUANTITIES) == dict.fromkeys(errors, 0.0)


class Falling(ExactMotion):
    """The motion of the first run."""

    def positions(self, start: Array, t: float) -> Array:
        return np.asarray(start - [0.0, 0.0, t])

    def energies(self, t: float) -> Energies:
        kinetic, membrane, _, potential = ENERGIES[round(10 * t)]
        return Energies(kinetic, membrane, potential)


def test_errors_against_an_exact_motion(pair: tuple[Path, Path]) -> None:
    one, two = (read_samples(folder, TIMES, 0.1, [20]) for folder in pair)
    exact = against_motion(one, Falling(), QUANTITIES)
    assert max(exact.values()) < 1e-15
    errors = against_motion(two, Falling(), QUANTITIES)
    assert errors == pytest.approx(against_run(two, one, QUANTITIES))


def linear(rest: Array, t: float) -> Array:
    """A field that linear interpolation gives exactly."""
    return np.asarray(rest @ np.array([[1.1, 0.2, 0.3], [-0.1, 0.9, 0.5], [0.0, 0.0, 1.0]]) + [t, 0.0, -t])


def test_errors_across_meshes(tmp_path: Path) -> None:
    for name, source in {"coarse": grid(0.3, 0.4, 3, 2), "fine": grid(0.3, 0.4, 7, 9, "criss-cross")}.items():
        mesh = mesh_of(source)
        write_run(tmp_path / name, mesh, [linear(mesh.rest, t) for t in TIMES], ENERGIES, TIP)
    coarse, fine = (
        read_samples(tmp_path / name, TIMES, 0.1, [count]) for name, count in (("coarse", 12), ("fine", 143))
    )
    for errors in (against_run(coarse, fine, QUANTITIES), against_run(fine, coarse, QUANTITIES)):
        assert errors["position_max"] < 1e-14
        assert errors["energy"] == 0.0


def test_sheets_that_lie_on_each_other_are_kept_apart() -> None:
    coarse, fine = (mesh_of(*[grid(1.0, 1.0, n, n)] * 2) for n in (2, 4))
    corners, weights = located(coarse, [9, 9], fine, [25, 25])
    for point in range(18):
        used = corners[point][weights[point] > 1e-12]
        assert (used < 25).all() == (point < 9)


def test_curved_surfaces_are_projected() -> None:
    def cylinder(n: int) -> Mesh:
        mesh = mesh_of(grid(1.0, 1.0, n, n))
        angle = mesh.rest[:, 0].copy()
        mesh.rest = np.column_stack([np.sin(angle), mesh.rest[:, 1], np.cos(angle)])
        return mesh

    coarse, fine = cylinder(5), cylinder(23)
    corners, weights = located(coarse, [36], fine, [576])
    found = np.einsum("nc,nci->ni", weights, fine.rest[corners])
    assert np.linalg.norm(found - coarse.rest, axis=1).max() < (1.0 / 23.0) ** 2 / 8.0
    assert weights.min() >= 0.0
    assert np.allclose(weights.sum(axis=1), 1.0)


def test_weights_of_the_nearest_place() -> None:
    corners = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]] * 4)
    places = np.array([[0.25, 0.25, 0.3], [0.5, -1.0, 0.0], [2.0, 2.0, 0.0], [-1.0, -1.0, 0.5]])
    expected = [[0.5, 0.25, 0.25], [0.5, 0.5, 0], [0, 0.5, 0.5], [1, 0, 0]]
    assert np.allclose(barycentric(places, corners), expected)


def test_other_meshes_are_told_apart() -> None:
    one = mesh_of(SHEET)
    assert same_mesh(one, one)
    assert not same_mesh(one, mesh_of(grid(0.3, 0.4, 3, 4, "alternating")))
    moved, larger = mesh_of(SHEET), mesh_of(SHEET)
    moved.rest = one.rest + [0, 0, 1e-12]
    assert same_mesh(one, moved)
    larger.rest = one.rest * 1.001
    assert not same_mesh(one, larger)


def test_missing_samples_are_named(pair: tuple[Path, Path]) -> None:
    with pytest.raises(InputError, match=r"no state at t = 0.05 s, .* output.every = 0.05"):
        read_samples(pair[0], [0.0, 0.05, 0.1], 0.05)
    with pytest.raises(InputError, match="holds no states"):
        read_samples(pair[0] / "nowhere", TIMES, 0.1)
    (pair[0] / "mesh.h5").write_bytes(b"no HDF5")
    with pytest.raises(InputError, match=r"mesh\.h5: cannot be read"):
        read_samples(pair[0], TIMES, 0.1)


def test_areas_are_thirds_of_rest_areas(pair: tuple[Path, Path]) -> None:
    areas = vertex_areas(StoredMesh(pair[0]))
    assert areas.sum() == pytest.approx(0.12)
    assert areas[0] == pytest.approx(2 * 0.005 / 3.0)
