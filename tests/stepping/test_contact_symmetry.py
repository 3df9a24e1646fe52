"""A half and a quarter with symmetry planes touch obstacles, and each other, as the whole sheet does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import mirrored, obj_file, shape, stepped, symmetry_planes

from lyra_petsc.arrays import Array

pytestmark = pytest.mark.parallel

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
            system, term = run.problem.system, run.problem.terms["contact"]
            while not run.finished:
                run.step()
                here = float(term.energies(system.x, system.active.frozen[term]).sum())
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
