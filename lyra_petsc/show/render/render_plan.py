"""What ``render`` will draw: its options, checked before anything is drawn, and the state in each frame."""

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
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.show.render.camera import line_of_sight, upwards
from lyra_petsc.show.render.colour_quantities import ColourRange, quantity
from lyra_petsc.show.render.image_files import TILES, check_film, colors_of, read_texture
from lyra_petsc.show.render.opengl import check_opengl
from lyra_petsc.show.render.sheet_geometry import HeldVertices

PACKAGES = ("pyvista", "vtkmodules", "PIL", "imageio_ffmpeg")
"""What pictures need of the extra ``view``."""

SIZE = "1280x720"
SMALLEST, LARGEST = 32, 8192
"""Pixels."""
COLORS = "#c8402f,#f0e2c8"
FILM, SHEET = "film.mp4", "sheet.png"
MOST_PICTURES = 1000
MOTION_STATES = 500
"""States that camera and colours are fitted to, beside those that are drawn."""
SIGHT_STATES = 9
"""States from which the direction of the camera is chosen."""

HIGHEST_FPS = 240.0
"""Frames a second that ``--fps`` may ask for."""
SLOWEST, FASTEST = 10.0, 60.0
"""Limits of a film's frames a second unless ``--fps`` says otherwise."""
GIF_FASTEST = 25.0
STATIC_SECONDS = 3.0
"""Seconds in which a film of a static analysis shows the whole load."""
MOST_FRAMES = 20_000


@dataclass(frozen=True)
class RenderOptions:
    """The options of ``render``; None or empty where they were not given."""

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
    colors: str = COLORS
    handles: bool = False
    wind: bool = False
    ground: bool = True
    label: bool = True
    settings: tuple[str, ...] = ()


@dataclass(frozen=True)
class FilmTiming:
    """The frames of a film.

    Attributes
    ----------
    fps : float
        Frames a second.
    states : tuple of int
        Number of the state that each frame shows, ascending.
    """

    fps: float
    states: tuple[int, ...]


@dataclass(frozen=True)
class RenderPlan:
    """What is drawn and where it is written; the same on every rank.

    Attributes
    ----------
    options : RenderOptions
    run : StoredRun
    scene : Scene
        The run's, with the camera as changed by ``--set``.
    size : (int, int)
        Width and height [pixels].
    colors : (str, str)
        Front and back of the sheet, as #rrggbb.
    pictures : list of (Path, int)
        Files of single pictures and the states they show.
    film : (Path, FilmTiming) or None
    sheet : (Path, tuple of int) or None
        File of the contact sheet and the states it shows.
    texture : (h, w, 3) uint8 or None
    limits : ColourRange or None
        Range of the colours that ``--range`` gives.
    """

    options: RenderOptions
    run: StoredRun
    scene: Scene
    size: tuple[int, int]
    colors: tuple[str, str]
    pictures: list[tuple[Path, int]]
    film: tuple[Path, FilmTiming] | None
    sheet: tuple[Path, tuple[int, ...]] | None
    texture: NDArray[np.uint8] | None
    limits: ColourRange | None

    @property
    def states(self) -> list[int]:
        """Numbers of the states that are drawn, ascending."""
        shown = {state for _, state in self.pictures}
        shown |= set(self.film[1].states) if self.film else set()
        return sorted(shown | set(self.sheet[1] if self.sheet else ()))

    @property
    def motion(self) -> list[int]:
        """States of the whole run, to which camera and colours are fitted, so that all its pictures agree."""
        return sorted({*self.states, *spread_states(self.run.times, MOTION_STATES)})


def make_plan(options: RenderOptions) -> RenderPlan:
    """Check the options and decide what is drawn. Call on one rank.

    Raises
    ------
    InputError
        For whatever cannot be drawn; only the folder of ``--out`` may have been created.
    """
    run = StoredRun(options.run)
    scene = scene_shown(run, options.settings)
    size = _size(options.size)
    limits = _range(options)
    _check_speeds(options)
    if options.field is not None:
        if options.texture is not None:
            raise InputError("covers what --texture shows; leave one of them out", key="--field")
        quantity(run, options.field)
    if options.wind and (scene.wind is None or not any(scene.wind.velocity)):
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
    colors = colors_of(options.colors)
    texture = None if options.texture is None else read_texture(options.texture)
    film = None
    if film_file is not None:
        check_film(options.film or Path(FILM), size)  # the folder of --out may not be there yet
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


def scene_shown(run: StoredRun, settings: Sequence[str]) -> Scene:
    """The scene of a run, with its camera changed by ``--set``.

    Raises
    ------
    InputError
        For settings of anything else, or that cannot be.
    """
    for text in settings:
        if not re.match(r"\s*render\b", text):
            raise InputError(f"{text!r}: the run is done, only render.… can be changed", key="--set")
    if not settings:
        return run.scene
    return load_scene(run.folder / "scene.yaml", settings, meshes_needed=False)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text.strip().lower())
    width, height = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (SMALLEST <= width <= LARGEST and SMALLEST <= height <= LARGEST):
        raise InputError(
            f"must be WIDTHxHEIGHT in pixels, {SMALLEST} to {LARGEST} each, as in {SIZE}, not {text!r}",
            key="--size",
        )
    return width, height


