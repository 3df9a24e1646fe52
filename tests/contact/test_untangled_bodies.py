"""Sheets that start in closed meshes: they are told, and brought out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from brute_force import pierced, ray_lengths
from mpi4py import MPI
from physics import Simulation, grid, obj_file

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact.enclosed import winding_numbers
from lyra_petsc.errors import MarkedError
from lyra_petsc.mesh.obj_file import read_obj

MANNEQUIN = Path(__file__).parents[2] / "meshes" / "mannequin.obj"

CUBE = np.array([[i, j, k] for k in (-1.0, 1.0) for j in (-1.0, 1.0) for i in (-1.0, 1.0)])
SIDES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
CUBE_TRIANGLES = SIDES[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def test_winding_numbers() -> None:
    at = np.array([[0.3, -0.2, 0.5], [0.999, 0.999, -0.999], [1.5, 0.0, 0.0], [0.3, -0.2, 1.0]])
    corners = CUBE[CUBE_TRIANGLES]
    np.testing.assert_allclose(winding_numbers(at, corners), [1.0, 1.0, 0.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(winding_numbers(at, corners[:, ::-1]), [-1.0, -1.0, 0.0, -0.5], atol=1e-12)
    np.testing.assert_allclose(winding_numbers(at[:1], np.concatenate([corners, 0.25 * corners])), [1.0])
    np.testing.assert_allclose(winding_numbers(at[:1], np.concatenate([corners, 2.0 * corners])), [2.0])


def in_box(
    folder: Path, *, height: float, untangle: bool, turned: bool = False, closed: bool = True
) -> dict[str, Any]:
    """Two sheets of 0.1 m, of which one is above and one is in a box of 0.2 m, whose top is at z = 0.1 m."""
    triangles = CUBE_TRIANGLES[:, ::-1] if turned else CUBE_TRIANGLES
    box = obj_file(folder / "box.obj", 0.1 * CUBE, triangles if closed else triangles[:-2])
    sheets = [
        grid(0.1, 0.1, 8, 8) | {"name": name, "transform": {"translate": [-0.05, -0.06, z]}}
        for name, z in (("above", 0.15), ("lining", height))
    ]
    return {
        "mesh": sheets,
        "contact": {"gap": 0.002, "untangle": untangle},
        "obstacles": {"chest": {"mesh": box}},
    }


@pytest.mark.parametrize("turned", [False, True])
def test_a_sheet_inside_of_a_closed_mesh_is_told(tmp_path: Path, turned: bool) -> None:
    with Simulation(
        in_box(tmp_path, height=0.095, untangle=False, turned=turned), MPI.COMM_SELF
    ) as simulation:
        (note,) = (note for note in simulation.problem.whole.notes if "wholly inside" in note)
    assert note.startswith("obstacles.chest: at the start 128 triangles of the sheet lie wholly inside of it")
    assert "128 of 'lining'" in note
    assert "'above'" not in note
    assert "untangle: true" in note


@pytest.mark.parametrize(
    ("height", "closed"), [(0.101, True), (0.095, False)], ids=["outside", "mesh that is open"]
)
def test_others_are_not(tmp_path: Path, height: float, closed: bool) -> None:
    with Simulation(
        in_box(tmp_path, height=height, untangle=True, closed=closed), MPI.COMM_SELF
    ) as simulation:
        assert not any("wholly inside" in note for note in simulation.problem.whole.notes)
        assert "untangled" not in simulation.problem.whole.summary


@pytest.mark.parametrize("turned", [False, True])
def test_it_is_brought_out(tmp_path: Path, turned: bool) -> None:
    with Simulation(
        in_box(tmp_path, height=0.095, untangle=True, turned=turned), MPI.COMM_SELF
    ) as simulation:
        entry, x = simulation.problem.whole.summary["untangled"], simulation.x
    assert entry["pairs"] == 128
    assert entry["depth"] == pytest.approx(0.005)
    assert entry["largest_displacement"] <= 0.015
    assert x[81:, 2].min() > 0.1
    assert x[81:, 2].max() < 0.11
    np.testing.assert_allclose(x[:81, 2], 0.15)


def test_or_refused_if_it_is_too_deep(tmp_path: Path) -> None:
    with (
        pytest.raises(MarkedError, match=r"128 of 'lining'; .*leave out contact.untangle") as caught,
        Simulation(in_box(tmp_path, height=0.01, untangle=True), MPI.COMM_SELF),
    ):
        pass
    assert "after contact.untangle 128 triangles of the sheet lie wholly inside" in str(caught.value)


LIMBS = {
    "forearm": ((0.38, 0.005, 1.09), (0.47, 0.028, 0.94), 20, 10),
    "thigh": ((0.108, 0.0, 0.75), (0.113, 0.0, 0.52), 28, 10),
    "waist": ((0.0, 0.0, 1.05), (0.0, 0.005, 1.25), 40, 10),
}
"""Ends of an axis in the mannequin, and cells around and along a tube about it."""


def sleeve(limb: str, body: tuple[Array, Ints], depth: float, *, even: bool) -> tuple[Array, Ints]:
    """A tube whose vertices are ``depth`` [m] below the surface of a limb, or around it with one ``even``
    radius.
    """
    start, end, around, along = LIMBS[limb]
    axis = np.subtract(end, start)
    first = np.cross(axis, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(axis / np.linalg.norm(axis), first)
    angles = 2.0 * np.pi * np.arange(around) / around
    directions = np.outer(np.cos(angles), first) + np.outer(np.sin(angles), second)
    places = [np.array(start) + part * axis for part in np.linspace(0.0, 1.0, along + 1)]
    radii = np.array([ray_lengths(place, directions, *body) for place in places])
    if even:
        radii[:] = np.median(radii)
    points = np.concatenate(
        [at + (r - depth)[:, None] * directions for at, r in zip(places, radii, strict=True)]
    )
    number = np.arange(len(points)).reshape(along + 1, around)
    a, b = number[:-1], np.roll(number, -1, axis=1)[:-1]
    c, d = np.roll(number, -1, axis=1)[1:], number[1:]
    triangles = [np.stack(corners, axis=2).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    return points, np.concatenate(triangles)


@pytest.mark.parametrize(
    ("limb", "even"), [("forearm", False), ("thigh", False), ("waist", False), ("thigh", True)]
)
def test_a_sleeve_starts_5_mm_inside_the_mannequin(tmp_path: Path, limb: str, even: bool) -> None:
    body = read_obj(MANNEQUIN)
    surface = body.points, body.triangles
    start, triangles = sleeve(limb, surface, 0.005, even=even)
    scene = {
        "mesh": obj_file(tmp_path / "sleeve.obj", start, triangles),
        "contact": {"gap": 0.002, "untangle": True, "friction": 0.3},
        "obstacles": {"body": {"mesh": {"file": str(MANNEQUIN)}}},
        "gravity": [0, 0, -9.81],
    }
    with Simulation(scene, MPI.COMM_SELF) as simulation:
        entry = simulation.problem.whole.summary["untangled"]
        states = [simulation.x]
        states += [simulation.run(0.002, 1) for _ in range(3)]
    moved = np.linalg.norm(states[0] - start, axis=1).max()
    assert moved == pytest.approx(entry["largest_displacement"])
    assert moved <= 3.0 * (entry["depth"] if even else 0.005)
    assert entry["pairs"] > 100
    for x in states:
        assert len(pierced(x, triangles, *surface, same=False)) == 0
        assert len(pierced(*surface, x, triangles, same=False)) == 0
        outside = winding_numbers(x[:: len(x) // 20], surface[0][surface[1]])
        np.testing.assert_allclose(outside, 0.0, atol=1e-9)
