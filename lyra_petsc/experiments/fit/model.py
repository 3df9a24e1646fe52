"""A scene as a function: from some of its numbers to values of its readings, with derivatives."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.experiments.bench import open_simulation
from lyra_petsc.experiments.case import Watch
from lyra_petsc.experiments.fit.readings import SAME_TIME, HandleForce, Reading, instants
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.materials.library import resolve_material
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.sensitivity import Number, Sensitivities
from lyra_petsc.terms.registry import active

ROOTS = ("material", "gravity", "wind", "handles", "loads", "initial")
"""Blocks of a scene whose numbers can be found."""

CHOICES = frozenset({"group", "nodes", "box", "from", "until", "fade", "seed", "law"})
"""Keys below which numbers choose points, times or curves: nothing changes smoothly with them."""

WHOLE_RUNS = 1e-3
"""Change over the number's size of runs whose difference is a derivative, with contact or friction."""

_PART = re.compile(r"[^.\[\]\s]+(\[\d+\])*")

Progress = Callable[[float], None]
"""Is told which part of an evaluation is done."""


@dataclass
class Evaluation:
    """Values (m,) of the readings, and their derivatives (m, n) by the numbers where asked for."""

    values: Array
    jacobian: Array | None = None


class Model:
    """A scene with numbers to vary and readings; every method is collective.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene
    sizes : mapping of str to float
        Keys of the numbers, and the size of their usual changes.
    readings : sequence of Reading
    watch : callable
        Called before every step.

    Attributes
    ----------
    readings : list of Reading
        In the order of their values: by time.
    shape : (V, 3) or None
        Positions [m] at the end of the last evaluation, in mesh order, on rank 0.
    mesh : Mesh or None
        On rank 0.
    runs : int
        Simulations so far.

    Raises
    ------
    InputError
        Measurements of what the scene does not have.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        scene: Scene,
        sizes: Mapping[str, float],
        readings: Sequence[Reading],
        watch: Watch = lambda: None,
    ) -> None:
        self.comm, self.scene, self._watch = comm, scene, watch
        self.keys, self._sizes = list(sizes), list(sizes.values())
        self._instants = instants(readings)
        self.readings = [reading for instant in self._instants for reading in instant.readings]
        self._forces = any(isinstance(reading, HandleForce) for reading in readings)
        self.mesh: Mesh | None = None
        self.shape: Array | None = None
        self.runs = 0
        # what terms keep from step to step beside the state, and stencils that change, have no tangents
        shells = [resolve_material(block, file=scene.source)[0] for block in scene.material]
        entries = active(scene, shells)
        self._remembers = any(entry.neighbours or entry.element_vertices for entry in entries)

        def make() -> None:
            self.mesh = build_scene_mesh(scene)
            count = self.mesh.n_vertices
            for reading in self.readings:
                wrong = [number for number in reading.vertices if not 0 <= number < count]
                if wrong:
                    raise InputError(
                        f"measures vertex {wrong[0]}, but the mesh has vertices 0 to {count - 1}",
                        file=scene.source,
                        key=reading.key,
                    )

        on_root(comm, make)

    @property
    def labels(self) -> list[str]:
        """Of all values."""
        return [label for reading in self.readings for label in reading.labels]

    def at(self, numbers: Sequence[float]) -> Scene:
        """The scene with these numbers."""
        return self.scene.changed(dict(zip(self.keys, map(float, numbers), strict=True)))

    def evaluate(
        self, numbers: Sequence[float], *, derivatives: bool = True, progress: Progress = lambda part: None
    ) -> Evaluation:
        """Simulate with these numbers.

        Raises
        ------
        SolverError
            Where the simulation fails, naming the numbers.
        """
        array = np.array([float(number) for number in numbers])
        try:
            if derivatives and self._remembers:
                return self._by_differences(array, progress)
            return self._evaluate(array, derivatives, progress)
        except SolverError as error:
            pairs = zip(self.keys, array, strict=True)
            words = ", ".join(f"{key} = {value:.6g}" for key, value in pairs)
            raise SolverError(
                f"with {words}: {error}", collective=error.collective, details=error.details
            ) from error

    def _evaluate(self, numbers: Array, derivatives: bool, progress: Progress) -> Evaluation:
        scene = self.at(numbers.tolist())
        stops = [instant.time for instant in self._instants]
        values: list[Array] = []
        slopes: list[Array] = []
        self.runs += 1
        with open_simulation(self.comm, scene, mesh=self.mesh, stops=stops) as simulation:
            beside: Sensitivities | None = None
            if derivatives:
                chosen = [
                    Number(key, float(value), size)
                    for key, value, size in zip(self.keys, numbers, self._sizes, strict=True)
                ]
                tolerance = min(1e-6, 0.01 * scene.solver.force_tolerance)
                beside = Sensitivities(
                    simulation, chosen, mesh=self.mesh, tolerance=tolerance, reactions=self._forces
                )
            left = list(self._instants)
            end = simulation.control.end
            while left and not simulation.finished:
                self._watch()
                if beside is None:
                    simulation.step()
                else:
                    beside.step()
                progress(simulation.time / end)
                if abs(simulation.time - left[0].time) <= SAME_TIME * end:
                    instant = left.pop(0)
                    values.append(instant.values(simulation.problem, simulation.ledger))
                    if beside is not None:
                        slopes.append(beside.derivatives(instant.values))
            if left:
                raise InputError(
                    f"is at {left[0].time:g}, where the run has ended before", key=left[0].readings[0].key
                )
            shape = simulation.problem.points.gather(simulation.problem.system.x)
            self.shape = shape if self.comm.rank == 0 else None
            if beside is not None:
                beside.destroy()
        return Evaluation(np.concatenate(values), np.concatenate(slopes) if slopes else None)

    def _by_differences(self, numbers: Array, progress: Progress) -> Evaluation:
        """By central differences of whole runs."""
        count = 2 * len(numbers) + 1
        columns = []
        for i, size in enumerate(self._sizes):
            pair = []
            for k, sign in enumerate((1.0, -1.0)):
                changed = numbers.copy()
                changed[i] += sign * WHOLE_RUNS * size
                done = 2 * i + k
                run = self._evaluate(changed, False, partial(_scaled, progress, done, count))
                pair.append(run.values)
            columns.append((pair[0] - pair[1]) / (2.0 * WHOLE_RUNS * size))
        found = self._evaluate(numbers, False, partial(_scaled, progress, count - 1, count))
        return Evaluation(found.values, np.stack(columns, axis=1))


def _scaled(progress: Progress, done: int, count: int, part: float) -> None:
    progress((done + part) / count)


def check_keys(scene: Scene, keys: Sequence[str], *, at: str) -> None:
    """Refuse what is no number of the scene that can be varied, or the same number twice.

    Raises
    ------
    InputError
    """
    names: dict[tuple[str, ...], str] = {}
    for key in keys:
        if words := _wrong(key, names):
            raise InputError(words, file=scene.source, key=f"{at}.{key}")


def _wrong(key: str, names: dict[tuple[str, ...], str]) -> str:
    """Why a key is not to be varied beside those before it, which ``names`` has; empty if it may be."""
    if not all(map(_PART.fullmatch, key.split("."))):
        return "is no key of a scene; write it as in handles[0].stiffness"
    if (other := names.setdefault(tuple(_parts(key)), key)) != key:
        return f"is the number {other}; leave one of them out"
    if key.split(".")[0].split("[")[0] not in ROOTS:
        return f"is no number that can be varied; those of {', '.join(ROOTS)} can"
    chosen = [part for part in key.replace("[", ".").split(".") if part in CHOICES]
    return f"cannot be varied: nothing depends smoothly on what {chosen[0]} names" if chosen else ""


def _parts(key: str) -> list[str]:
    """Where a key leads; ``material`` may stand for the first of a list."""
    parts = key.replace("[", ".").replace("]", "").split(".")
    if parts[0] == "material" and not (len(parts) > 1 and parts[1].isdecimal()):
        parts.insert(1, "0")
    return parts


def value_of(scene: Scene, key: str, *, at: str) -> float:
    """The number that a scene has at a key.

    Raises
    ------
    InputError
        If there is none.
    """
    target: Any = scene
    for part in _parts(key):
        if target is None:
            break
        if part.isdecimal() and isinstance(target, (list, tuple)):
            target = target[int(part)] if int(part) < len(target) else None
        elif isinstance(target, dict):
            target = target.get(part)
        else:
            target = getattr(target, part, None)
    if isinstance(target, tuple) and len(set(target)) == 1:  # one number for all directions
        target = target[0]
    if isinstance(target, bool) or not isinstance(target, (int, float)) or not math.isfinite(target):
        raise InputError(
            "is no number that the scene gives; write it into the scene", file=scene.source, key=f"{at}.{key}"
        )
    return float(target)
