"""Other programs on the same mesh and scene: files written for them, and their time per step.

The scene is written as the original Lyra reads it, one step a frame: ``square.obj`` (vertices, material
coordinates, triangles), ``gray-interlock.json`` (its material) and ``scene-STEPS.json``. It ends after
``end_frame`` frames. Each command runs in the folder of these files.
"""

from __future__ import annotations

import json
import shlex
import time
from pathlib import Path
from typing import Any

import numpy as np
from cases import CLOTH, DAMPING, GRAVITY, STEP, corners, hanging_square
from processes import Limits, Spent, run

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.build import build_mesh
from lyra_petsc.scene.materials.library import ClothTable, library_entries
from lyra_petsc.scene.schema import Scene

OBJ_FILE = "square.obj"
WARM_UP = 3
PAIRS = 3
"""Pairs of a short and a long run, at most."""


def parse(text: str) -> tuple[str, str]:
    """``NAME=COMMAND`` as its two halves.

    Raises
    ------
    InputError
    """
    name, equals, command = text.partition("=")
    if not (equals and name.strip() and command.strip()):
        raise InputError(
            f"must be NAME='command with {{obj}} {{json}} {{steps}}', not {text!r}", key="--peer"
        )
    return name.strip(), command.strip()


def write_files(folder: Path, vertices: int) -> None:
    """Write the mesh and the material of the hanging square."""
    folder.mkdir(parents=True, exist_ok=True)
    mesh = build_mesh(Scene.model_validate(hanging_square(vertices)).mesh)
    with (folder / OBJ_FILE).open("w", encoding="ascii") as file:
        np.savetxt(file, mesh.positions, "v %.17g %.17g %.17g")
        np.savetxt(file, mesh.positions[:, :2], "vt %.17g %.17g")
        np.savetxt(file, np.repeat(mesh.triangles + 1, 2, axis=1), "f %d/%d %d/%d %d/%d")
    table = library_entries()[CLOTH]
    assert isinstance(table, ClothTable)
    material = {
        "density": table.density,
        "stretching": [[table.c11, table.c12, table.c22, table.c33]] * 6,
        "bending": [[stiffness] * 5 for stiffness in table.bending],
    }
    (folder / f"{CLOTH}.json").write_text(json.dumps(material, indent=1), encoding="ascii")


def write_scene(folder: Path, vertices: int, steps: int) -> Path:
    """Write the scene with a number of steps; returns its path."""
    scene = {
        "frame_time": STEP,
        "frame_steps": 1,
        "end_frame": steps,
        "gravity": GRAVITY,
        "cloths": [{"mesh": OBJ_FILE, "materials": [{"data": f"{CLOTH}.json", "damping": DAMPING}]}],
        "handles": [{"nodes": corners(vertices)}],
    }
    path = folder / f"scene-{steps}.json"
    path.write_text(json.dumps(scene, indent=1), encoding="ascii")
    return path


def measure_peer(command: str, folder: Path, vertices: int, limits: Limits) -> dict[str, Any]:
    """Wall and CPU seconds per step of a command: the difference of a long run and one of `WARM_UP` steps.

    So start-up, input and the first steps are excluded, as for this program.

    Raises
    ------
    Failed
    """
    folder = folder.resolve()
    write_files(folder, vertices)

    def run_for(steps: int) -> Spent:
        values = {"obj": folder / OBJ_FILE, "json": write_scene(folder, vertices, steps), "steps": steps}
        line = command
        for name, value in values.items():
            line = line.replace(f"{{{name}}}", shlex.quote(str(value)))
        return run(line, limits.process, folder)

    began = time.perf_counter()
    run_for(WARM_UP)  # fills its caches
    short = [run_for(WARM_UP)]
    steps = int(np.clip(limits.seconds * WARM_UP / max(short[0].wall, 1e-9), 2, limits.steps))
    long = [run_for(WARM_UP + steps)]
    while len(long) < PAIRS and time.perf_counter() - began < limits.seconds:
        short.append(run_for(WARM_UP))
        long.append(run_for(WARM_UP + steps))
    pairs = list(zip(short, long, strict=True))
    return {
        "step_seconds": [max(0.0, after.wall - before.wall) / steps for before, after in pairs],
        "cpu_seconds": [max(0.0, after.cpu - before.cpu) / steps for before, after in pairs],
        "short_seconds": [spent.wall for spent in short],
        "long_seconds": [spent.wall for spent in long],
        "further_steps": steps,
    }
