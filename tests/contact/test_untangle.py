"""Starts that cross and are taken apart."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from brute_force import n_crossings
from layers import EDGE, KINDS, Layers, random_layers
from mpi4py import MPI
from physics import Simulation, grid, obj_file, scene_of

from lyra_petsc.arrays import Array
from lyra_petsc.contact.joined import crossings_beside_seams
from lyra_petsc.contact.start_crossings import PlacedScene, find_start_crossings
from lyra_petsc.contact.untangle import LARGEST_DISPLACEMENT, untangle
from lyra_petsc.errors import MarkedError
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.mesh.seams import sewn_curves

GAP = 0.2 * EDGE


def overlaps(cells: int) -> Iterator[Layers]:
    """Random layers that cross."""
    layers = (random_layers(seed, cells) for seed in itertools.count())
    return (one for one in layers if one.depth > 0.0)


def resolved(folder: Path, layers: Iterable[Layers]) -> list[bool]:
    """Whether each overlap is resolved; those that are, are checked."""
    results = []
    for one in layers:
        mesh = [obj_file(folder / f"{n}.obj", *sheet) for n, sheet in enumerate(one.sheets)]
        scene = scene_of({"mesh": mesh, "contact": {"gap": GAP, "untangle": True}})
        whole = build_scene_mesh(scene)
        start = whole.positions.copy()
        placed = PlacedScene(scene, whole, start, [])
        crossings = find_start_crossings(placed)
        assert n_crossings(start, whole.triangles) > 0
        assert crossings.crossings
        try:
            result = untangle(placed, crossings, GAP, {})
        except MarkedError:
            results.append(False)
            continue
        assert n_crossings(result.positions, whole.triangles) == 0
        moved = np.linalg.norm(result.positions - start, axis=1).max()
        assert moved == pytest.approx(result.largest)
        assert moved <= 3.0 * one.depth
        # heights are known along directions that vary slowly, and up to a distance
        assert 0.7 * one.depth <= result.depth <= one.depth + 0.1 * EDGE
        np.testing.assert_array_equal(whole.positions, start)
        results.append(True)
    return results


def test_one_overlap_of_each_kind(tmp_path: Path) -> None:
    layers = list(itertools.islice(overlaps(22), len(KINDS)))
    assert {one.kind for one in layers} == set(KINDS)
    assert all(resolved(tmp_path, layers))


@pytest.mark.slow
def test_at_least_95_of_100_overlaps_are_resolved(tmp_path: Path) -> None:
    layers = list(itertools.islice(overlaps(24), 100))
    assert max(one.depth for one in layers) > 4.9 * EDGE
    results = resolved(tmp_path, layers)
    assert len(results) == 100
    assert sum(results) >= 95


def tube(path: Path, radius: float, around: int, along: int, length: float) -> dict[str, Any]:
    """A tube about the z axis with triangles that are seen anticlockwise from outside."""
    angles = 2.0 * np.pi * np.arange(around) / around
    heights = np.linspace(-0.5 * length, 0.5 * length, along + 1)
    points = [(radius * np.cos(a), radius * np.sin(a), z) for z in heights for a in angles]
    faces = []
    for j in range(along):
        for i in range(around):
            a, b = j * around + i, j * around + (i + 1) % around
            faces += [(a, b, b + around), (a, b + around, a + around)]
    return obj_file(path, points, faces)


def ball(path: Path, radius: float, n: int) -> dict[str, Any]:
    """A closed surface: a cube's surface of n × n cells per side, moved to a sphere about the origin."""
    flat, triangles = rectangle(n, n, 2.0, 2.0)
    side = np.column_stack([flat[:, :2] - 1.0, np.ones(len(flat))])
    turned = [side[:, [2, 0, 1]], side, side[:, [1, 2, 0]]]
    points = np.concatenate([*turned, *(-np.asarray(turned))])
    faces = [triangles + k * len(flat) for k in range(3)]
    faces += [triangles[:, ::-1] + k * len(flat) for k in range(3, 6)]
    points, same = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    return obj_file(path, points, same.ravel()[np.concatenate(faces)])


def started(scene: dict[str, Any], comm: MPI.Comm = MPI.COMM_SELF) -> tuple[Array, dict[str, float]]:
    """Start positions in the order of the mesh, and the entry of summary.json."""
    with Simulation(scene, comm) as simulation:
        layout = simulation.problem.points
        own = simulation.equations.x[: layout.n_vertices]
        parts = comm.allgather((layout.mesh_vertex_of_local()[: layout.n_vertices], own.copy()))
        x = np.empty((simulation.problem.whole.n_vertices, 3))
        for numbers, values in parts:
            x[numbers] = values
        return x, simulation.problem.whole.summary["untangled"]


