"""The plan of ``render``: its options, checked before anything is drawn, and the state of each frame."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.output.layout import SCENE_FILE
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.time_curve import acts
from lyra_petsc.show.render.camera import line_of_sight, up_direction
from lyra_petsc.show.render.colour_quantities import ColourRange, quantity
from lyra_petsc.show.render.image_files import (
    MAX_PIXELS,
    MIN_PIXELS,
    TILES,
    check_film,
    parse_colors,
    read_texture,
)
from lyra_petsc.show.render.opengl import check_opengl
from lyra_petsc.show.render.sheet_geometry import HeldVertices, sheet_numbers

PACKAGES = ("pyvista", "vtkmodules", "PIL", "imageio_ffmpeg")
"""Packages of the extra ``view`` that pictures need."""

SIZE = "1280x720"
COLORS = ("#c8402f", "#f0e2c8")
"""Front and back of a single sheet."""
SHEET_COLORS = (
    ("#c8402f", "#e8ab9f"),
    ("#2f6f9f", "#a3c0d6"),
    ("#d99a2b", "#f0d3a0"),
    ("#4b8b57", "#aecfb4"),
    ("#7d4a94", "#c9b2d3"),
    ("#2b9a9a", "#a0d3d3"),
    ("#8a5a3c", "#cdb5a5"),
    ("#5c6675", "#b5bac2"),
)
"""Front and back of each of several sheets, in turn."""
OBSTACLE_COLOR = "#9aa0a8"
FILM, SHEET = "film.mp4", "sheet.png"
FEW_STATES = 24
"""Number of states that choose the direction of the camera, and the colours of the live page."""

MAX_FPS = 240.0
"""Upper bound of ``--fps`` (frames per second)."""
DEFAULT_MIN_FPS, DEFAULT_MAX_FPS = 10.0, 60.0
"""Limits of a film's frames per second without ``--fps``."""
GIF_MAX_FPS = 25.0
STATIC_SECONDS = 3.0
"""Duration of a film of a static analysis [s]."""
MAX_FRAMES = 20_000


@dataclass(frozen=True)
class RenderOptions:
    """The options of ``render``; None or empty if not given."""

    run: Path
    at: str | None = None
    film: Path | None = None
    sheet: bool = False
    paraview: bool = False
    out: Path | None = None
    size: str = SIZE
    fps: float | None = None
    speed: float | None = None
    field: str | None = None
    range: str | None = None
    cells: bool = False
    texture: Path | None = None
    colors: str | None = None
    handles: bool = False
    wind: bool = False
    ground: bool = True
    label: bool = True
    settings: tuple[str, ...] = ()
    fitted_states: int = 500
    """Number of states, besides those drawn, to which floor and colours are fitted."""


@dataclass(frozen=True)
class FilmTiming:
    """The frames of a film.

    Attributes
    ----------
    fps : float
        Frames per second.
    states : tuple of int
        Number of the state in each frame, ascending.
    """

    fps: float
    states: tuple[int, ...]


@dataclass(frozen=True)
class RenderPlan:
    """The states to draw and the files to write; the same on every rank.

    Attributes
    ----------
    options : RenderOptions
    run : StoredRun
    scene : Scene
        The run's scene, with the camera changed by ``--set``.
    size : (int, int)
        Width and height [pixels].
    colors : tuple of (str, str)
        Front and back, as #rrggbb, of the first sheet, the second and so on, in turn.
    pictures : list of (Path, int)
        Files of single pictures and the number of each picture's state.
    film : (Path, FilmTiming) or None
    sheet : (Path, tuple of int) or None
        File of the contact sheet and the numbers of its states.
    texture : (h, w, 3) uint8 or None
    limits : ColourRange or None
        Range of the colours given by ``--range``.
    """

    options: RenderOptions
    run: StoredRun
    scene: Scene
    size: tuple[int, int]
    colors: tuple[tuple[str, str], ...]
    pictures: list[tuple[Path, int]]
    film: tuple[Path, FilmTiming] | None
    sheet: tuple[Path, tuple[int, ...]] | None
    texture: NDArray[np.uint8] | None
    limits: ColourRange | None

    @property
    def states(self) -> list[int]:
        """Numbers of the states to draw, ascending."""
        shown = {state for _, state in self.pictures}
        shown |= set(self.film[1].states) if self.film else set()
        return sorted(shown | set(self.sheet[1] if self.sheet else ()))

    @property
    def motion(self) -> list[int]:
        """States to which floor and colours are fitted: of the whole run, so that all its pictures agree."""
        return sorted({*self.states, *spread_states(self.run.times, self.options.fitted_states)})


