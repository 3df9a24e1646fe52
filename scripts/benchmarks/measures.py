"""The measurements of the benchmark, each returning plain data for its JSON file."""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cases import (
    BENDING_MODELS,
    MESHES,
    METHODS,
    STEP,
    hanging_square,
    in_contact,
    on_mesh,
    square_number,
)
from peers import measure_peer
from processes import HERE, Limits, measure, run

from lyra_petsc.api.mpirun import find_launcher
from lyra_petsc.errors import InputError, suggest
from lyra_petsc.experiments.study.study_report import processor
from lyra_petsc.linear.presets import PRESETS

WARM_UP = 3
"""Steps of a row before the first measured one."""

REPEATS = 3
PAIRS = 7
"""Pairs of runs, of this program and of another checkout's by turns."""

STATES = 10
"""Number of states written to measure output."""

PROBLEM_CLASSES: dict[str, dict[str, float]] = {
    "soft, 5 ms": {},
    "× 1000, 5 ms": {"stiffness": 1000.0},
    "soft, 40 ms": {"step": 8 * STEP},
}

Result = dict[str, Any]


def machine() -> Result:
    """Processor, cores and load of the machine."""
    return {"processor": processor(), "cores": os.cpu_count(), "load": os.getloadavg()[0]}


def row(
    vertices: int,
    method: str,
    ranks: int,
    petsc: Sequence[str],
    limits: Limits,
    **changes: float,
) -> Result:
    """Measure set-up, steps and memory of the hanging square; ``changes`` are options of `hanging_square`."""
    return _steps("steps", hanging_square(vertices, method, **changes), ranks, petsc, limits) | {
        "who": method
    }


