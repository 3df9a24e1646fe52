"""Starts that contact refuses, with the place."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import Simulation, grid, obj_file

from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.meshes import rectangle

pytestmark = pytest.mark.parallel(2)

SHEET: dict[str, Any] = {"mesh": grid(1.0, 1.0, 4, 4), "contact": {"gap": 0.02}}
"""A sheet in the plane z = 0, from x, y = 0 to 1."""


def sheet(**changes: Any) -> dict[str, Any]:
    return SHEET | changes


def obstacle(**shape: Any) -> dict[str, Any]:
    return sheet(obstacles={"thing": shape})


def refusal(comm: MPI.Comm, scene: dict[str, Any]) -> str:
    """The message, which is the same on all ranks."""
    with pytest.raises(InputError) as caught, Simulation(scene, comm):
        pass
    text = str(caught.value)
    assert comm.allgather(text) == [text] * comm.size
    assert "\n" not in text
    return text


@pytest.mark.parallel(1)
def test_a_sheet_of_obtuse_triangles_does_not_repel_itself(tmp_path: Path) -> None:
    """Their heights are 0.16 of the shortest edge; a gap given that is larger is less there, with a note."""
    vertices = [(i + 0.5 * (j % 2), 0.08 * j, 0.0) for j in range(3) for i in range(4)]
    faces = [corners for a in (0, 1, 2) for corners in ((a, a + 1, a + 4), (a + 1, a + 5, a + 4))]
    faces += [corners for a in (4, 5, 6) for corners in ((a, a + 1, a + 5), (a, a + 5, a + 4))]
    mesh = obj_file(tmp_path / "obtuse.obj", vertices, faces)
    for contact, gap in (({}, 0.7 * 0.08), ({"gap": 0.1}, 0.1), ({"gap": 0.05, "thickness": 0.05}, 0.05)):
        with Simulation({"mesh": mesh, "contact": contact}) as simulation:
            term = simulation.problem.terms["contact"]
            assert isinstance(term, ContactBarrier)
            assert term.barrier.gap == pytest.approx(gap)
            assert simulation.energy("contact") == 0.0
            assert any("but less at" in note for note in simulation.problem.whole.notes) == bool(contact)


def with_sliver(path: Path, distance: float = 0.0) -> dict[str, Any]:
    """A sheet of 6 × 5 cells of 0.1 m, two vertices of which are 1e-4 m apart; above it another sheet."""
    flat, faces = rectangle(6, 5, 0.6, 0.5)
    vertices = np.column_stack([flat[:, :2], 0.0 * flat[:, 0]])
    vertices[17] = vertices[16] + [1e-4, 0.0, 0.0]
    if distance:
        above = vertices[[0, 4, 32]] + [0.05, 0.03, distance]
        vertices, faces = np.concatenate([vertices, above]), np.concatenate([faces, [[42, 43, 44]]])
    return obj_file(path, vertices, faces)


@pytest.mark.parallel(1)
def test_one_sliver_does_not_decide_the_gap(tmp_path: Path) -> None:
    mesh = with_sliver(tmp_path / "sliver.obj")
    for contact, gap in (({}, 0.027), ({"gap": 0.06}, 0.06)):
        with Simulation({"mesh": mesh, "contact": contact}) as simulation:
            whole = simulation.problem.whole
            assert whole.barrier is not None
            assert whole.barrier.gap == pytest.approx(gap, rel=0.1)
            assert simulation.energy("contact") == 0.0
            (note,) = (note for note in whole.notes if "but less at" in note)
            assert "m at vertex 16" in note
    with pytest.raises(
        InputError, match=r"gap \+ thickness = 0\.11 m is not below the shorter edges, 0\.1 m"
    ):
        Simulation({"mesh": mesh, "contact": {"gap": 0.11}})


def test_contact_beside_a_sliver_on_two_ranks(comm: MPI.Comm, shared_tmp: Path) -> None:
    mesh = with_sliver(shared_tmp / "sliver.obj", 0.01) if comm.rank == 0 else None
    scene = {"mesh": comm.bcast(mesh), "contact": {}, "gravity": [0, 0, 0]}
    results = []
    for each in (comm, MPI.COMM_SELF):
        with Simulation(scene, each) as simulation:
            results.append((simulation.energy("contact"), simulation.run(1e-3, 2)))
    assert results[1][0] > 0.0
    assert results[0][0] == pytest.approx(results[1][0], rel=1e-12)
    np.testing.assert_allclose(results[0][1], results[1][1], rtol=0.0, atol=1e-10)


OVERLAPS: dict[str, tuple[dict[str, Any], str]] = {
    "sphere": (
        {"sphere": {"center": [0.4, 0.3, 0.05], "radius": 0.06}},
        "1 triangle of the sheet reaches into it",
    ),
    "capsule that passes through": (
        {"capsule": {"from": [0.42, 0.35, -1], "to": [0.42, 0.35, 1], "radius": 0.01}},
        "1 triangle of the sheet reaches into it",
    ),
    "box around the sheet": ({"box": {"min": [-1, -1, -1], "max": [2, 2, 1]}}, "32 triangles of the sheet"),
    "plane": (
        {"plane": {"point": [0.9, 0, 0], "normal": [-1, 0, 0]}},
        "8 triangles of the sheet reach beyond",
    ),
    "box inside": ({"box": {"min": [-1, -1, -1], "max": [2, 0.9, 1]}, "inside": True}, "8 triangles"),
}


@pytest.mark.parametrize("name", OVERLAPS)
def test_a_sheet_within_an_obstacle(comm: MPI.Comm, name: str) -> None:
    shape, words = OVERLAPS[name]
    text = refusal(comm, obstacle(**shape))
    assert text.startswith("obstacles.thing: at the start ")
    assert words in text
    assert " around (" in text


def test_a_mesh_that_crosses(comm: MPI.Comm, shared_tmp: Path) -> None:
    if comm.rank == 0:
        obj_file(shared_tmp / "blade.obj", [(0.3, 0.1, -1), (0.3, 0.1, 1), (0.3, 0.3, 0)], [(0, 1, 2)])
    comm.Barrier()
    text = refusal(comm, obstacle(mesh={"file": str(shared_tmp / "blade.obj")}))
    assert "2 pairs of triangles of sheet and obstacle cross (counted from 0, the first: " in text


def test_sheets_that_cross(comm: MPI.Comm) -> None:
    other = grid(1.0, 1.0, 1, 1) | {"transform": {"rotate": {"axis": [1, 0, 0], "degrees": 90}}}
    other["transform"]["translate"] = [0.0, 0.6, -0.5]
    scene = sheet(mesh=[SHEET["mesh"], other])
    text = refusal(comm, scene)
    assert text.startswith("contact: at the start ")
    assert "pairs of triangles cross (counted from 0, the first: " in text
    with Simulation(scene | {"contact": {"gap": 0.02, "self": False}}, comm):
        pass


def test_noise_of_the_start_is_included(comm: MPI.Comm) -> None:
    floor = obstacle(plane={"point": [0, 0, -0.01], "normal": [0, 0, 1]})
    with Simulation(floor, comm):
        pass
    assert "reach beyond it" in refusal(comm, floor | {"initial": {"noise": 0.02, "seed": 1}})


def test_nearer_than_thickness(comm: MPI.Comm) -> None:
    scene = obstacle(plane={"point": [0, 0, -0.003], "normal": [0, 0, 1]})
    with Simulation(scene | {"contact": {"gap": 0.02, "thickness": 0.002}}, comm) as simulation:
        equations, contact = simulation.equations, simulation.problem.terms["contact"]
        assert isinstance(contact, ContactBarrier)
        energies = contact.energies(equations.x, equations.step.frozen[contact])
        total = comm.allreduce(float(energies.sum()))
    # 16 vertices inside the gap, in the first state, before any step
    stiffness, left, gap = contact.barrier.stiffness, 0.001, 0.02
    assert total == pytest.approx(16 * stiffness * (gap - left) ** 3 / left)
    text = refusal(comm, scene | {"contact": {"gap": 0.02, "thickness": 0.004}})
    assert text == (
        "obstacles.thing: at the start vertex 0 and the obstacle 'thing', around (0, 0, 0) m, are 0.003 m "
        "apart, not more than contact.thickness = 0.004 m; move them apart, or give a smaller thickness"
    )


def test_touching_sheets_are_refused(comm: MPI.Comm) -> None:
    text = refusal(comm, obstacle(plane={"point": [0, 0, 0], "normal": [0, 0, 1]}))
    assert text == (
        "obstacles.thing: at the start vertex 0 and the obstacle 'thing', around (0, 0, 0) m, are not apart; "
        "move them apart"
    )


def test_distances_near_zero_are_refused(comm: MPI.Comm) -> None:
    above = SHEET["mesh"] | {"transform": {"translate": [0, 0, 1e-9]}}
    text = refusal(comm, sheet(mesh=[SHEET["mesh"], above], contact={"gap": 0.02}))
    assert re.match(r"contact: at the start (vertex \d+|edge \d+-\d+|the triangle .*) and ", text)
    assert text.endswith(
        " are 1e-09 m apart, less than a thousandth of contact.gap, which would throw them from each other; "
        "move them apart, best by 0.02 m"
    )


def test_sheets_nearer_than_thickness(comm: MPI.Comm) -> None:
    above = SHEET["mesh"] | {"transform": {"translate": [0.1, 0.03, 0.003]}}
    scene = sheet(mesh=[SHEET["mesh"], above])
    with Simulation(scene, comm):
        pass
    text = refusal(comm, scene | {"contact": {"gap": 0.02, "thickness": 0.004}})
    assert re.match(r"contact: at the start (vertex \d+|edge \d+-\d+|the triangle .*) and ", text)
    assert " are 0.003 m apart, not more than contact.thickness = 0.004 m" in text
