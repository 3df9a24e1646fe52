"""Starts that cross are taken apart so that they reach the equilibrium of the same scene started apart."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from brute_force import n_crossings
from mpi4py import MPI
from physics import finished, obj_file, scene_of, shape

from lyra_petsc.arrays import Array
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.mesh.build import build_scene_mesh

SIDE, CELLS, HEIGHT = 0.3, 10, 0.006

MATERIAL = {"young": 1e5, "poisson": 0.3, "thickness": 1e-3}


class Equilibrium(NamedTuple):
    """Energies [J] of an equilibrium, and the notes of its run."""

    total: float
    elastic: float
    contact: float
    notes: str


def equilibrium(scene: dict[str, Any]) -> Equilibrium:
    """The equilibrium of a scene with contact, which is free of crossings."""
    with finished(MPI.COMM_SELF, scene) as simulation:
        triangles = build_scene_mesh(scene_of(scene)).triangles
        assert n_crossings(shape(simulation), triangles) == 0
        budget = simulation.budget
        contact = budget.more["contact_energy"]
        return Equilibrium(budget.total, budget.elastic, contact, " ".join(simulation.notes))


def dents(random: np.random.Generator) -> Array:
    """A random height field (V,) over a sheet, of up to 1, that is 0 at its sides."""
    flat, _ = rectangle(CELLS, CELLS, SIDE, SIDE)
    centre, width = random.uniform(0.35, 0.65, 2) * SIDE, random.uniform(0.12, 0.2) * SIDE
    bump = np.exp(-((flat[:, :2] - centre) ** 2).sum(axis=1) / (2.0 * width**2))
    return np.asarray(bump * (np.sin(np.pi * flat[:, :2] / SIDE) ** 2).prod(axis=1))


def sheet(path: Path, height: Array) -> dict[str, Any]:
    """A sheet that is flat at rest, with heights (V,) [m] at the start."""
    flat, triangles = rectangle(CELLS, CELLS, SIDE, SIDE)
    points = np.column_stack([flat[:, :2], height])
    return obj_file(path, points, triangles, flat[:, :2]) | {"name": path.stem}


def hammocks(folder: Path, seed: int | None, *, exchanged: bool = False) -> dict[str, Any]:
    """A heavy sheet that hangs between two sides above a light one that hangs between the others; with a seed
    they start with dents through each other.
    """
    heights = {"light": np.zeros((CELLS + 1) ** 2), "heavy": np.full((CELLS + 1) ** 2, HEIGHT)}
    if exchanged:
        heights["heavy"] -= 2.0 * HEIGHT
    if seed is not None:
        random = np.random.default_rng(seed)
        heights["heavy"] -= random.uniform(0.01, 0.04) * dents(random)
        heights["light"] += random.uniform(0.0, 0.02) * dents(random)
    sides = {"light": [[0.0, -1.0], [SIDE, -1.0]], "heavy": [[-1.0, 0.0], [-1.0, SIDE]]}
    handles = []
    for name, places in sides.items():
        for x, y in places:
            low = [x - 1e-6, -1.0] if x >= 0.0 else [-1.0, y - 1e-6]
            high = [x + 1e-6, 1.0] if x >= 0.0 else [1.0, y + 1e-6]
            z = 0.0 if name == "light" else heights["heavy"][0]
            handles.append({"box": [[*low, z - 1e-6], [*high, z + 1e-6]]})
    densities = {"light": 0.05, "heavy": 0.4}
    return {
        "mesh": [sheet(folder / f"{name}.obj", height) for name, height in heights.items()],
        "material": [MATERIAL | {"group": name, "density": value} for name, value in densities.items()],
        "handles": handles,
        "contact": {"gap": 0.004, "untangle": True},
        "gravity": [0, 0, -9.81],
        "time": {"analysis": "static"},
    }


def on_a_ball(folder: Path, seed: int | None) -> dict[str, Any]:
    """A sheet that hangs between two sides onto a ball; with a seed it starts with a dent into the ball."""
    height = np.zeros((CELLS + 1) ** 2)
    if seed is not None:
        random = np.random.default_rng(seed)
        height -= random.uniform(0.015, 0.03) * dents(random)
    return {
        "mesh": sheet(folder / "sheet.obj", height),
        "material": MATERIAL | {"density": 0.4},
        "handles": [{"box": [[x - 1e-6, -1, -1], [x + 1e-6, 1, 1]]} for x in (0.0, SIDE)],
        "obstacles": {"ball": {"sphere": {"center": [0.14, 0.16, -0.065], "radius": 0.06}}},
        "contact": {"gap": 0.004, "untangle": True},
        "gravity": [0, 0, -9.81],
        "time": {"analysis": "static"},
    }


def started_apart(scene: dict[str, Any]) -> Equilibrium:
    """The equilibrium of a scene that starts without crossings, in which contact acts."""
    apart = equilibrium(scene)
    assert "untangled" not in apart.notes
    assert apart.contact > 0.0
    return apart


def check_untangled(untangled: Equilibrium, apart: Equilibrium) -> None:
    """Check that an untangled start has led to the equilibrium of a start apart."""
    assert "untangled the start: " in untangled.notes
    assert untangled.total == pytest.approx(apart.total, rel=0.01)
    assert untangled.elastic == pytest.approx(apart.elastic, rel=0.01)


def test_layers_reach_the_equilibrium_of_a_start_apart(tmp_path: Path) -> None:
    apart = started_apart(hammocks(tmp_path, None))
    for seed in range(4):
        check_untangled(equilibrium(hammocks(tmp_path, seed)), apart)
    # the wrong order would be seen
    exchanged = equilibrium(hammocks(tmp_path, None, exchanged=True))
    assert abs(exchanged.elastic / apart.elastic - 1.0) > 0.05


def test_a_sheet_reaches_the_equilibrium_on_a_ball(tmp_path: Path) -> None:
    apart = started_apart(on_a_ball(tmp_path, None))
    for seed in range(3):
        check_untangled(equilibrium(on_a_ball(tmp_path, seed)), apart)
    free = equilibrium(on_a_ball(tmp_path, None) | {"obstacles": {}})
    assert abs(free.elastic / apart.elastic - 1.0) > 0.05