def shirt_in_body(folder: Path, body: dict[str, Any]) -> dict[str, Any]:
    mesh = tube(folder / "shirt.obj", 0.195, 40, 20, 0.4)
    return {"mesh": mesh, "contact": {"gap": 0.002, "untangle": True}, "obstacles": {"body": body}}


def test_a_shirt_starts_5_mm_inside_a_body(tmp_path: Path) -> None:
    scene = shirt_in_body(tmp_path, {"mesh": ball(tmp_path / "body.obj", 0.2, 12)})
    x, entry = started(scene)
    assert entry["pairs"] > 100
    assert 0.005 < entry["depth"] < 0.01
    assert entry["largest_displacement"] < 3.0 * 0.005
    # the body's triangles are chords of the sphere
    assert np.linalg.norm(x, axis=1).min() > 0.2 * np.cos(0.5 * np.pi / 12 / 2)


def test_a_shirt_starts_5_mm_inside_a_capsule(tmp_path: Path) -> None:
    body = {"capsule": {"from": [0, 0, -0.5], "to": [0, 0, 0.5], "radius": 0.2}}
    x, _ = started(shirt_in_body(tmp_path, body))
    assert np.hypot(x[:, 0], x[:, 1]).min() > 0.2


SHEET = grid(0.6, 0.6, 12, 12)

BODIES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "floor": (
        {"rotate": {"axis": [0, 1, 0], "degrees": 20}, "translate": [0, 0, 0.05]},
        {"plane": {"point": [0, 0, 0], "normal": [0, 0, 1]}},
    ),
    "floor, from a vertical sheet": (
        {"rotate": {"axis": [1, 0, 0], "degrees": 90}, "translate": [0, 0, -0.05]},
        {"plane": {"point": [0, 0, 0], "normal": [0, 0, 1]}},
    ),
    "sphere": (
        {"translate": [-0.3, -0.3, 0.14]},
        {"sphere": {"center": [0, 0, 0], "radius": 0.2}},
    ),
    "box": (
        {"translate": [-0.31, -0.29, 0.03]},
        {"box": {"min": [-0.1, -0.1, -0.2], "max": [0.1, 0.1, 0.05]}},
    ),
    "inside of a sphere": (
        {"translate": [-0.3, -0.3, 0]},
        {"sphere": {"center": [0, 0, 0], "radius": 0.41}, "inside": True},
    ),
}


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("thickness", [0.0, 0.003])
def test_sheets_leave_obstacles(name: str, thickness: float) -> None:
    transform, body = BODIES[name]
    scene = {
        "mesh": SHEET | {"transform": transform},
        "contact": {"gap": 0.002, "thickness": thickness, "untangle": True},
        "obstacles": {"body": body},
    }
    _, entry = started(scene)
    assert entry["largest_displacement"] <= LARGEST_DISPLACEMENT * entry["depth"]


def dented(folder: Path, depth: float) -> dict[str, Any]:
    """Two sheets of 0.3 m, 2 mm apart and flat at rest, the upper one with a dent; sides are held."""
    flat, triangles = rectangle(15, 15, 0.3, 0.3)
    mesh = []
    for number in (0, 1):
        x = np.column_stack([flat[:, :2], np.full(len(flat), 0.002 * number)])
        if number:
            inside = (np.sin(np.pi * flat[:, :2] / 0.3) ** 4).prod(axis=1)
            x[:, 2] -= depth * inside
        file = obj_file(folder / f"{depth:g}-{number}.obj", x, triangles, flat[:, :2])
        mesh.append(file | {"name": f"sheet{number}"})
    return {
        "mesh": mesh,
        "material": {"young": 1e5, "poisson": 0.3, "thickness": 1e-3, "density": 0.2},
        "handles": [
            {"box": [[-0.1, -0.1, -0.1], [0.001, 0.4, 0.1]]},
            {"box": [[0.299, -0.1, -0.1], [0.4, 0.4, 0.1]]},
        ],
        "contact": {"gap": 0.001, "untangle": True},
        "gravity": [0, 0, -9.81],
    }


@pytest.mark.parallel(2)
def test_the_same_start_on_any_number_of_ranks(comm: MPI.Comm, shared_tmp: Path) -> None:
    scene = dented(shared_tmp, 0.02) if comm.rank == 0 else None
    comm.Barrier()
    scene = comm.bcast(scene)
    x, entry = started(scene, comm)
    alone, alone_entry = started(scene)
    np.testing.assert_array_equal(x, alone)
    assert entry == alone_entry
    assert 0.01 < entry["depth"] < 0.03
    held = (alone[:, 0] == 0.0) | (alone[:, 0] == 0.3)
    assert held.sum() == 4 * 16
    assert set(alone[held, 2]) == {0.0, 0.002}


