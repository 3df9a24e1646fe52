"""The page: its layout, the state that it shows, and what the controls do."""

from __future__ import annotations

import asyncio
import math
import time as clock
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from trame.app import get_server
from trame.ui.vuetify3 import VAppLayout
from trame.widgets import client, html, plotly, vtk
from trame.widgets import vuetify3 as v

from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.output.read_run import Run, read_history
from lyra_petsc.output.run_folder import in_use
from lyra_petsc.show.render.camera import Fit, line_of_sight, upwards
from lyra_petsc.show.view import page_content as content
from lyra_petsc.show.view.access import Access
from lyra_petsc.show.view.cloth import Cloth

STYLE = Path(__file__).with_name("style.css")

LONGEST_DRAWING = 2.0
"""Seconds after which the next state is sent although no page has reported that it drew the last one."""

POLLING_SHARE = 0.02
"""Share of its time that this process spends looking for new states."""
POLL_SECONDS = 0.5
"""Least time between two such looks."""

MARK_SECONDS = 0.25
"""Seconds between two moves of the plots' time marks while it plays."""

PLAIN = "none"
"""Choice of a quantity: the cloth in one colour."""

MOTION_STATES = 24
"""States to which the camera is fitted."""
SIGHT_STATES = 6
"""States from which its direction is chosen."""
FIRST_ASPECT = 1.6
"""Width of the picture over its height until the page reports its size."""


class Page:
    """The page; all browsers that have it open see the same.

    Parameters
    ----------
    run : Run
    access : Access
        Counts the open pages.

    Attributes
    ----------
    server : trame's server
    cloth : Cloth
    """

    def __init__(self, run: Run, access: Access) -> None:
        self._run, self._access = run, access
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
        self._unit = "" if run.scene.time.analysis == "static" else "s"
        self._figures: dict[str, dict[str, Any]] = {}
        self._fill()
        self._look_at_all()
        self._view = _lay_out(self)
        state.change("frame")(self._frame_changed)
        state.change("quantity")(self._quantity_changed)
        state.change("speed")(self._speed_changed)
        state.change("edges")(self._edges_changed)
        state.change("size")(self._size_changed)

    def _fill(self) -> None:
        """Set the page's variables for the first time."""
        run, state, player = self._run, self._state, self._player
        state.trame__title = f"{run.name} – lyra_petsc"
        state.title = run.scene.title or run.name
        state.status, state.notice, state.farewell = self._outcome(), "", ""
        state.frame, state.last = player.shown, player.last
        state.playing, state.edges = False, False
        state.clock, state.bar = "", None
        state.quantity = "speed"
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
        """List the quantities of this run; the chosen one is kept if it is among them."""
        known, state = content.names(self._run), self._state
        state.quantities = [{"title": name.replace("_", " "), "value": name} for name in (PLAIN, *known)]
        if state.quantity not in known:
            state.quantity = PLAIN
        self._choose(state.quantity)

    def _outcome(self) -> str:
        summary = self._run.summary
        outcome, ranks = str(summary.get("outcome", "")), summary.get("ranks", 0)
        if outcome == "running" and not in_use(self._run.folder):
            outcome = "broken off"
        words = [f"{len(self._run.rest):,} vertices", f"{len(self._run)} states"]
        if ranks:
            words.append(f"{ranks} rank{'s' * (ranks != 1)}")
        return " · ".join([*words, outcome] if outcome else words)

    # -- controls ----------------------------------------------------------------------------------

    def play_or_pause(self) -> None:
        """The play button."""
        if self._player.playing:
            self._player.pause()
        else:
            self._player.play()
        self._state.playing = self._player.playing

    def fit(self) -> None:
        """Move the camera back to where it sees the whole motion."""
        self._look_at_all()
        self._view.push_camera()

    def drawn(self) -> None:
        """Called when a page has drawn the last state that it was sent."""
        self._drawn.set()

    def _frame_changed(self, frame: Any, **_: Any) -> None:
        if isinstance(frame, int | float) and math.isfinite(frame) and int(frame) != self._player.shown:
            self._player.go(int(frame))

    def _speed_changed(self, speed: Any, **_: Any) -> None:
        if isinstance(speed, int | float) and 0 < speed < math.inf:
            self._player.set_speed(float(speed))

    def _quantity_changed(self, quantity: Any, **_: Any) -> None:
        self._choose(quantity)
        self._again()

    def _edges_changed(self, edges: Any, **_: Any) -> None:
        self.cloth.show_edges(bool(edges))
        self._again()

    def _again(self) -> None:
        """Send the same state once more."""
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

    def _choose(self, name: Any) -> None:
        try:
            self._palette = content.Palette(self._run, name) if name in content.names(self._run) else None
        except LyraError as error:
            self._palette = None
            self._state.notice = str(error)

    # -- state shown -------------------------------------------------------------------------------

    def _show(self) -> None:
        """Show the state that is due, in the scene and in the texts."""
        run, state = self._run, self._state
        index = self._shown = self._player.due()
        try:
            positions = run.positions[index]
            if len(positions) != len(run.rest):  # `look` will notice
                raise InputError("was replaced by another run", file=run.folder)
            colours, on_triangles = self._palette.colours(index) if self._palette else (None, False)
            state.notice = ""
        except LyraError as error:
            state.notice = str(error)
        else:
            self.cloth.show(positions, colours, on_triangles=on_triangles)
        state.bar = self._palette.bar() if self._palette else None
        state.frame, state.playing = index, self._player.playing
        name, end = ("t", f" of {run.times[-1]:.4g} {self._unit}") if self._unit else ("load", "")
        state.clock = f"{name} = {run.times[index]:.4g}{end}"
        if not self._player.playing or clock.monotonic() - self._marked > MARK_SECONDS:
            self._mark()

    def _look_at_all(self) -> None:
        """Move the camera to where `render` would put it."""
        run = self._run
        up = upwards(run.scene)
        shapes = (run.positions[i] for i in content.sample(len(run), SIGHT_STATES))
        fit = Fit(run.scene, line_of_sight(run.scene, up, shapes, run.triangles), up, self._aspect)
        motion = (run.positions[i] for i in content.sample(len(run), MOTION_STATES))
        self.cloth.look_from(fit.view(np.max([(x @ fit.normals.T).max(axis=0) for x in motion], axis=0)))

    def _draw_plots(self) -> None:
        history = read_history(self._run.folder)
        self._figures = {
            "energies": content.energies(history, self._unit),
            "iterations": content.iterations(history, self._unit),
        }

    def _mark(self) -> None:
        self._marked = clock.monotonic()
        time = float(self._run.times[self._player.shown])
        for name, figure in self._figures.items():
            self._state[name] = content.at_time(figure, time)

    # -- tasks -------------------------------------------------------------------------------------

    async def animate(self) -> None:
        """Show each state when it is due, never faster than the page draws; does not end."""
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
            await _wait(self._drawn, LONGEST_DRAWING if self._access.watching else 0.0)

    async def follow(self) -> None:
        """Look for new states of the run while a page is open; does not end."""
        while True:
            began = clock.monotonic()
            if self._access.watching:
                self.look()
            await asyncio.sleep(max(POLL_SECONDS, (clock.monotonic() - began) / POLLING_SHARE))

    def look(self) -> None:
        """Show what the run has written meanwhile."""
        with self._state as state:
            try:
                if self._player.follow():
                    self._renew()
                    state.last, state.notice = self._player.last, ""
                state.status = self._outcome()
            except LyraError as error:
                state.notice = str(error)

    def _renew(self) -> None:
        """Take in new states, or another run that has replaced this one."""
        if self._run.triangles is not self._triangles:
            self._triangles = self._run.triangles
            self.cloth.set_mesh(self._triangles)
            self._offer_quantities()
            self.fit()
            self._again()
        elif self._palette:
            self._palette.renew()
        self._draw_plots()
        self._mark()

    def say_goodbye(self, words: str) -> None:
        """Show that the run has ended."""
        with self._state as state:
            state.farewell = words