def numbers(text: str, key: str, example: str) -> list[float]:
    """The numbers of an option, with commas between them.

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
    times = list(dict.fromkeys(numbers(text, "--at", "0.25,1,2"))) if text is not None else []
    if len(times) > MOST_PICTURES:
        raise InputError(
            f"names {len(times)} times, at most {MOST_PICTURES} are drawn; see --film", key="--at"
        )
    return times


def _range(options: RenderOptions) -> ColourRange | None:
    if options.range is None:
        return None
    if options.field is None:
        raise InputError("is the range of what --field shows; name a field, too", key="--range")
    return ColourRange.parse(options.range)


def _check_speeds(options: RenderOptions) -> None:
    if options.fps is not None and not 0.1 <= options.fps <= HIGHEST_FPS:
        raise InputError(
            f"must be from 0.1 to {HIGHEST_FPS:g} frames a second, not {options.fps:g}", key="--fps"
        )
    if options.speed is not None and not (options.speed > 0.0 and math.isfinite(options.speed)):
        raise InputError(f"must be > 0, not {options.speed:g}", key="--speed")


def run_line_of_sight(run: StoredRun, scene: Scene) -> Array:
    """Unit vector from the sheet to the camera, chosen from a few states of the whole run."""
    shapes = (run.positions[state] for state in spread_states(run.times, SIGHT_STATES))
    return line_of_sight(scene, upwards(scene), shapes, run.triangles)


def film_timing(
    times: Array,
    fps: float | None = None,
    speed: float | None = None,
    *,
    static: bool = False,
    gif: bool = False,
) -> FilmTiming:
    """Frames at equal intervals, each showing the state nearest to its time.

    Parameters
    ----------
    times : (n,) float64
        Of the states, ascending [s] (static: load factors).
    fps : float, optional
        Frames a second; by default one for each state, as far as that makes 10 to 60 (GIF: 25).
    speed : float, optional
        Simulated seconds that a second of the film shows; 1 by default (static: a third of the load).
    static, gif : bool

    Raises
    ------
    InputError
        If the film would be far too long.
    """
    speed = speed if speed is not None else 1.0 / STATIC_SECONDS if static else 1.0
    rate = fps if fps is not None else _natural_rate(times, speed, GIF_FASTEST if gif else FASTEST)
    if gif:  # its delays are whole hundredths of a second, and viewers ignore those below two
        rate = 100.0 / max(2, round(100.0 / rate))
    span = float(times[-1] - times[0])
    count = span * rate / speed + 1.0
    if not count <= MOST_FRAMES:
        raise InputError(
            f"a film of {span:g} s at {rate:g} frames a second and speed {speed:g} would have {count:.3g} "
            f"frames, more than {MOST_FRAMES}; give a larger --speed",
            key="--film",
        )
    at = times[0] + np.arange(math.floor(count + 1e-6)) * (speed / rate)
    return FilmTiming(rate, tuple(int(i) for i in nearest_states(times, at)))


def _natural_rate(times: Array, speed: float, fastest: float) -> float:
    """Frame rate at which every state, or every nth, is shown in one or several whole frames."""
    intervals = np.diff(times)
    if len(intervals) == 0:
        return SLOWEST
    rate = speed / float(np.median(intervals))
    if rate > fastest:
        rate /= math.ceil(rate / fastest * (1.0 - 1e-6))
    elif rate < SLOWEST:
        rate *= math.ceil(min(SLOWEST / rate, 1e6) * (1.0 - 1e-6))
    return float(f"{rate:.6g}")


def nearest_states(times: Array, at: Array) -> Ints:
    """Numbers of the states nearest to times ``at`` [s]; of two as near, the earlier."""
    if len(times) == 1:
        return np.zeros(len(at), dtype=np.int64)
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    nearer_before = at - times[after - 1] <= times[after] - at + 1e-9 * (times[after] - times[after - 1])
    return np.asarray(after - nearer_before, dtype=np.int64)


def pick_state(run: StoredRun, time: float, key: str) -> int:
    """The state nearest to a time that the option ``key`` names.

    Raises
    ------
    InputError
        If the time is outside the run.
    """
    times, unit = run.times, "" if run.scene.time.static else " s"
    first, last = float(times[0]), float(times[-1])
    slack = 1e-6 * max(last - first, abs(last)) + 0.5 * float(np.diff(times).max(initial=0.0))
    if not first - slack <= time <= last + slack:
        raise InputError(
            f"{time:g}{unit} is outside the run, whose states go from {first:g} to {last:g}{unit}", key=key
        )
    return int(nearest_states(times, np.array([time]))[0])


def spread_states(times: Array, count: int) -> tuple[int, ...]:
    """Up to ``count`` different states, at equal intervals from the first to the last."""
    wanted = np.linspace(times[0], times[-1], count)
    return tuple(int(i) for i in np.unique(nearest_states(times, wanted)))


def decimals(times: Array) -> int:
    """Decimals with which the times of the states differ; all those of their interval if it has few."""
    if len(times) == 1:
        return 2
    interval = float(np.median(np.diff(times)))
    least = max(0, math.ceil(-math.log10(interval) - 1e-9))
    short = abs(round(interval, least) - interval) < 1e-3 * interval
    return least if short else least + 1
