"""What a study varies: ``--vary key=value,value,…`` into axes of checked values.

One combination of settings, and the scene it makes of the study's scene.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lyra_petsc.errors import InputError, nearest
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import INTEGRATORS, Scene
from lyra_petsc.show.report.numbers import seconds, short

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


LONGEST_NAME = 80

LEAN = ("output.fields=[]", "output.reactions=false")
"""What no run of a study needs to write."""


@dataclass(frozen=True)
class Combination:
    """A value for each axis.

    Attributes
    ----------
    axes : tuple of Axis
    values : tuple of float or str
        One for each axis.
    """

    axes: tuple[Axis, ...]
    values: tuple[Value, ...]

    @property
    def settings(self) -> dict[str, Value]:
        """Values by the axes' keys."""
        return {axis.key: value for axis, value in zip(self.axes, self.values, strict=True)}

    @property
    def physics(self) -> dict[str, Value]:
        """Those that make another scene."""
        pairs = zip(self.axes, self.values, strict=True)
        return {axis.key: value for axis, value in pairs if axis.physical}

    @property
    def name(self) -> str:
        """The folder: the settings, so that a wider study finds what a smaller one has finished."""
        words = []
        for axis, value in zip(self.axes, self.values, strict=True):
            key = "" if axis.path == "time.integrator" else axis.key
            if isinstance(value, str):
                words.append(f"{key}-{value}" if key else value)
            else:
                words.append(f"{key}{value!r}")
        plain = "-".join(words)
        tame = re.sub(r"[^\w.+-]+", "_", plain)[:LONGEST_NAME].strip("_.-")
        if tame == plain:
            return tame
        return f"{tame}-{hashlib.sha256(plain.encode()).hexdigest()[:8]}"

    @property
    def label(self) -> str:
        """In words: ``bdf2, Δt 10 ms``."""
        return (
            ", ".join(described(axis.key, value) for axis, value in zip(self.axes, self.values, strict=True))
            or "the scene as it is"
        )


def described(key: str, value: Value) -> str:
    """A setting in words."""
    if key in ("integrator", "time.integrator"):
        return str(value)
    if isinstance(value, str):
        return f"{key} {value}"
    if key in ("dt", "time.step"):
        return f"Δt {seconds(value, 6)}"
    if key == "mesh":
        return f"h {value:g} m"
    return f"{key} {short(value)}"


def combinations(axes: Sequence[Axis]) -> list[Combination]:
    """All combinations, the last axis varying fastest."""
    values = itertools.product(*(axis.values for axis in axes))
    return [Combination(tuple(axes), chosen) for chosen in values]


# -- from values to a scene ----------------------------------------------------------------------------


def overrides(base: Scene, axes: Sequence[Axis], values: Sequence[Value]) -> list[str]:
    """What ``--set`` would say to get a combination.

    Raises
    ------
    InputError
        An element size for a mesh that comes with its elements.
    """
    chosen = {axis.path: value for axis, value in zip(axes, values, strict=True)}
    found: list[str] = []
    for axis, value in zip(axes, values, strict=True):
        if axis.path == "mesh":
            found += mesh_overrides(base, float(value))
        else:
            found.append(f"{axis.path}={_text(value)}")
    return found + time_overrides(base, chosen)


def time_overrides(base: Scene, chosen: dict[str, Any]) -> list[str]:
    """What else of the ``time`` block must change so that it still fits together."""
    time, found = base.time, []
    if "time.tolerance" in chosen and time.step != "auto":
        found.append("time.step=auto")
    if "time.step" in chosen and chosen["time.step"] != "auto" and time.tolerance is not None:
        found.append("time.tolerance=")
    integrator = chosen.get("time.integrator")
    if integrator not in (None, "alpha2") and "time.spectral_radius" not in chosen:
        found.append("time.spectral_radius=")
    return found


def mesh_overrides(base: Scene, size: float) -> list[str]:
    """Element size [m] for every sheet: of gmsh scripts, or the nearest number of cells of grids.

    Raises
    ------
    InputError
        For a mesh file that comes with its elements, or a size that is no size.
    """
    if not (math.isfinite(size) and size > 0.0):
        raise InputError(f"an element size must be > 0 m, not {size:g}", key="--vary mesh")
    found = []
    for number, source in enumerate(base.mesh):
        if source.grid is not None:
            grid = source.grid
            nx, ny = (max(1, round(length / size)) for length in (grid.width, grid.height))
            found += [f"mesh[{number}].grid.nx={nx}", f"mesh[{number}].grid.ny={ny}"]
        elif source.file is not None and source.file.suffix.lower() == ".geo":
            found.append(f"mesh[{number}].size={size!r}")
        else:
            name = source.file.name if source.file is not None else "a mesh"
            raise InputError(
                f"{name} comes with its elements; element sizes vary for grids and .geo files only",
                file=base.source,
                key="--vary mesh",
            )
    return found


def _text(value: Value) -> str:
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


def scene_of(path: Path, given: Sequence[str], further: Sequence[str]) -> Scene:
    """The scene with ``--set`` and a combination's overrides, without what a study need not write.

    Raises
    ------
    InputError
        As ``load_scene`` does; what comes from the combination says so.
    """
    try:
        return load_scene(path, [*given, *LEAN, *further])
    except InputError as error:
        option, key = "--vary", error.key
        if key is not None and key.startswith("--set "):
            key = option + key.removeprefix("--set")
        message = error.message.replace("(from --set)", "(from --set or --vary)")
        raise InputError(message, file=error.file, key=key) from None
