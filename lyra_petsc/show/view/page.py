"""The page: its layout, the state that it shows, and the actions of its controls."""

from __future__ import annotations

import asyncio
import math
import time as clock
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from trame.app import get_server
from trame.ui.vuetify3 import VAppLayout
from trame.widgets import client, html, plotly, vtk
from trame.widgets import vuetify3 as v
from trame_vtk.modules.vtk.serializers import SynchronizationContext

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.output.read_run import StoredRun, read_history
from lyra_petsc.output.run_folder import is_locked
from lyra_petsc.show.render.camera import CameraFit, line_of_sight, up_direction
from lyra_petsc.show.render.colour_quantities import ColourRange, quantity
from lyra_petsc.show.render.render_plan import scene_with_settings
from lyra_petsc.show.render.scene_drawing import Bounds, near_obstacle_points, wind_arrows
from lyra_petsc.show.render.sheet_geometry import HeldVertices
from lyra_petsc.show.view import page_content as content
from lyra_petsc.show.view.cloth import Cloth
from lyra_petsc.show.view.server import Access

if TYPE_CHECKING:
    from lyra_petsc.show.obstacle_surfaces import ObstacleSurface


STYLE, SCRIPT = (Path(__file__).with_name(name) for name in ("style.css", "keys.js"))
DRAG_PIXELS = 5.0
"""Mouse movement [pixels] from which on a click counts as dragging."""

SLOW_DRAWING = 2.0
"""Time [s] after which the page says that it waits for the browser to draw a state."""
MAX_DRAWING = 30.0
"""Time [s] after which the next state is sent even if the last one has not been drawn."""

ARRAY_BYTES = 256 * 2**20
"""Size of the sent arrays that are kept for pages that fetch them late."""
ARRAY_SECONDS = 20.0
"""Age below which sent arrays are always kept."""

POLLING_SHARE = 0.02
"""Fraction of a processor's time that polling for new states may take."""
MIN_POLL_SECONDS, MAX_POLL_SECONDS = 0.5, 5.0
"""Bounds of the polling interval."""
LATE_SECONDS = 5.0
"""Time [s] without a new state after which the page says that it waits for the run."""

MARK_SECONDS = 0.25
"""Time [s] between two moves of the plots' time marks when playing."""

COMPACT: dict[str, Any] = {"density": "compact", "hide_details": True}
"""Style of a control."""

PLAIN = "none"
"""Option of the quantities: the cloth has one colour."""
AUTOMATIC = "automatic"
"""Option of the colour maps: chosen by the quantity."""

MOTION_STATES = 24
"""Number of states to which the camera is fitted."""
SIGHT_STATES = 6
"""Number of states from which the camera's direction is chosen."""
FIRST_ASPECT = 1.6
"""Aspect ratio of the picture until the page reports its size."""


@dataclass(frozen=True)
class Look:
    """Initial settings of the page.

    Attributes
    ----------
    field : str or None
        The quantity that colours the cloth.
    range : str or None
        Range of the colours, as in ``render --range``.
    settings : tuple of str
        Changes of the scene's camera, as in ``render --set``.
    """

    field: str | None = None
    range: str | None = None
    settings: tuple[str, ...] = ()

    def check(self, run: StoredRun) -> None:
        """Check that the run can be shown with these settings.

        Raises
        ------
        InputError
        """
        scene_with_settings(run, self.settings)
        if self.field is not None:
            quantity(run, self.field)
        if self.range is not None:
            ColourRange.parse(self.range)


DEFAULT_LOOK = Look()


