"""What a program drives in a simulation: targets of handles, places of obstacles, and values in time.

In the scene that is simulated each of these is a function of time that the program continues, in place of the
keyframes or values of the scene.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, python_argument_names, suggest
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.driven_curve import DrivenCurve
from lyra_petsc.scene.messages import validated
from lyra_petsc.scene.schema import Handle, Keyframe, Obstacle, Scene
from lyra_petsc.scene.time_curve import TimeCurve
from lyra_petsc.scene.values import shown
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.terms.handles.driven_motion import DrivenMotion
from lyra_petsc.terms.handles.motion import STILL, Motion, motion_of

Driven: TypeAlias = DrivenMotion | DrivenCurve

LOADS = "force", "pressure", "traction", "moment"
"""Keys of a load that can be driven."""


def _places(scene: Scene) -> dict[str, tuple[Any, ...]]:
    """Path in the scene of all that can be driven, by name."""
    places: dict[str, tuple[Any, ...]] = {}
    for number, handle in enumerate(scene.handles):
        if handle.symmetry is None:
            places[f"handles[{number}]"] = "handles", number, "motion"
    for name in scene.obstacles or {}:
        places[f"obstacles.{name}"] = "obstacles", name, "motion"
    if scene.gravity is not None:
        places["gravity"] = ("gravity",)
    if scene.wind is not None:
        places["wind.velocity"] = "wind", "velocity"
    for number, load in enumerate(scene.loads):
        places |= {f"loads[{number}].{key}": ("loads", number, key) for key in load.present(*LOADS)}
    return places


def drive(scene: Scene, names: Iterable[str]) -> tuple[Scene, dict[str, Driven]]:
    """The scene with functions of time in place of its values, and these functions by name.

    Raises
    ------
    InputError
        For a name of what cannot be driven.
    """
    places, driven = _places(scene), {}
    in_frames = {f"handles[{i}]" for i, handle in enumerate(scene.handles) if handle.frames is not None}
    for name in names:
        if name in in_frames:
            raise InputError(f"{name} moves by its frames; leave these out to drive it", key="drives")
        if name not in places:
            raise InputError(f"cannot drive {name!r}, {suggest(name, places)}", key="drives")
        path = places[name]
        driven[name] = _driven(scene, path)
        scene = _with(scene, path, driven[name])
    return scene, driven


def _driven(scene: Scene, path: tuple[Any, ...]) -> Driven:
    """The function of time that begins as the value at a path."""
    value: Any = scene
    for key in path[:-1] if path[-1] == "motion" else path:
        value = value[key] if isinstance(value, (list, dict)) else getattr(value, key)
    if isinstance(value, Handle):
        return DrivenMotion(motion_of(scene, path[1]))
    if isinstance(value, Obstacle):
        keyframes = scene.keyframes(value)
        return DrivenMotion(Motion(keyframes, value.interpolation, file=scene.source) if keyframes else STILL)
    curve = TimeCurve.of(value, grows=scene.time.static)
    return DrivenCurve(curve.times, curve.values, grows=curve.grows)


def _with(value: Any, path: tuple[Any, ...], driven: Driven) -> Any:
    """A copy of a block, list or dictionary with another value at a path in it."""
    if not path:
        return driven
    key, *rest = path
    if isinstance(value, Block):
        return value.model_copy(update={key: _with(getattr(value, key), tuple(rest), driven)})
    changed = dict(value) if isinstance(value, dict) else list(value)
    changed[key] = _with(value[key], tuple(rest), driven)
    return changed


class Controls:
    """What a program drives, by name, and the calls that do so.

    Parameters
    ----------
    driven : dict of DrivenMotion or DrivenCurve
        From `drive`.
    """

    def __init__(self, driven: dict[str, Driven]) -> None:
        self._driven = driven

    def move(self, run: SteppedScene, name: str, place: Mapping[str, Any], at: float | None) -> None:
        """Move a handle or obstacle to a place, the keys of a keyframe, until ``at`` [s]; see
        `Simulation.move`.
        """
        motion, time = self._named(name, DrivenMotion, "move"), _time(run, at)
        keys = {key: value for key, value in place.items() if value is not None}
        with python_argument_names():
            target = validated(Keyframe, {"time": time, **keys}, file=None)
        if name.startswith("obstacles.") and target.scale not in (1.0, (1.0, 1.0, 1.0)):
            raise InputError("an obstacle is rigid: leave out scale", key=name)
        if motion.go_to(target, run.time):
            run.expect_jump(run.time)
        run.follow_driven(time)

    def set(self, run: SteppedScene, name: str, value: Any, at: float | None) -> None:
        """Change a value until ``at`` [s], or now; see `Simulation.set`."""
        curve, number = self._named(name, DrivenCurve, "set"), _numbers(value)
        if number.shape != curve.values[0].shape or not np.isfinite(number).all():
            words = "three finite numbers" if curve.values[0].ndim else "a finite number"
            raise InputError(f"must be {words}, not {shown(value)}", key=name)
        time = run.time if at is None else _time(run, at)
        curve.go_to(number, run.time, time)
        if at is None:
            run.expect_jump(run.time)
        else:
            run.follow_driven(time)

    def _named(self, name: str, kind: type[Any], call: str) -> Any:
        if name not in self._driven:
            how = f"is not driven: Simulation(scene, drives=[{name!r}]) lets the program do so"
            raise InputError(how, key=name)
        if not isinstance(self._driven[name], kind):
            other = "move" if call == "set" else "set"
            raise InputError(f"is changed by {other}(), not {call}()", key=name)
        return self._driven[name]

    def saved_state(self) -> dict[str, Any]:
        """How all that is driven goes on, for `restore`."""
        return {name: function.saved_state() for name, function in self._driven.items()}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Return to a `saved_state`."""
        for name, function in self._driven.items():
            function.restore(saved[name])


def _time(run: SteppedScene, at: float | None) -> float:
    """The time ``at`` [s], or the end of the next step."""
    if at is None:
        return run.control.next_end(run.time)
    time = _numbers(at)
    if time.shape or not run.time < time < math.inf:
        raise InputError(f"must be later than now, {run.time:g} s, not {shown(at)}", key="at")
    return float(time)


def _numbers(values: Any) -> Array:
    """The values as an array, of NaN if they are no real numbers."""
    try:
        rows = np.asarray(values)
    except ValueError:  # rows of different lengths
        rows = np.empty((), dtype=object)
    if rows.dtype.kind in "biuf":
        return np.asarray(rows, dtype=np.float64)
    return np.full(rows.shape, np.nan)


def finite_rows(comm: MPI.Comm, name: str, values: Any, count: int) -> Array:
    """Finite numbers (count, 3) for a rank's vertices; refuses others on all ranks."""
    rows = _numbers(values)
    problem = ""
    if rows.shape != (count, 3):
        problem = f"has shape {rows.shape}, not ({count}, 3): a row for each of .vertices"
    elif not np.isfinite(rows).all():
        problem = "has entries that are not finite numbers"
    for text in comm.allgather(problem):
        if text:
            raise InputError(text, key=f"Simulation.{name}")
    return rows
