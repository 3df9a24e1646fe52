"""The page: what of the run is shown, and what the user's clicks change."""

from __future__ import annotations

import asyncio
import math
import time as clock
from contextlib import suppress
from typing import Any

import numpy as np
from trame.app import get_server

from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.output.lock import in_use
from lyra_petsc.render.camera import Fit, line_of_sight, upwards
from lyra_petsc.results.run import Run
from lyra_petsc.results.tables import read_table
from lyra_petsc.view import plots
from lyra_petsc.view.access import Access
from lyra_petsc.view.cloth import Cloth
from lyra_petsc.view.layout import build
from lyra_petsc.view.palette import Palette, names, sample
from lyra_petsc.view.player import PACES, Player

LONGEST_DRAWING = 2.0
"""Seconds that the page is given to draw a state before the next is sent."""

LOOKING_SHARE = 0.02
"""Share of its time that this process spends on looking for new states."""

LOOK_AT_LEAST = 0.5
"""Seconds between two looks."""

MARK_SECONDS = 0.25
"""Seconds between two moves of the plots' time marks while it plays."""

PLAIN = "none"
"""Of the colours: the cloth's own."""

MOTION_SAMPLES = 24
"""States that the camera is fitted to."""

SIGHT_SAMPLES = 6
"""States that its direction is chosen by."""

FIRST_ASPECT = 1.6
"""Width of the picture over its height, until the page says."""


class Page:
    """One page, the same for all who have it open.

    Parameters
    ----------
    run : Run
    access : Access
        Knows whether anyone looks.

    Attributes
    ----------
    server : trame's server
    cloth : Cloth
    """

    def __init__(self, run: Run, access: Access) -> None:
        self._run, self._access = run, access
        self.server = get_server("lyra-petsc")
        self._state = self.server.state
        self._triangles = run.triangles
        self.cloth = Cloth(self._triangles, len(run.rest))
        self._player = Player(run)
        self._palette: Palette | None = None
        self._aspect = FIRST_ASPECT
        self._fitted = False
        self._drawn = asyncio.Event()
        self._shown = -1
        self._marked = 0.0
        self._unit = "" if run.scene.time.analysis == "static" else "s"
        self._figures: dict[str, dict[str, Any]] = {}
        self._fill()
        self._look_at_all()
        self._view = build(self)
        self._state.change("frame")(self._frame_changed)
        self._state.change("quantity")(self._quantity_changed)
        self._state.change("speed")(self._speed_changed)
        self._state.change("edges")(self._edges_changed)
        self._state.change("size")(self._size_changed)

    def _fill(self) -> None:
        """The page's variables, before anyone looks."""
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
            {"title": f"{pace * player.speed:g} {unit}", "value": pace * player.speed} for pace in PACES
        ]
        state.speed = player.speed
        self._offer_quantities()
        self._draw_plots()
        self._show()

    def _offer_quantities(self) -> None:
        """What this run can be coloured by, and the palette of what is chosen."""
        known, state = names(self._run), self._state
        state.quantities = [{"title": name.replace("_", " "), "value": name} for name in (PLAIN, *known)]
        if state.quantity not in known:
            state.quantity = PLAIN
        self._choose(state.quantity)

    def _outcome(self) -> str:
        summary = self._run.summary
        outcome = str(summary.get("outcome", ""))
        if outcome == "running" and not in_use(self._run.folder):
            outcome = "broken off"
        ranks = summary.get("ranks", 0)
        words = [f"{len(self._run.rest):,} vertices", f"{len(self._run)} states"]
        if ranks:
            words.append(f"{ranks} rank{'s' * (ranks != 1)}")
        return " · ".join([*words, outcome] if outcome else words)

    # -- what the user does ------------------------------------------------------------------------

    def play_or_pause(self) -> None:
        """The play button."""
        if self._player.playing:
            self._player.pause()
        else:
            self._player.play()
        self._state.playing = self._player.playing

    def fit(self) -> None:
        """The camera back to where it sees the whole motion."""
        self._look_at_all()
        self._view.push_camera()

    def drawn(self) -> None:
        """A page has drawn the last state."""
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
        """Show the same state anew."""
        self._shown = -1
        self._player.changed.set()

    def _size_changed(self, size: Any, **_: Any) -> None:
        """The page says how large its picture is; the first one has the camera fitted to it."""
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
            self._palette = Palette(self._run, name) if name in names(self._run) else None
        except LyraError as error:
            self._palette = None
            self._state.notice = str(error)

    # -- what is shown -----------------------------------------------------------------------------

    def _show(self) -> None:
        """Put the state that is due into the scene and the texts."""
        run, state = self._run, self._state
        index = self._shown = self._player.due()
        try:
            positions = run.positions[index]
            if len(positions) != len(run.rest):  # `look` will find out
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
        shapes = (run.positions[i] for i in sample(len(run), SIGHT_SAMPLES))
        fit = Fit(run.scene, line_of_sight(run.scene, up, shapes, run.triangles), up, self._aspect)
        motion = (run.positions[i] for i in sample(len(run), MOTION_SAMPLES))
        self.cloth.look_from(fit.view(np.max([(x @ fit.normals.T).max(axis=0) for x in motion], axis=0)))

    def _draw_plots(self) -> None:
        history = read_table(self._run.folder / "history.csv")
        self._figures = {
            "energies": plots.energies(history, self._unit),
            "iterations": plots.iterations(history, self._unit),
        }

    def _mark(self) -> None:
        self._marked = clock.monotonic()
        time = float(self._run.times[self._player.shown])
        for name, figure in self._figures.items():
            self._state[name] = plots.at_time(figure, time)

    # -- as time goes by ---------------------------------------------------------------------------

    async def animate(self) -> None:
        """Show what is due, never faster than the page draws; runs for ever."""
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
        """See the new states of a run that goes on, while anyone looks; runs for ever."""
        while True:
            began = clock.monotonic()
            if self._access.watching:
                self.look()
            await asyncio.sleep(max(LOOK_AT_LEAST, (clock.monotonic() - began) / LOOKING_SHARE))

    def look(self) -> None:
        """See what the run has written meanwhile."""
        with self._state as state:
            try:
                if self._player.follow():
                    self._renew()
                    state.last, state.notice = self._player.last, ""
                state.status = self._outcome()
            except LyraError as error:
                state.notice = str(error)

    def _renew(self) -> None:
        """Take in what is new in the run, or that it is another one."""
        if self._run.triangles is not self._triangles:
            self._triangles = self._run.triangles
            self.cloth.set_mesh(self._triangles, len(self._run.rest))
            self._offer_quantities()
            self.fit()
            self._again()
        elif self._palette:
            self._palette.renew()
        self._draw_plots()
        self._mark()

    def say_goodbye(self, words: str) -> None:
        """Tell those who look that the run has ended."""
        with self._state as state:
            state.farewell = words


async def _wait(event: asyncio.Event, seconds: float) -> None:
    with suppress(asyncio.TimeoutError):
        await asyncio.wait_for(event.wait(), None if math.isinf(seconds) else seconds)