class Page:
    """The page; all browsers that have it open show the same.

    Parameters
    ----------
    run : StoredRun
    access : Access
        Counts the open pages.
    look : Look

    Attributes
    ----------
    server : trame's server
    cloth : Cloth
    """

    def __init__(self, run: StoredRun, access: Access, look: Look = DEFAULT_LOOK) -> None:
        self._run, self._access, self._look = run, access, look
        SynchronizationContext.check_for_arrays_to_release = release_old_arrays
        self.server = get_server("lyra-petsc")
        self._state = state = self.server.state
        self._triangles = run.triangles
        self.cloth = Cloth(self._triangles)
        self._player = content.Player(run)
        self._palette: content.Palette | None = None
        self._aspect = FIRST_ASPECT
        self._fitted = False
        self._drawn = asyncio.Event()
        self._shown = -1
        self._marked = 0.0
        self._last_news = clock.monotonic()
        self._probe: content.Probe | None = None
        self._pressed: tuple[float, float] | None = None
        self._positions = run.positions[0]
        self._held: HeldVertices | None = None
        self._obstacles: list[ObstacleSurface] | None = None
        self._find_handles()
        self._unit = "" if run.scene.time.static else "s"
        self._figures: dict[str, dict[str, Any]] = {}
        self._initialise()
        self._fit_camera()
        self._view = _build_layout(self)
        state.change("frame")(self._frame_changed)
        state.change("speed")(self._speed_changed)
        state.change("edges")(self._edges_changed)
        state.change("quantity", "range", "map")(self._colours_changed)
        state.change("around")(self._around_changed)
        state.change("size")(self._size_changed)

    def _initialise(self) -> None:
        """Initialise the page's variables."""
        run, state, player = self._run, self._state, self._player
        state.trame__title = f"{run.name} – lyra_petsc"
        state.title = run.scene.title or run.name
        state.status, state.notice, state.farewell = self._outcome(), "", ""
        state.waiting, state.picked = "", []
        state.range, state.range_error = self._look.range or "", ""
        state.map, state.maps = AUTOMATIC, [AUTOMATIC, *content.MAPS]
        state.around = True
        state.frame, state.last = player.shown, player.last
        state.playing, state.edges = False, False
        state.clock, state.bar = "", None
        state.quantity = self._look.field or "speed"
        unit = "×" if self._unit else "/s"
        state.speeds = [
            {"title": f"{factor * player.speed:g} {unit}", "value": factor * player.speed}
            for factor in content.SPEED_FACTORS
        ]
        state.speed = player.speed
        self._offer_quantities()
        self._draw_plots()
        self._show()

    def _offer_quantities(self) -> None:
        """List the quantities of this run, and keep the selected one if it is among them."""
        known, state = content.names(self._run), self._state
        state.quantities = [{"title": name.replace("_", " "), "value": name} for name in (PLAIN, *known)]
        if state.quantity not in known:
            state.quantity = PLAIN
        self._set_palette(state.quantity)

    def _outcome(self) -> str:
        summary = self._run.summary
        outcome, ranks = str(summary.get("outcome", "")), summary.get("ranks", 0)
        if outcome == "running" and not is_locked(self._run.folder):
            outcome = "broken off"
        parts = [f"{len(self._run.rest):,} vertices", f"{len(self._run)} states"]
        late = clock.monotonic() - self._last_news
        if outcome == "running" and late > LATE_SECONDS:
            outcome = f"running, the next state awaited for {late:.0f} s"
        if ranks:
            parts.append(f"{ranks} rank{'s' * (ranks != 1)}")
        return " · ".join([*parts, outcome] if outcome else parts)

    # -- controls ----------------------------------------------------------------------------------

    def play_or_pause(self) -> None:
        """Start or stop playing."""
        if self._player.playing:
            self._player.pause()
        else:
            self._player.play()
        self._state.playing = self._player.playing

    def fit(self) -> None:
        """Move the camera so that it sees the whole motion."""
        self._fit_camera()
        self._view.push_camera()

    def drawn(self) -> None:
        """Called when a page has drawn the last state sent to it."""
        self._drawn.set()

    def _frame_changed(self, frame: Any, **_: Any) -> None:
        if isinstance(frame, int | float) and math.isfinite(frame) and int(frame) != self._player.shown:
            self._player.go(int(frame))

    def _speed_changed(self, speed: Any, **_: Any) -> None:
        if isinstance(speed, int | float) and 0 < speed < math.inf:
            self._player.set_speed(float(speed))

    def _edges_changed(self, edges: Any, **_: Any) -> None:
        self.cloth.show_edges(bool(edges))
        self._colours_changed()  # with visible edges, each triangle has the colour of its own value

    def _colours_changed(self, **_: Any) -> None:
        self._set_palette(self._state.quantity)
        self._redraw()

    def _around_changed(self, **_: Any) -> None:
        self._show_wind()
        self._redraw()

    def press(self, event: Any) -> None:
        """Called when the left mouse button is pressed on the cloth."""
        self._pressed = _pixel(event, "position")

    def pick(self, event: Any) -> None:
        """Show the values at the vertex nearest to a click; a click beside the cloth hides them."""
        at = _pixel(event, "displayPosition")
        moved = self._pressed is not None and at is not None and math.dist(at, self._pressed) > DRAG_PIXELS
        point = event.get("worldPosition") if isinstance(event, dict) else None
        if moved:  # the user has moved the camera
            return
        self._probe = None
        if isinstance(point, list) and len(point) == 3 and all(isinstance(x, int | float) for x in point):
            nearest = np.linalg.norm(self._positions - np.array(point), axis=1).argmin()
            with suppress(LyraError):
                self._probe = content.Probe(self._run, int(nearest))
        self._redraw()

    def _redraw(self) -> None:
        """Send the present state again."""
        self._shown = -1
        self._player.changed.set()

    def _size_changed(self, size: Any, **_: Any) -> None:
        """Called when a page reports the size of its picture; the camera is fitted to the first one."""
        try:
            aspect = float(size["size"]["width"]) / float(size["size"]["height"])
        except (TypeError, KeyError, ValueError, ZeroDivisionError):
            return
        if 0 < aspect < math.inf:
            self._aspect = aspect
            if not self._fitted:
                self._fitted = True
                self.fit()

    def _set_palette(self, name: Any) -> None:
        """Set the colours of the quantity ``name`` by the page's range and colour map."""
        state = self._state
        chosen = None
        try:
            text = str(state.range or "").strip()
            chosen = ColourRange.parse(text) if text else None
            state.range_error = ""
        except InputError as error:
            state.range_error = error.message
        colour_map = state.map if state.map in content.MAPS else ""
        try:
            self._palette = None
            if name in content.names(self._run):
                cells = bool(state.edges)
                self._palette = content.Palette(self._run, name, chosen, colour_map, cells=cells)
        except LyraError as error:
            self._palette = None
            self._state.notice = str(error)

    # -- state shown -------------------------------------------------------------------------------

    def _show(self) -> None:
        """Show the state that is due in the scene and in the page's texts."""
        run, state = self._run, self._state
        index = self._shown = self._player.due()
        try:
            positions = run.positions[index]
            if len(positions) != len(run.rest):  # `refresh` will read the new run
                raise InputError("was replaced by another run", file=run.folder)
            colours, on_triangles = self._palette.colours(index) if self._palette else (None, False)
            state.notice = ""
        except LyraError as error:
            state.notice = str(error)
        else:
            self.cloth.show(positions, colours, on_triangles=on_triangles)
            self._positions = positions
            self.cloth.show_obstacles(float(run.times[index]))
            self._show_points(index)
        state.bar = self._palette.bar() if self._palette else None
        state.frame, state.playing = index, self._player.playing
        name, end = ("t", f" of {run.times[-1]:.4g} {self._unit}") if self._unit else ("load", "")
        state.clock = f"{name} = {run.times[index]:.4g}{end}"
        if not self._player.playing or clock.monotonic() - self._marked > MARK_SECONDS:
            self._mark_time()

    def _show_points(self, index: int) -> None:
        """Show the held vertices and the picked one."""
        x, probe = self._positions, self._probe
        held, edges = np.empty(0, dtype=np.int64), np.empty((0, 2), dtype=np.int64)
        if self._held is not None and self._state.around:
            held, edges = self._held.at(float(self._run.times[index]))
        self.cloth.show_held(x[held], np.searchsorted(held, edges))
        if probe is not None and probe.vertex < len(x):
            only = self._state.quantity if self._player.playing else ""
            self._state.picked = probe.values(index, x[probe.vertex], only)
            self.cloth.mark(probe.vertex)
        else:
            self._state.picked = []
            self.cloth.mark(None)

    def _find_handles(self) -> None:
        self._held = None
        with suppress(LyraError):  # the page works without handles
            self._held = HeldVertices(self._run) if self._run.scene.handles else None

    def _find_obstacles(self) -> None:
        """Find the obstacles; planes become squares at the present motion."""
        self._obstacles = []
        if not self._run.scene.obstacles:
            self.cloth.set_obstacles([])
            return
        from lyra_petsc.show.obstacle_surfaces import obstacle_surfaces

        with suppress(LyraError):  # the page works without obstacles
            self._obstacles = obstacle_surfaces(self._run, self._bounds.middle, self._bounds.size)
        self.cloth.set_obstacles(self._obstacles)
        self.cloth.show_obstacles(float(self._run.times[max(self._shown, 0)]))

    def _show_wind(self) -> Array:
        """Show or hide arrows along the wind; returns their end points (n, 3) [m]."""
        wind, feet, arrow = self._run.scene.wind, np.empty((0, 3)), np.zeros(3)
        if wind is not None and any(wind.velocity) and self._state.around:
            feet, arrow = wind_arrows(self._bounds, np.array(wind.velocity))
        self.cloth.show_wind(feet, arrow)
        return np.concatenate([feet, feet + arrow])

    def _fit_camera(self) -> None:
        """Move the camera to the position that ``render`` would choose."""
        run = self._run
        scene = scene_with_settings(run, self._look.settings)
        up = up_direction(scene)
        shapes = (run.positions[i] for i in content.sample(len(run), SIGHT_STATES))
        fit = CameraFit(scene, line_of_sight(scene, up, shapes, run.triangles), up, self._aspect)
        axes = Bounds.axes_of(up)
        normals = np.concatenate([fit.normals, axes, -axes])
        motion = (run.positions[i] for i in content.sample(len(run), MOTION_STATES))
        supports = np.array([(x @ normals.T).max(axis=0) for x in motion])
        n, whole = len(fit.normals), supports.max(axis=0)
        self._bounds = Bounds(axes, -whole[n + 3 :], whole[n : n + 3])
        support = fit.framed_support(supports[:, :n])
        if self._obstacles is None:
            self._find_obstacles()
        times = run.times[content.sample(len(run), MOTION_STATES)]
        near = near_obstacle_points(self._obstacles or (), self._bounds, times, fit.normals)
        support = np.maximum(support, (near @ fit.normals.T).max(axis=0, initial=-np.inf))
        arrows = self._show_wind()
        if len(arrows):
            support = np.maximum(support, (arrows @ fit.normals.T).max(axis=0))
        self.cloth.look_from(fit.view(support))

    def _draw_plots(self) -> None:
        history = read_history(self._run.folder)
        self._figures = {
            "energies": content.energies(history, self._unit),
            "iterations": content.iterations(history, self._unit),
        }

    def _mark_time(self) -> None:
        self._marked = clock.monotonic()
        time = float(self._run.times[self._player.shown])
        for name, figure in self._figures.items():
            self._state[name] = content.at_time(figure, time)

    # -- tasks -------------------------------------------------------------------------------------

    async def animate(self) -> None:
        """Show each state when it is due, but not faster than the page draws; runs forever."""
        player = self._player
        while True:
            player.changed.clear()
            if player.due() == self._shown and not player.changed.is_set():
                await _wait(player.changed, player.next_due())
                continue
            self._drawn.clear()
            with self._state:
                self._show()
            self._view.update()
            await self._wait_for_pages()

    async def _wait_for_pages(self) -> None:
        """Wait until a page has drawn the state; the page says so if that takes long."""
        if not self._access.n_open or await _wait(self._drawn, SLOW_DRAWING):
            return
        with self._state as state:
            state.waiting = "waiting for the browser to draw the state"
        await _wait(self._drawn, MAX_DRAWING)
        with self._state as state:
            state.waiting = ""

    async def follow(self) -> None:
        """Poll for new states of the run while a page is open; runs forever."""
        while True:
            # processor time: on a machine with busy ranks, the wall time is much longer
            began = clock.process_time()
            if self._access.n_open:
                self.refresh()
            pause = (clock.process_time() - began) / POLLING_SHARE
            await asyncio.sleep(min(max(MIN_POLL_SECONDS, pause), MAX_POLL_SECONDS))

    def refresh(self) -> None:
        """Show new states of the run."""
        with self._state as state:
            try:
                if self._player.follow():
                    self._last_news = clock.monotonic()
                    self._show_new_states()
                    state.last, state.notice = self._player.last, ""
                state.status = self._outcome()
            except LyraError as error:
                state.notice = str(error)

    def _show_new_states(self) -> None:
        """Use new states, or another run that has replaced this one."""
        if self._run.triangles is not self._triangles:
            self._triangles = self._run.triangles
            self.cloth.set_mesh(self._triangles)
            self._probe = None
            self._find_handles()
            self._obstacles = None
            self._offer_quantities()
            self.fit()
            self._redraw()
        elif self._palette:
            self._palette.update()
        self._draw_plots()
        self._mark_time()

    def show_end(self, text: str) -> None:
        """Show the text that the run has ended."""
        with self._state as state:
            state.farewell = text


