"""What a program drives in a simulation: targets of handles, places of obstacles, and values in time.

In the scene that is simulated each of these is a function of time that the program continues, in place of the
keyframes or values of the scene.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeAlias

from lyra_petsc.errors import InputError, suggest
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.driven_curve import DrivenCurve
from lyra_petsc.scene.schema import Handle, Obstacle, Scene
from lyra_petsc.scene.time_curve import TimeCurve
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
    for name in names:
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