def make_plan(options: RenderOptions) -> RenderPlan:
    """Check the options and plan the drawing. Call on one rank.

    Raises
    ------
    InputError
        For options that cannot be drawn; only the folder of ``--out`` may have been created.
    """
    run = StoredRun(options.run)
    scene = scene_with_settings(run, options.settings)
    size = _size(options.size)
    limits = _range(options)
    _check_speeds(options)
    if options.field is not None:
        if options.texture is not None:
            raise InputError("covers what --texture shows; leave one of them out", key="--field")
        quantity(run, options.field)
    if options.wind and (scene.wind is None or not acts(scene.wind.velocity)):
        raise InputError("this run's scene has no wind to draw", key="--wind")
    if options.handles:
        if not scene.handles:
            raise InputError("this run's scene has no handles to draw", key="--handles")
        HeldVertices(run)
    times = _times(options.at)
    states = [pick_state(run, time, "--at") for time in times]
    nothing_named = not (times or options.film or options.sheet)
    folder = options.out or run.folder
    film_file = options.film or (folder / FILM if nothing_named else None)
    colors: tuple[tuple[str, str], ...] = (COLORS,)
    if options.colors is not None:
        colors = (parse_colors(options.colors),)
    elif options.field is None and options.texture is None and sheet_numbers(run).any():
        colors = SHEET_COLORS
    texture = None if options.texture is None else read_texture(options.texture)
    film = None
    if film_file is not None:
        check_film(options.film or Path(FILM), size)  # the folder of --out may not exist yet
        gif = film_file.suffix.lower() == ".gif"
        static = scene.time.static
        film = film_file, film_timing(run.times, options.fps, options.speed, static=static, gif=gif)
    check_opengl()
    if options.out is not None:
        try:
            options.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot be made: {error.strerror}", file=options.out, key="--out") from None
    pictures = [(folder / f"picture-{t:.12g}.png", state) for t, state in zip(times, states, strict=True)]
    sheet = (folder / SHEET, spread_states(run.times, TILES)) if options.sheet or nothing_named else None
    return RenderPlan(options, run, scene, size, colors, pictures, film, sheet, texture, limits)


def scene_with_settings(run: StoredRun, settings: Sequence[str]) -> Scene:
    """The scene of a run, with its camera changed by ``--set``.

    Raises
    ------
    InputError
        For settings of other keys, or invalid ones.
    """
    for text in settings:
        if not re.match(r"\s*render\b", text):
            raise InputError(f"{text!r}: the run is done, only render.… can be changed", key="--set")
    if not settings:
        return run.scene
    return load_scene(run.folder / SCENE_FILE, settings, meshes_needed=False)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text.strip().lower())
    width, height = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (MIN_PIXELS <= width <= MAX_PIXELS and MIN_PIXELS <= height <= MAX_PIXELS):
        raise InputError(
            f"must be WIDTHxHEIGHT in pixels, {MIN_PIXELS} to {MAX_PIXELS} each, as in {SIZE}, not {text!r}",
            key="--size",
        )
    return width, height


def parse_numbers(text: str, key: str, example: str) -> list[float]:
    """The comma-separated numbers of an option.

    Raises
    ------
    InputError
    """
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if not values or not all(map(math.isfinite, values)):
        raise InputError(f"must be numbers with commas between them, as in {example}, not {text!r}", key=key)
    return values


def _times(text: str | None) -> list[float]:
    return list(dict.fromkeys(parse_numbers(text, "--at", "0.25,1,2"))) if text is not None else []


def _range(options: RenderOptions) -> ColourRange | None:
    if options.range is None:
        return None
    if options.field is None:
        raise InputError("is the range of what --field shows; name a field, too", key="--range")
    return ColourRange.parse(options.range)


def _check_speeds(options: RenderOptions) -> None:
    if options.fps is not None and not 0.1 <= options.fps <= MAX_FPS:
        raise InputError(f"must be from 0.1 to {MAX_FPS:g} frames a second, not {options.fps:g}", key="--fps")
    if options.speed is not None and not (options.speed > 0.0 and math.isfinite(options.speed)):
        raise InputError(f"must be > 0, not {options.speed:g}", key="--speed")