async def _wait(event: asyncio.Event, seconds: float) -> bool:
    with suppress(asyncio.TimeoutError):
        await asyncio.wait_for(event.wait(), None if math.isinf(seconds) else seconds)
        return True
    return False


def _pixel(event: Any, name: str) -> tuple[float, float] | None:
    """Pixel coordinates of an event of the page, or None if it has none."""
    try:
        at = event[name]
        x, y = (at["x"], at["y"]) if isinstance(at, dict) else at[:2]
        return float(x), float(y)
    except (TypeError, KeyError, IndexError, ValueError):
        return None


def release_old_arrays(context: Any, *_: Any) -> None:
    """Release the oldest sent arrays beyond `ARRAY_BYTES`.

    trame would release all arrays after 20 s. On a busy machine, pages fetch them later and would stay empty.
    """
    kept, now = 0, clock.time()
    for name, record in sorted(context.data_array_cache.items(), key=lambda item: -item[1]["ts"]):
        array = record["array"]
        kept += 1024 * array.GetActualMemorySize()
        if kept > ARRAY_BYTES and array.GetReferenceCount() == 1 and now - record["ts"] > ARRAY_SECONDS:
            del context.data_array_cache[name]


def _build_layout(page: Page) -> Any:
    """Create the page's elements and bind them to its variables; returns trame's view of the cloth."""
    with VAppLayout(page.server):
        client.Style(STYLE.read_text(encoding="utf-8"))
        client.Script(SCRIPT.read_text(encoding="utf-8"))
        with html.Div(classes="page"):
            _top(page)
            with html.Div(classes="cloth", id="cloth"):
                _colours()
                with html.Div(classes="picture"):
                    client.SizeObserver("size", style="position: absolute; inset: 0; z-index: -1")
                    view = vtk.VtkLocalView(
                        page.cloth.window,
                        ref="cloth",
                        after_scene_loaded=(page.drawn, "[]"),
                        picking_modes=("['click']",),
                        click=(page.pick, "[$event]"),
                        interactor_events=("['LeftButtonPress']",),
                        LeftButtonPress=(page.press, "[utils.vtk.event($event)]"),
                        on_image_capture="utils.download(title + '.png', $event, 'image/png')",
                    )
                with html.Div(v_if="picked.length", classes="picked", id="picked"):
                    html.Div("{{ line.name }}: {{ line.value }}", v_for="(line, i) in picked", key="i")
                html.Div("{{ waiting }}", v_if="waiting", classes="waiting", id="waiting")
                html.Div("{{ notice || farewell }}", v_if="notice || farewell", classes="notice", id="notice")
            with html.Div(classes="plots"):
                for name in ("energies", "iterations"):
                    with html.Div(classes="plot", id=name):
                        plotly.Figure(
                            state_variable_name=name,
                            display_mode_bar=False,
                            display_logo=("false",),
                            responsive=True,
                            style="position: absolute; inset: 0",
                        )
            _bottom(page)
    return view


