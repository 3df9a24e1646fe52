"""A scene as a function that maps some of its numbers to values of its readings, with derivatives."""

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
from lyra_petsc.experiments.fit.readings import SAME_TIME, Reading, instants
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.materials.library import resolve_material
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.time_curve import curves
from lyra_petsc.stepping.perturbed_scenes import SceneParameter
from lyra_petsc.stepping.sensitivity import Sensitivities
from lyra_petsc.terms.protocols import Dissipates, LimitsStep
from lyra_petsc.terms.registry import needed_terms

ROOTS = ("material", "gravity", "wind", "handles", "loads", "initial")
"""Blocks of a scene whose numbers can be fitted."""

CHOICES = frozenset({"group", "nodes", "box", "from", "until", "fade", "seed", "law"})
"""Keys whose numbers select points, times or curves, so that results do not depend smoothly on them."""

WHOLE_RUNS = 1e-3
"""Relative change of a number for central differences of whole runs, with contact or friction."""

_PART = re.compile(r"[^.\[\]\s]+(\[\d+\])*")

Progress = Callable[[float], None]
"""Called with the completed fraction of an evaluation."""


@dataclass
class ModelEvaluation:
    """Values (m,) of the readings and, if requested, their derivatives (m, n) with respect to the numbers."""

    values: Array
    jacobian: Array | None = None


class Model:
    """A scene with variable numbers and readings; every method is collective.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene
    sizes : mapping of str to float
        Keys of the numbers, and their typical changes.
    readings : sequence of Reading
    watch : callable
        Called before every step.

    Attributes
    ----------
    readings : list of Reading
        Sorted by time, as their values are.
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
        self._forces = any(reading.kind == "force" for reading in readings)
        self.mesh: Mesh | None = None
        self.shape: Array | None = None
        self.runs = 0
        # there are no tangents for friction, limits of a step, or changing stencils
        shells = [resolve_material(block, file=scene.source)[0] for block in scene.material]
        entries = needed_terms(scene, shells)
        self._needs_differences = any(
            entry.of_contact or issubclass(entry.kind, (Dissipates, LimitsStep)) for entry in entries
        )

        def check_vertices() -> None:
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

        on_root(comm, check_vertices)

    @property
    def labels(self) -> list[str]:
        """Labels of all values."""
        return [label for reading in self.readings for label in reading.labels]

    def at(self, numbers: Sequence[float]) -> Scene:
        """The scene with these numbers."""
        return self.scene.changed(dict(zip(self.keys, map(float, numbers), strict=True)))

    def evaluate(
        self, numbers: Sequence[float], *, derivatives: bool = True, progress: Progress = lambda part: None
    ) -> ModelEvaluation:
        """Simulate with these numbers.

        Raises
        ------
        SolverError
            If the simulation fails; the message names the numbers.
        """
        array = np.array([float(number) for number in numbers])
        try:
            if derivatives and self._needs_differences:
                return self._evaluate_by_differences(array, progress)
            return self._evaluate(array, derivatives, progress)
        except SolverError as error:
            pairs = zip(self.keys, array, strict=True)
            numbers_text = ", ".join(f"{key} = {value:.6g}" for key, value in pairs)
            raise SolverError(
                f"with {numbers_text}: {error}", collective=error.collective, details=error.details
            ) from error

    def _evaluate(self, numbers: Array, derivatives: bool, progress: Progress) -> ModelEvaluation:
        scene = self.at(numbers.tolist())
        stops = [instant.time for instant in self._instants]
        values: list[Array] = []
        slopes: list[Array] = []
        self.runs += 1
        with open_simulation(self.comm, scene, mesh=self.mesh, stops=stops) as simulation:
            sensitivities: Sensitivities | None = None
            if derivatives:
                chosen = [
                    SceneParameter(key, float(value), size)
                    for key, value, size in zip(self.keys, numbers, self._sizes, strict=True)
                ]
                tolerance = min(1e-6, 0.01 * scene.solver.force_tolerance)
                sensitivities = Sensitivities(
                    simulation, chosen, mesh=self.mesh, tolerance=tolerance, reactions=self._forces
                )
            remaining = list(self._instants)
            end = simulation.control.end
            while remaining and not simulation.finished:
                self._watch()
                if sensitivities is None:
                    simulation.step()
                else:
                    sensitivities.step()
                progress(simulation.time / end)
                if abs(simulation.time - remaining[0].time) <= SAME_TIME * end:
                    instant = remaining.pop(0)
                    values.append(instant.values(simulation.problem, simulation.energy_balance))
                    if sensitivities is not None:
                        slopes.append(sensitivities.derivatives(instant.values))
            if remaining:
                raise InputError(
                    f"is at {remaining[0].time:g}, where the run has ended before",
                    key=remaining[0].readings[0].key,
                )
            shape = simulation.problem.points.gather(simulation.problem.equations.x)
            self.shape = shape if self.comm.rank == 0 else None
            if sensitivities is not None:
                sensitivities.destroy()
        return ModelEvaluation(np.concatenate(values), np.concatenate(slopes) if slopes else None)

    def _evaluate_by_differences(self, numbers: Array, progress: Progress) -> ModelEvaluation:
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
        middle = self._evaluate(numbers, False, partial(_scaled, progress, count - 1, count))
        return ModelEvaluation(middle.values, np.stack(columns, axis=1))


def _scaled(progress: Progress, done: int, count: int, part: float) -> None:
    progress((done + part) / count)


def check_keys(scene: Scene, keys: Sequence[str], *, at: str) -> None:
    """Refuse keys of numbers that cannot be varied, and two keys of one number.

    Raises
    ------
    InputError
    """
    names: dict[tuple[str, ...], str] = {}
    for key in keys:
        if reason := _reason_against(key, names):
            raise InputError(reason, file=scene.source, key=f"{at}.{key}")


def _reason_against(key: str, names: dict[tuple[str, ...], str]) -> str:
    """Why a key cannot be varied, empty if it can; ``names`` has the keys before it by their parts."""
    if not all(map(_PART.fullmatch, key.split("."))):
        return "is no key of a scene; write it as in handles[0].stiffness"
    if (other := names.setdefault(tuple(_parts(key)), key)) != key:
        return f"is the number {other}; leave one of them out"
    if key.split(".")[0].split("[")[0] not in ROOTS:
        return f"is no number that can be varied; those of {', '.join(ROOTS)} can"
    chosen = [part for part in key.replace("[", ".").split(".") if part in CHOICES]
    return f"cannot be varied: nothing depends smoothly on what {chosen[0]} names" if chosen else ""


def _parts(key: str) -> list[str]:
    """The parts of a key; ``material`` without a number denotes the first material."""
    parts = key.replace("[", ".").replace("]", "").split(".")
    if parts[0] == "material" and not (len(parts) > 1 and parts[1].isdecimal()):
        parts.insert(1, "0")
    return parts


def value_of(scene: Scene, key: str, *, at: str) -> float:
    """The number at a key of a scene.

    Raises
    ------
    InputError
        If there is no number.
    """
    target: Any = scene
    parts = _parts(key)
    for curve in curves(scene):
        own = _parts(curve)
        if parts[: len(own)] == own and parts[len(own) + 1 : len(own) + 2] != ["1"]:
            text = f"is no value of a point; only those of a curve can be varied, as in {curve}[0][1]"
            raise InputError(text, file=scene.source, key=f"{at}.{key}")
    for part in parts:
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