def apart(vertices: int, ranks: int, petsc: Sequence[str], limits: Limits) -> Result:
    """Measure steps of independent sheets, one a rank at the same time, each of vertices / ranks vertices."""
    apart = _steps("apart", hanging_square(vertices // ranks), ranks, petsc, limits)
    return apart | {"whole_vertices": square_number(vertices)}


def _steps(
    kind: str, scene: dict[str, Any], ranks: int, petsc: Sequence[str], limits: Limits, **more: str
) -> Result:
    few = {"warm_up": WARM_UP, "steps": limits.steps, "seconds": limits.seconds}
    return measure(kind, ranks, petsc, limits.process, scene=scene, **few, **more)


def meshes(vertices: int, ranks: int, petsc: Sequence[str], folder: Path, limits: Limits) -> Result:
    """Measure steps of the square on every kind of mesh, by turns."""
    few = {"warm_up": WARM_UP, "steps": limits.steps, "seconds": len(MESHES) * limits.seconds}
    with _scratch(folder) as scratch:
        scenes = {kind: on_mesh(kind, vertices, scratch) for kind in MESHES}
        return measure("meshes", ranks, petsc, len(MESHES) * limits.process, scenes=scenes, **few)


def bending(
    kind: str, vertices: int, method: str, ranks: int, petsc: Sequence[str], folder: Path, limits: Limits
) -> Result:
    """Measure steps of the square with each bending model, by turns, and the memory of each separately."""
    few = {"warm_up": WARM_UP, "steps": limits.steps, "seconds": 2.0 * limits.seconds}
    with _scratch(folder) as scratch:
        scenes = {model: on_mesh(f"{kind}, {model}", vertices, scratch) for model in BENDING_MODELS}
        for scene in scenes.values():
            scene["time"]["integrator"] = method
        both = measure("meshes", ranks, petsc, 2.0 * limits.process, scenes=scenes, **few)
        few = {"warm_up": 1, "steps": 1, "seconds": 1.0}
        for model, scene in scenes.items():
            alone = measure("steps", ranks, petsc, limits.process, scene=scene, **few)
            both["meshes"][model]["peak_bytes"] = sum(alone["peak_bytes"])
    return both | {"mesh": kind, "who": method, "ranks": ranks}


def against(
    kind: str,
    vertices: int,
    method: str,
    ranks: int,
    petsc: Sequence[str],
    folder: Path,
    limits: Limits,
    other: Path,
) -> Result:
    """Measure steps of the square with this program and with another checkout, in pairs of runs.

    The order within the pairs alternates.
    """
    few = {"warm_up": WARM_UP, "steps": limits.steps, "seconds": limits.seconds}
    runs: dict[str, list[Result]] = {"here": [], "other": []}
    with _scratch(folder) as scratch:
        scene = on_mesh(kind, vertices, scratch)
        scene["time"]["integrator"] = method
        for number in range(PAIRS):
            both = [("here", HERE), ("other", other)]
            for name, program in both if number % 2 == 0 else reversed(both):
                run = measure("steps", ranks, petsc, limits.process, program=program, scene=scene, **few)
                kept = {key: run[key] for key in ("steps", "vertices", "set_up_seconds")}
                runs[name].append(kept | {"peak_bytes": sum(run["peak_bytes"])})
    return {"mesh": kind, "who": method, "ranks": ranks, **runs}


def contact(
    vertices: int,
    ranks: int,
    petsc: Sequence[str],
    limits: Limits,
    settle: float,
    words: Sequence[str],
    ball_gap: float | None,
) -> Result:
    """Measure steps of sheets in contact and of swinging sheets, by turns, after ``settle`` simulated
    seconds: of all scenes, or of those whose names contain one of ``words``; with ``ball_gap`` [m] if given.
    """
    few = {"warm_up": max(WARM_UP, round(settle / STEP)), "steps": limits.steps, "seconds": math.inf}
    scenes = in_contact(vertices, ball_gap)
    scenes = {name: scenes[name] for name in scenes if not words or any(word in name for word in words)}
    return measure("meshes", ranks, petsc, 100 * limits.process, scenes=scenes, **few) | {"ranks": ranks}


def first_method(rows: Sequence[Result]) -> list[Result]:
    """The rows of the first method on one rank."""
    return [row for row in rows if row["who"] == METHODS[0] and row["ranks"] == 1]


def peer_row(name: str, command: str, vertices: int, folder: Path, limits: Limits) -> Result:
    """Measure the time per step of another program on the same scene; its files stay in ``folder``."""
    size = square_number(vertices)
    seconds = measure_peer(command, folder / "peers" / str(size), size, limits)
    return {"vertices": size, "who": name, "ranks": 1, "command": command, **seconds}


def preset_names(names: Sequence[str]) -> list[str]:
    """The names, or those of all presets if there are none.

    Raises
    ------
    InputError
    """
    for name in names:
        if name not in PRESETS:
            raise InputError(f"unknown preset {name!r}, {suggest(name, PRESETS)}", key="--presets")
    return list(names) or list(PRESETS)


def preset_options(name: str) -> list[str]:
    """The options of a preset as command line arguments."""
    words = []
    for option, value in PRESETS[name].items():
        text = str(value).lower() if isinstance(value, bool) else value
        words += [f"-{option}", *([] if text is None else [str(text)])]
    return words


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """A temporary folder on the file system of the results."""
    scratch = (folder / "scratch").resolve()
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def output(vertices: int, ranks: int, petsc: Sequence[str], folder: Path, limits: Limits) -> Result:
    """Measure the speed of writing states (positions and velocities), and of plain files."""
    scene = hanging_square(vertices) | {"output": {"every": STEP, "fields": ["velocity"]}}
    with _scratch(folder) as scratch:
        return measure(
            "output", ranks, petsc, limits.process, scene=scene, folder=str(scratch), states=STATES
        )


def _program(ranks: int, *words: str) -> list[str]:
    return [*find_launcher(ranks), sys.executable, "-m", "lyra_petsc", "run", *words]


def default_scene(ranks: int, petsc: Sequence[str], folder: Path, limits: Limits, *, short: bool) -> Result:
    """Measure the time of the default scene, and the fraction of it spent on output."""
    shorter = ["--set", "time.end=0.05"] if short else []
    with _scratch(folder) as scratch:
        seconds, _ = run([*_program(ranks, "--out", str(scratch / "run")), *shorter, *petsc], limits.process)
        summary = json.loads((scratch / "run" / "summary.json").read_text(encoding="utf-8"))
    phases = summary["wall_seconds"]
    return {
        "what": f"default scene{', its first 0.05 s' if short else ''}",
        "ranks": ranks,
        "seconds": seconds,
        "phases": phases,
        "output_share": phases.get("output", 0.0) / sum(phases.values()),
    }


def start_up(petsc: Sequence[str], folder: Path, limits: Limits) -> Result:
    """Measure the time of a process that runs one step of the default scene, with numba's cache filled."""
    with _scratch(folder) as scratch:
        words = _program(1, "--out", str(scratch / "run"), "--force")
        times = [run([*words, "-ts_max_steps", "1", *petsc], limits.process).wall for _ in range(REPEATS + 1)]
    return {"what": "one step of the default scene", "seconds": times[1:]}
