"""What is to be drawn, decided and checked before anything is."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.render.film import check_film
from lyra_petsc.render.held import HeldVertices
from lyra_petsc.render.opengl import check_opengl
from lyra_petsc.render.quantities import quantity
from lyra_petsc.render.stills import TILES, colors_of, read_texture
from lyra_petsc.render.timing import Timing, film_timing, pick_state, spread_states
from lyra_petsc.results.run import Run
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene

SIZE = (1280, 720)
SMALLEST, LARGEST = 32, 8192
"""Pixels."""
COLORS = "#c8402f,#f0e2c8"
FILM, SHEET = "film.mp4", "sheet.png"
LONGEST_LIST = 1000
MOTION = 500
"""States that stand for the whole motion, beside those that are shown."""
FASTEST = 240.0
"""Frames a second that may be asked for."""


@dataclass(frozen=True)
class Asked:
    """The command line of ``render``; None or empty where nothing was said."""

    run: Path
    at: str | None = None
    film: Path | None = None
    sheet: bool = False
    paraview: bool = False
    out: Path | None = None
    size: str | None = None
    fps: float | None = None
    speed: float | None = None
    field: str | None = None
    range: str | None = None
    texture: Path | None = None
    colors: str = COLORS
    handles: bool = False
    wind: bool = False
    ground: bool = True
    label: bool = True
    settings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plan:
    """The same for every rank.

    Attributes
    ----------
    run : Run
    scene : Scene
        With the camera as changed on the command line.
    size : (int, int)
        Pixels.
    pictures : list of (Path, int)
        Files and the states they show.
    film : (Path, Timing) or None
    sheet : (Path, states) or None
    colors : (str, str)
    texture : (h, w, 3) uint8 or None
    limits : (float, float) or None
        Of the colours, as asked for.
    """

    run: Run
    scene: Scene
    size: tuple[int, int]
    colors: tuple[str, str]
    pictures: list[tuple[Path, int]] = field(default_factory=list)
    film: tuple[Path, Timing] | None = None
    sheet: tuple[Path, tuple[int, ...]] | None = None
    texture: NDArray[np.uint8] | None = None
    limits: tuple[float, float] | None = None

    @property
    def states(self) -> list[int]:
        """Every state that is shown, once, ascending."""
        shown = {state for _, state in self.pictures}
        shown |= set(self.film[1].states) if self.film else set()
        return sorted(shown | set(self.sheet[1] if self.sheet else ()))

    @property
    def motion(self) -> list[int]:
        """The states that camera and colours are fitted to: the whole run, so that all its pictures agree."""
        return sorted({*self.states, *spread_states(self.run.times, MOTION)})


def make_plan(asked: Asked) -> Plan:
    """Decide (rank 0).

    Raises
    ------
    InputError
        For whatever cannot be drawn; nothing is written yet but the folder of ``--out``.
    """
    run = Run(asked.run)
    scene = _scene(run, asked.settings)
    static = scene.time.analysis == "static"
    size = _size(asked.size)
    limits = _range(asked)
    _check_speeds(asked)
    if asked.field is not None:
        if asked.texture is not None:
            raise InputError("covers what --texture shows; leave one of them out", key="--field")
        quantity(run, asked.field)
    if asked.wind and (scene.wind is None or not any(scene.wind.velocity)):
        raise InputError("this run's scene has no wind to draw", key="--wind")
    if asked.handles:
        if not scene.handles:
            raise InputError("this run's scene has no handles to draw", key="--handles")
        HeldVertices(run)
    times = _times(asked.at)
    unit = "" if static else " s"
    states = [pick_state(run.times, time, unit) for time in times]
    everything = not (times or asked.film or asked.sheet)
    folder = asked.out or run.folder
    film = asked.film or (folder / FILM if everything else None)
    colors = colors_of(asked.colors)
    texture = None if asked.texture is None else read_texture(asked.texture)
    timing = None
    if film is not None:
        check_film(asked.film or Path(FILM), size)
        gif = film.suffix.lower() == ".gif"
        timing = film_timing(run.times, fps=asked.fps, speed=asked.speed, static=static, gif=gif)
    check_opengl()
    if asked.out is not None:
        _make(asked.out)
    return Plan(
        run=run,
        scene=scene,
        size=size,
        colors=colors,
        pictures=[
            (folder / f"picture-{time:.12g}.png", state) for time, state in zip(times, states, strict=True)
        ],
        film=(film, timing) if film is not None and timing is not None else None,
        sheet=(folder / SHEET, spread_states(run.times, TILES)) if asked.sheet or everything else None,
        texture=texture,
        limits=limits,
    )


def _scene(run: Run, settings: Sequence[str]) -> Scene:
    for text in settings:
        if not re.match(r"\s*render\b", text):
            raise InputError(f"{text!r}: the run is done, only render.… can be changed", key="--set")
    if not settings:
        return run.scene
    return load_scene(run.folder / "scene.yaml", settings, meshes_needed=False)


def _size(text: str | None) -> tuple[int, int]:
    if text is None:
        return SIZE
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text.strip().lower())
    width, height = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (SMALLEST <= width <= LARGEST and SMALLEST <= height <= LARGEST):
        raise InputError(
            f"must be WIDTHxHEIGHT in pixels, {SMALLEST} to {LARGEST} each, as in 1280x720, not {text!r}",
            key="--size",
        )
    return width, height


def _numbers(text: str, key: str, example: str) -> list[float]:
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if not values or not all(map(math.isfinite, values)):
        raise InputError(f"must be numbers with commas between them, as in {example}, not {text!r}", key=key)
    return values


def _times(text: str | None) -> list[float]:
    times = list(dict.fromkeys(_numbers(text, "--at", "0.25,1,2"))) if text is not None else []
    if len(times) > LONGEST_LIST:
        raise InputError(
            f"names {len(times)} times, at most {LONGEST_LIST} are drawn; see --film", key="--at"
        )
    return times


def _range(asked: Asked) -> tuple[float, float] | None:
    if asked.range is None:
        return None
    if asked.field is None:
        raise InputError("is the range of what --field shows; name a field, too", key="--range")
    ends = _numbers(asked.range, "--range", "0,5")
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise InputError(
            f"must be two numbers, the lower first, as in 0,5, not {asked.range!r}", key="--range"
        )
    return ends[0], ends[1]


def _check_speeds(asked: Asked) -> None:
    if asked.fps is not None and not 0.1 <= asked.fps <= FASTEST:
        raise InputError(f"must be from 0.1 to {FASTEST:g} frames a second, not {asked.fps:g}", key="--fps")
    if asked.speed is not None and not (asked.speed > 0.0 and math.isfinite(asked.speed)):
        raise InputError(f"must be > 0, not {asked.speed:g}", key="--speed")


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made: {error.strerror}", file=folder, key="--out") from None
