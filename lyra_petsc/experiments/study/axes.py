"""What a study varies: ``--vary key=value,value,…`` into axes of checked values."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from lyra_petsc.errors import InputError, nearest
from lyra_petsc.scene.schema import INTEGRATORS, Scene

Value = float | str

SHORT_NAMES = {
    "dt": "time.step",
    "integrator": "time.integrator",
    "tolerance": "time.tolerance",
    "spectral_radius": "time.spectral_radius",
    "force_tolerance": "solver.force_tolerance",
    "step_tolerance": "solver.step_tolerance",
    "max_iterations": "solver.max_iterations",
    "hessian": "solver.hessian",
}
"""Names of ours for keys of the scene; ``mesh`` beside them is the element size [m]."""

WORDS = frozenset({"time.integrator", "solver.hessian"})
"""Keys of the scene with short names whose values are words."""

OPTION = re.compile(r"(ksp|pc|snes|ts|mat|mg|gamg|sub|redundant|vec)_\w+", re.ASCII)
USUAL_OPTIONS = ("ksp_rtol", "ksp_atol", "ksp_max_it", "ksp_type", "pc_type", "snes_rtol", "snes_atol")

NUMERICAL = ("time.step", "time.integrator", "time.tolerance", "time.spectral_radius", "solver.", "petsc.")
"""Keys that change how a scene is solved; every other key makes another scene, with its own reference."""

SYNONYMS = {
    "step": "dt",
    "timestep": "dt",
    "time_step": "dt",
    "h": "mesh",
    "size": "mesh",
    "rtol": "ksp_rtol",
    "scheme": "integrator",
    "method": "integrator",
    "ts_dt": "dt",
    "ts_type": "integrator",
}
"""What users may call the keys; refused with the right name."""

MOST_COMBINATIONS = 10_000


@dataclass(frozen=True)
class Axis:
    """One thing that varies.

    Attributes
    ----------
    key : str
        As the user wrote it.
    path : str
        The scene's key; ``mesh`` for the element size.
    values : tuple of float or str
        In the order given.
    """

    key: str
    path: str
    values: tuple[Value, ...]

    @property
    def numeric(self) -> bool:
        """Whether all its values are numbers."""
        return all(isinstance(value, float) for value in self.values)

    @property
    def physical(self) -> bool:
        """Whether its values are different scenes and not different ways to solve one."""
        return self.path != "mesh" and not self.path.startswith(NUMERICAL)

    @property
    def refines(self) -> bool:
        """Whether errors may shrink along it: several numbers that are ways to solve one scene."""
        return self.numeric and not self.physical and len(self.values) > 1


def parse_axes(texts: Sequence[str]) -> list[Axis]:
    """The axes of ``--vary``, in their order.

    Raises
    ------
    InputError
        Unknown key, no value, a value of the wrong kind, a value or a key given twice.
    """
    axes: list[Axis] = []
    for text in texts:
        axis = _axis(text)
        twin = next((other for other in axes if other.path == axis.path), None)
        if twin is not None:
            raise InputError(
                f"varies what {twin.key} varies already; give all values at once", key=_named(text)
            )
        axes.append(axis)
    paths = {axis.path for axis in axes}
    if {"time.step", "time.tolerance"} <= paths:
        raise InputError(
            "a tolerance is for steps of automatic length, dt for fixed ones: vary one of them", key="--vary"
        )
    if math.prod(len(axis.values) for axis in axes) > MOST_COMBINATIONS:
        raise InputError(f"makes more than {MOST_COMBINATIONS} combinations", key="--vary")
    return axes


def _named(text: str) -> str:
    return f"--vary {text if len(text) <= 60 else text[:57] + '...'}"


def _axis(text: str) -> Axis:
    key, equals, listed = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise InputError("must read key=value,value,…, as in dt=0.02,0.01", key=_named(text))
    path = path_of(key)
    words = [word.strip() for word in _split(listed)]
    if not any(words):
        raise InputError(f"no values: give at least one, as in {key}=…,…", key=_named(text))
    if not all(words):
        raise InputError("has an empty value between its commas", key=_named(text))
    values = tuple(_value(path, word, text) for word in words)
    for number, value in enumerate(values):
        if value in values[:number]:
            raise InputError(f"has the value {words[number]} twice", key=_named(text))
    return Axis(key, path, values)


def path_of(key: str) -> str:
    """The scene's key that a key of ``--vary`` stands for.

    Raises
    ------
    InputError
        For a key that stands for nothing, with the nearest that does.
    """
    if key == "mesh" or key in SHORT_NAMES:
        return SHORT_NAMES.get(key, key)
    if "." in key or "[" in key:
        return key.replace("mesh.size", "mesh") if key == "mesh.size" else key
    if OPTION.fullmatch(key) and key not in SYNONYMS:
        return f"petsc.{key}"
    if key in list(Scene.keys()):
        return key
    hint = nearest(SYNONYMS.get(key.lower(), key), ["mesh", *SHORT_NAMES, *USUAL_OPTIONS])
    raise InputError(
        f"unknown key, {hint}; any key of the scene can vary by its path, as in time.step",
        key=f"--vary {key}",
    )


def _split(text: str) -> list[str]:
    """At the commas outside of brackets."""
    pieces, depth = [""], 0
    for sign in text:
        depth += (sign in "[{(") - (sign in "]})")
        if sign == "," and depth <= 0:
            pieces.append("")
        else:
            pieces[-1] += sign
    return pieces


def _value(path: str, word: str, text: str) -> Value:
    if path == "time.integrator":
        if word not in INTEGRATORS:
            raise InputError(f"unknown integrator '{word}', {nearest(word, INTEGRATORS)}", key=_named(text))
        return word
    try:
        number = float(word)
    except ValueError:
        number = math.nan
    if math.isfinite(number):
        return number
    named = path in (*SHORT_NAMES.values(), "mesh") and path not in WORDS
    option = path.startswith("petsc.") and not path.endswith("_type")
    if not named and not option:
        return word
    raise InputError(f"'{word}' is no number", key=_named(text))