def run_line_of_sight(run: StoredRun, scene: Scene) -> Array:
    """Unit vector from the sheet to the camera, chosen by a few states of the whole run."""
    shapes = (run.positions[state] for state in spread_states(run.times, FEW_STATES))
    return line_of_sight(scene, up_direction(scene), shapes, run.triangles)


def film_timing(
    times: Array,
    fps: float | None = None,
    speed: float | None = None,
    *,
    static: bool = False,
    gif: bool = False,
) -> FilmTiming:
    """Frames at equal intervals, each with the state nearest to its time.

    Parameters
    ----------
    times : (n,) float64
        Times of the states, ascending [s] (static: load factors).
    fps : float, optional
        Frames per second; by default one per state, within 10 and 60 (GIF: 25).
    speed : float, optional
        Simulated seconds per second of the film; 1 by default (static: a third of the load).
    static, gif : bool

    Raises
    ------
    InputError
        If the film would have more than `MAX_FRAMES` frames.
    """
    speed = speed if speed is not None else 1.0 / STATIC_SECONDS if static else 1.0
    rate = fps if fps is not None else _default_fps(times, speed, GIF_MAX_FPS if gif else DEFAULT_MAX_FPS)
    if gif:  # GIF's delays are multiples of 0.01 s, and viewers ignore delays below 0.02 s
        rate = 100.0 / max(2, round(100.0 / rate))
    span = float(times[-1] - times[0])
    count = span * rate / speed + 1.0
    if not count <= MAX_FRAMES:
        raise InputError(
            f"a film of {span:g} s at {rate:g} frames a second and speed {speed:g} would have {count:.3g} "
            f"frames, more than {MAX_FRAMES}; give a larger --speed",
            key="--film",
        )
    at = times[0] + np.arange(math.floor(count + 1e-6)) * (speed / rate)
    return FilmTiming(rate, tuple(int(i) for i in nearest_states(times, at)))


def _default_fps(times: Array, speed: float, fastest: float) -> float:
    """Frame rate at which every state, or every n-th state, has a whole number of frames."""
    intervals = np.diff(times)
    if len(intervals) == 0:
        return DEFAULT_MIN_FPS
    rate = speed / float(np.median(intervals))
    if rate > fastest:
        rate /= math.ceil(rate / fastest * (1.0 - 1e-6))
    elif rate < DEFAULT_MIN_FPS:
        rate *= math.ceil(min(DEFAULT_MIN_FPS / rate, 1e6) * (1.0 - 1e-6))
    return float(f"{rate:.6g}")


def nearest_states(times: Array, at: Array) -> Ints:
    """Numbers of the states nearest to times ``at`` [s]; of two equally near ones, the earlier."""
    if len(times) == 1:
        return np.zeros(len(at), dtype=np.int64)
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    nearer_before = at - times[after - 1] <= times[after] - at + 1e-9 * (times[after] - times[after - 1])
    return np.asarray(after - nearer_before, dtype=np.int64)


def pick_state(run: StoredRun, time: float, key: str) -> int:
    """Number of the state nearest to a time that the option ``key`` gives.

    Raises
    ------
    InputError
        If the time is outside the run.
    """
    times, unit = run.times, "" if run.scene.time.static else " s"
    first, last = float(times[0]), float(times[-1])
    tolerance = 1e-6 * max(last - first, abs(last)) + 0.5 * float(np.diff(times).max(initial=0.0))
    if not first - tolerance <= time <= last + tolerance:
        raise InputError(
            f"{time:g}{unit} is outside the run, whose states go from {first:g} to {last:g}{unit}", key=key
        )
    return int(nearest_states(times, np.array([time]))[0])


def spread_states(times: Array, count: int) -> tuple[int, ...]:
    """Numbers of up to ``count`` different states, evenly spaced from the first to the last."""
    wanted = np.linspace(times[0], times[-1], count)
    return tuple(int(i) for i in np.unique(nearest_states(times, wanted)))


def decimals(times: Array) -> int:
    """Number of decimals with which the states' times differ, or which show a short interval exactly."""
    if len(times) == 1:
        return 2
    interval = float(np.median(np.diff(times)))
    minimum = max(0, math.ceil(-math.log10(interval) - 1e-9))
    exact = abs(round(interval, minimum) - interval) < 1e-3 * interval
    return minimum if exact else minimum + 1