async def _wait(event: asyncio.Event, seconds: float) -> None:
    with suppress(asyncio.TimeoutError):
        await asyncio.wait_for(event.wait(), None if math.isinf(seconds) else seconds)


def _lay_out(page: Page) -> Any:
    """Create the page's elements and bind them to its variables; returns trame's view of the cloth."""
    with VAppLayout(page.server):
        client.Style(STYLE.read_text(encoding="utf-8"))
        with html.Div(classes="page"):
            _top(page)
            with html.Div(classes="cloth", id="cloth"):
                _colours()
                with html.Div(classes="picture"):
                    client.SizeObserver("size", style="position: absolute; inset: 0; z-index: -1")
                    view = vtk.VtkLocalView(
                        page.cloth.window, ref="cloth", after_scene_loaded=(page.drawn, "[]")
                    )
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
        _button("mdi-fit-to-screen-outline", "fit", "show the whole motion", click=page.fit)


def _bottom(page: Page) -> None:
    with html.Div(classes="time"):
        _button("mdi-skip-previous", "first", "first state", click="frame = 0")
        _button(("playing ? 'mdi-pause' : 'mdi-play'",), "play", "play or pause", click=page.play_or_pause)
        _button("mdi-skip-next", "last", "newest state", click="frame = last")
        v.VSlider(
            v_model=("frame",),
            min=0,
            max=("Math.max(last, 1)",),
            step=1,
            disabled=("last < 1",),
            id="frame",
            hide_details=True,
            density="compact",
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
        density="compact",
        hide_details=True,
        variant="outlined",
    )


def _button(icon: Any, name: str, says: str, *, click: Any) -> None:
    v.VBtn(icon=icon, id=name, title=says, click=click, variant="text", density="comfortable", size="default")


def _colours() -> None:
    with html.Div(v_if="bar", classes="colours", id="colours"):
        html.Div("{{ bar.title }}")
        with html.Div(classes="scale"):
            html.Div(classes="shades", style=("{ '--shades': bar.shades }",))
            with html.Div(classes="ticks"):
                html.Div("{{ tick }}", v_for="(tick, i) in bar.ticks", key="i")
