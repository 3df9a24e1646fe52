"""One combination of settings, and the scene it makes of the study's scene."""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.study.axes import Axis, Value
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.show.report.numbers import seconds, short

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


def scene_of(path: Path, given: Sequence[str], further: Sequence[str], *, trust_mesh: bool = False) -> Scene:
    """The scene with ``--set`` and a combination's overrides, without what a study need not write.

    Raises
    ------
    InputError
        As ``load_scene`` does; what comes from the combination says so.
    """
    try:
        scene = load_scene(path, [*given, *LEAN, *further])
    except InputError as error:
        option, key = "--vary", error.key
        if key is not None and key.startswith("--set "):
            key = option + key.removeprefix("--set")
        message = error.message.replace("(from --set)", "(from --set or --vary)")
        raise InputError(message, file=error.file, key=key) from None
    return scene.trusting_meshes() if trust_mesh else scene