def test_what_cannot_be_resolved_is_refused(tmp_path: Path) -> None:
    scene = dented(tmp_path, 0.02) | {"handles": [{"group": "sheet0"}, {"group": "sheet1"}]}
    with pytest.raises(MarkedError, match=r"after contact.untangle .* between 'sheet0' and 'sheet1'"):
        started(scene)


def test_a_sheet_that_crosses_itself(tmp_path: Path) -> None:
    """A sheet that is folded over, and whose free end passes through itself."""
    flat, triangles = rectangle(40, 12, 0.4, 0.12)
    along, radius = flat[:, 0], 0.03
    angle = np.clip((along - 0.15) / radius, 0.0, np.pi)
    rest = np.maximum(along - 0.15 - np.pi * radius, 0.0)
    x = np.minimum(along, 0.15) + radius * np.sin(angle) - rest
    z = radius * (1.0 - np.cos(angle)) - 0.45 * rest
    mesh = obj_file(tmp_path / "fold.obj", np.column_stack([x, flat[:, 1], z]), triangles)
    _, entry = started({"mesh": mesh, "contact": {"gap": 0.002, "untangle": True}})
    assert entry["pairs"] > 10
    assert entry["largest_displacement"] <= LARGEST_DISPLACEMENT * entry["depth"]


def sewn_layers(sides: Iterable[str], cells: tuple[int, int], degrees: float) -> dict[str, Any]:
    """Two panels of 0.2 m on each other that cross along a line, and whose sides are sewn."""
    tilt = {"rotate": {"axis": [1, 0.3, 0], "degrees": degrees}, "translate": [0, 0, -0.02 * degrees / 12]}
    front, back = (grid(0.2, 0.2, n, n) for n in cells)
    return {
        "mesh": [front | {"name": "front"}, back | {"name": "back", "transform": tilt}],
        "seams": [
            {"between": [f"front/{side}", f"back/{side}"], "close": {"from": 0, "until": 0.1}}
            for side in sides
        ],
        "contact": {"gap": 0.002, "untangle": True},
    }


@pytest.mark.parametrize("cells", [(10, 12), (12, 12)])
@pytest.mark.parametrize("sides", [("right",), ("left", "right"), ("left", "right", "top")])
@pytest.mark.parametrize("degrees", [2.0, 4.0])
def test_layers_that_seams_join(sides: tuple[str, ...], cells: tuple[int, int], degrees: float) -> None:
    scene = sewn_layers(sides, cells, degrees)
    x, entry = started(scene)
    mesh = build_scene_mesh(scene_of(scene))
    assert len(mesh.tied) > 0
    assert n_crossings(mesh.positions, mesh.triangles) > 20
    assert n_crossings(x, mesh.triangles) == 0
    assert entry["largest_displacement"] <= 3.0 * entry["depth"]
    # half of the greatest height of one above the other
    assert entry["depth"] < 0.2 * np.sin(np.radians(degrees))


def test_a_seam_that_holds_its_sides_together_stays(tmp_path: Path) -> None:
    """Panels of different numbers of vertices, sewn without a gap, and a third that passes through them."""
    content = sewn_layers([], (10, 12), 0.0)
    flat = {"transform": {"translate": [0.2, 0, 0]}}
    third = grid(0.1, 0.1, 6, 6) | {
        "name": "third",
        "transform": {"rotate": {"axis": [0, 1, 0], "degrees": 15}, "translate": [0.12, 0.05, 0.006]},
    }
    content["mesh"] = [content["mesh"][0], content["mesh"][1] | flat, third]
    content["seams"] = [{"between": ["front/right", "back/left"]}]
    x, entry = started(content)
    mesh = build_scene_mesh(scene_of(content))
    ties = sewn_curves(scene_of(content), mesh)[0].ties
    assert n_crossings(mesh.positions, mesh.triangles) > 0
    assert entry["largest_displacement"] > 0.002
    assert np.linalg.norm(x - mesh.positions, axis=1)[np.unique(ties.stencil)].max() > 1e-4
    assert np.linalg.norm(ties.gaps(x), axis=1).max() < 0.1 * entry["largest_displacement"]
    assert len(crossings_beside_seams(x, mesh.triangles, mesh.tied)) == 0
