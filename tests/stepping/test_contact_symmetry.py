"""A half and a quarter with symmetry planes touch obstacles, and each other, as the whole sheet does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import finished, grid, mirrored, obj_file, scene_of, shape, stepped, symmetry_planes

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.mesh.symmetry import symmetry_walls
from lyra_petsc.stepping.simulation import SteppedScene

pytestmark = pytest.mark.parallel(2)

GAP = 0.015

SHAPES: dict[str, dict[str, Any]] = {
    "plane": {"plane": {"point": [0, 0, 0], "normal": [0, 0, 1]}},
    "sphere": {"sphere": {"center": [0, 0, -0.3], "radius": 0.3}},
    "box": {"box": {"min": [-0.1, -0.13, -0.3], "max": [0.1, 0.13, 0.0]}},
    "pyramid": {},
    "sheet": {},
}
"""Symmetric to the planes x = 0 and y = 0. Edges of the sheets lie in these planes and cross edges of the
box and of the pyramid, whose top is under a vertex.
"""


def touching(name: str, folder: Path, images: str) -> tuple[dict[str, Any], Array, Array]:
    """A curved sheet that falls on an obstacle or on another sheet, with its ``images``; vertices at the
    start, and the number of the sheet of each.
    """
    planes = "xy".translate(str.maketrans("", "", images))
    made = [mirrored(folder / f"0{images}.obj", images, 3, lambda flat: 0.02 + 0.02 * flat[:, 0] ** 2, 0.3)]
    if name == "sheet":
        made.append(
            mirrored(folder / f"1{images}.obj", images, 3, lambda flat: 0.045 + 0.0 * flat[:, 0], 0.25)
        )
    start = made[0][1]
    handles = symmetry_planes(planes)
    scene: dict[str, Any] = {
        "mesh": [mesh for mesh, _ in made],
        "material": {"young": 2e5, "poisson": 0.3, "thickness": 0.005, "density": 200.0},
        "handles": handles,
        "contact": {"gap": GAP},
        "gravity": [0, 0, -9.81],
        "initial": {"velocity": [0, 0, -0.5]},
        "time": {"end": 0.12, "step": 0.01},
        "solver": {"force_tolerance": 1e-10, "step_tolerance": 1e-10},
    }
    if name == "sheet":
        ends = np.flatnonzero(np.abs(np.abs(start[:, 0]) - 0.3) < 1e-9)
        scene["handles"] = [*handles, {"nodes": ends.tolist()}]
        # the images of two sheets are not seen by edges, which repel each other when pressed on
        scene |= {"gravity": [0, 0, -1], "initial": {"velocity": [0, 0, -0.2]}}
    elif name == "pyramid":
        corners = [(0.0, 0.0, 0.0), *((x, y, -0.1) for x, y in ((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1)))]
        faces = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1)]
        mesh = obj_file(folder / f"pyramid{images}.obj", [*corners, (0.1, -0.1, -0.1)], faces)
        scene["obstacles"] = {"it": {"mesh": mesh}}
    else:
        scene["obstacles"] = {"it": SHAPES[name]}
    sheet = np.repeat(np.arange(len(made)), [len(vertices) for _, vertices in made])
    return scene, np.concatenate([vertices for _, vertices in made]), sheet


# without friction the middle of the sheet stays above a side between two triangles of the box
@pytest.mark.parametrize(("name", "friction"), [*((name, 0.3) for name in SHAPES), ("box", 0.0)])
def test_a_part_touches_as_the_whole(comm: MPI.Comm, shared_tmp: Path, name: str, friction: float) -> None:
    images = ("xy", "x", "")
    made = [touching(name, shared_tmp, each) for each in images] if comm.rank == 0 else []
    results = []
    for each, (scene, start, sheet) in zip(images, comm.bcast(made), strict=True):
        energies, forces = [], []
        scene["contact"]["friction"] = friction
        with stepped(comm, scene, ksp_rtol=1e-12) as run:  # edges slide in parallel, which is sensitive
            equations, term = run.problem.equations, run.problem.terms["contact"]
            while not run.finished:
                run.step()
                here = float(term.energies(equations.x, equations.step.frozen[term]).sum())
                energies.append([comm.allreduce(here), run.budget.dissipation, run.budget.membrane])
                forces.append(run.energy_balance.obstacle_forces(len(scene.get("obstacles", {})))[:, 2])
            x = shape(run)
        part = np.flatnonzero((start[:, :2] >= 0.0).all(axis=1))
        part = part[np.lexsort((*np.round(start[part, :2].T, 9), sheet[part]))]
        share = 2.0 ** (2 - len(each))
        results.append((x[part], share * np.array(energies), share * np.array(forces)))
    # edges near the planes do not see the images of others
    tolerance = (5e-3, 1e-2) if name == "sheet" else (1e-4, 1e-5)
    whole = results[0]
    assert whole[1][:, 0].max() > 1e-3
    for part_of in results[1:]:
        np.testing.assert_allclose(part_of[0], whole[0], rtol=0.0, atol=tolerance[0] * GAP)
        for found, expected in zip(part_of[1:], whole[1:], strict=True):
            scale = np.abs(expected).max(axis=0, initial=0.0)
            assert (np.abs(found - expected) <= tolerance[1] * scale).all()


def trough(x: Array) -> Array:
    """Bend a flat sheet to half a pipe along y with upright sides."""
    radius, length = 0.06, np.abs(x[:, 0])
    angle = np.minimum(length / radius, 0.5 * np.pi)
    out = x.copy()
    out[:, 0] = np.sign(x[:, 0]) * radius * np.sin(angle)
    out[:, 2] = radius * (1.0 - np.cos(angle)) + length - radius * angle
    return out


@pytest.mark.parametrize("thickness", [0.0, 0.004])
def test_a_part_touches_its_image_as_the_whole_itself(
    comm: MPI.Comm, shared_tmp: Path, thickness: float
) -> None:
    """The sides of a trough swing towards each other."""
    results = []
    for images, planes in (("xy", ""), ("y", "x"), ("", "xy")):
        path = shared_tmp / f"trough{images}.obj"
        made = None
        if comm.rank == 0:
            made = mirrored(path, images, 5, lambda flat: 0.0 * flat[:, 0], 0.3, trough)
        mesh, start = comm.bcast(made)
        scene = {
            "mesh": mesh,
            "material": {"young": 2e5, "poisson": 0.3, "thickness": 0.002, "density": 200.0},
            "handles": symmetry_planes(planes),
            "contact": {"gap": GAP, "thickness": thickness, "friction": 0.3},
            "obstacles": {"far": {"plane": {"point": [0, 0, -1], "normal": [0, 0, 1]}}},
            "time": {"end": 0.112, "step": 0.004},
            "solver": {"force_tolerance": 1e-10, "step_tolerance": 1e-10},
        }
        energies, apart = [], []
        with stepped(comm, scene, ksp_rtol=1e-12) as run:
            equations, term = run.problem.equations, run.problem.terms["contact"]
            rows, x = (
                slice(0, run.problem.points.n_vertices),
                equations.x[: run.problem.points.n_owned].copy(),
            )
            v = np.zeros_like(x)
            v[rows, 0] = -3.0 * np.sign(x[rows, 0]) * np.maximum(x[rows, 2] - 0.06, 0.0)
            equations.state.set(x, v)
            run.stepper.start(0.0, 0)
            run.energy_balance.measure()
            while not run.finished:
                run.step()
                here = float(term.energies(equations.x, equations.step.frozen[term]).sum())
                energies.append([comm.allreduce(here), run.budget.dissipation, run.budget.membrane])
                if (gap := run.energy_balance.columns()["smallest_gap"]) < 0.9 * GAP:
                    apart.append(gap)
                assert not run.energy_balance.obstacle_forces(1).any()
            x = shape(run)
        part = np.flatnonzero((np.round(start[:, :2], 9) >= 0.0).all(axis=1))
        part = part[np.lexsort(np.round(start[part].T, 9))]
        results.append((x[part], 2.0 ** (2 - len(images)) * np.array(energies), np.array(apart)))
    whole = results[0]
    assert whole[2].min() < 0.3 * GAP
    for part_of in results[1:]:
        np.testing.assert_allclose(part_of[0], whole[0], rtol=0.0, atol=1e-2 * GAP)
        assert part_of[0][:, 0].min() >= 0.0
        # where the whole is pressed most, edges repel each other too
        assert (np.abs(part_of[1] - whole[1]).max(axis=0) < 0.04 * np.abs(whole[1]).max(axis=0)).all()
        np.testing.assert_allclose(part_of[2], whole[2], rtol=0.0, atol=1e-2 * GAP)


def beside_plane(x: float, **contact: Any) -> dict[str, Any]:
    """A sheet that begins in the plane x = 0, and a loose one that begins at x [m]."""
    sheet = grid(0.2, 0.2, 4, 4)
    loose = grid(0.1, 0.1, 2, 2) | {"transform": {"translate": [x, 0.03, 0.02]}}
    return {
        "mesh": [sheet, loose],
        "material": {"young": 2e5, "poisson": 0.3, "thickness": 0.002, "density": 1.0},
        "handles": [{"nodes": [0, 5, 10, 15, 20], "symmetry": "x"}, {"nodes": [4]}],
        "contact": {"gap": 0.01} | contact,
        "initial": {"velocity": [-3.0, 0.0, 0.0]},
        "time": {"end": 0.08, "step": 0.004},
    }


def test_nothing_passes_through_a_symmetry_plane(comm: MPI.Comm) -> None:
    for x, side in ((0.03, 1.0), (-0.13, -1.0)):
        scene = beside_plane(x, thickness=0.001)
        scene["initial"]["velocity"][0] *= side
        with stepped(comm, scene) as run:
            apart = []
            while not run.finished:
                run.step()
                apart.append((side * shape(run)[25:, 0]).min())
        assert 0.0005 < min(apart) < 0.0055
    with finished(comm, beside_plane(0.03, self=False)) as run:
        assert shape(run)[25:, 0].min() < -0.1


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (-0.03, "4 triangles of the sheet reach through the symmetry plane x = 0 .*give contact: "),
        (2e-6, "contact: at the start vertex .* and the obstacle 'symmetry plane x = 0', around"),
    ],
)
def test_a_start_beyond_a_symmetry_plane_is_refused(comm: MPI.Comm, x: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        SteppedScene(comm, scene_of(beside_plane(x)))
    with stepped(comm, beside_plane(x, self=False)):
        pass


def test_a_plane_through_the_inside_of_a_sheet_is_no_wall() -> None:
    scene = scene_of(beside_plane(0.03) | {"handles": [{"nodes": [2, 7, 12, 17, 22], "symmetry": "x"}]})
    assert not [wall for wall in symmetry_walls(scene, build_scene_mesh(scene)) if (wall.vertices < 25).any()]