def _top(page: Page) -> None:
    with html.Div(classes="bar"):
        html.H1("{{ title }}", id="title")
        html.Div("{{ status }}", classes="status", id="status", title=("status",))
        _choice("quantity", "quantities", "colour", "choice")
        _choice("speed", "speeds", "speed", "pace")
        _button("mdi-grid", "edges", "show the triangles", click="edges = !edges")
        _button("mdi-pin-outline", "around", "show handles and wind", click="around = !around")
        _button("mdi-camera", "shot", "save the picture", click="trame.refs.cloth.captureImage()")
        _button("mdi-fit-to-screen-outline", "fit", "show the whole motion", click=page.fit)


def _bottom(page: Page) -> None:
    with html.Div(classes="time"):
        _button("mdi-skip-previous", "first", "first state", click="frame = 0")
        _button("mdi-chevron-left", "back", "state before", click="frame = Math.max(frame - 1, 0)")
        _button(("playing ? 'mdi-pause' : 'mdi-play'",), "play", "play or pause", click=page.play_or_pause)
        _button("mdi-chevron-right", "next", "next state", click="frame = Math.min(frame + 1, last)")
        _button("mdi-skip-next", "last", "newest state", click="frame = last")
        v.VSlider(
            v_model=("frame",),
            min=0,
            max=("Math.max(last, 1)",),
            step=1,
            disabled=("last < 1",),
            id="frame",
            **COMPACT,
            style="flex: 1 1 200px; min-width: 120px",
        )
        html.Div("{{ clock }}", classes="clock", id="clock")


def _choice(name: str, items: str, label: str, classes: str) -> None:
    v.VSelect(
        v_model=(name,),
        items=(items,),
        label=label,
        id=name,
        classes=classes,
        variant="outlined",
        **COMPACT,
    )


def _button(icon: Any, name: str, hint: str, *, click: Any) -> None:
    v.VBtn(icon=icon, id=name, title=hint, click=click, variant="text", density="comfortable", size="default")


def _colours() -> None:
    with html.Div(v_if="bar", classes="colours", id="colours"):
        html.Div("{{ bar.title }}")
        with html.Div(classes="scale"):
            html.Div(classes="shades", style=("{ '--shades': bar.shades }",))
            with html.Div(classes="ticks"):
                html.Div("{{ tick }}", v_for="(tick, i) in bar.ticks", key="i")
        v.VTextField(
            v_model=("range",),
            label="range",
            placeholder="0,5 or 2%,98%",
            id="range",
            title=("range_error || 'two values, or percentiles of the whole run; empty: automatic'",),
            error=("!!range_error",),
            classes="setting",
            variant="outlined",
            **COMPACT,
        )
        _choice("map", "maps", "map", "setting")
