"""The page: PyVista's drawing of one state in trame's viewer, and the controls of time and field."""

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
from trame.widgets import client, html
from trame.widgets import vuetify3 as v
from trame_pyvista.ui import plotter_ui
from vtkmodules.vtkRenderingCore import vtkCellPicker

from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.parallel import ALONE
from lyra_petsc.scene.time_curve import acts
from lyra_petsc.show.render.colour_quantities import quantity, quantity_names
from lyra_petsc.show.render.draw import fitted_drawing
from lyra_petsc.show.render.render_plan import FEW_STATES, RenderOptions, make_plan, spread_states

POLL_SECONDS = 0.5
"""Interval [s] at which the page looks for new states."""

FRAME_SECONDS = 0.04
"""Interval [s] at which a playing page looks for the state that is due."""

PLAY_SECONDS = 0.5, 60.0
"""Motions of a duration between these bounds [s] are played in real time, others in about ten seconds."""

CLICK_PIXELS = 4
"""Movement of the mouse [pixels] up to which pressing and releasing its button is a click."""

MARK = "#e6007e"
PLAIN = "none"
"""Choice of the fields: sheets have colours of their own."""


class RunPage:
    """The page of a run; all browsers that have it open show the same.

    Parameters
    ----------
    folder : Path
        The run's folder.
    field : str, optional
        The field that colours the sheets; by default speed or displacement.
    range : str, optional
        Range of its colours, as of ``render --range``.
    settings : sequence of str
        Changes of the scene's camera, as of ``render --set``.

    Attributes
    ----------
    server : trame's server

    Raises
    ------
    InputError
        If the run cannot be shown in this way.
    """

    def __init__(
        self, folder: Path, field: str | None = None, range: str | None = None, settings: tuple[str, ...] = ()
    ) -> None:
        run = StoredRun(folder)
        self._first_field = field or ("speed" if "velocity" in run.fields else "displacement")
        wind = run.scene.wind
        options = RenderOptions(
            folder,
            at=repr(float(run.times[-1])),
            field=self._first_field,
            range=range,
            handles=bool(run.scene.handles),
            wind=wind is not None and acts(wind.velocity),
            ground=False,
            settings=settings,
            fitted_states=FEW_STATES,
        )
        self._plan = make_plan(options)
        self._run = self._plan.run
        self._drawing = fitted_drawing(ALONE, self._plan)
        self._plotter, self._triangles = self._drawing.plotter, self._run.triangles
        self._speed = playing_speed(self._run)
        self._playing = asyncio.Event()
        self._coloured_states = len(self._run)
        self._pressed: tuple[int, int] | None = None
        self._picked, self._farewell = -1, ""
        look = {"color": MARK, "point_size": 12.0, "render_points_as_spheres": True}
        self._mark = self._plotter.add_points(np.zeros((1, 3)), reset_camera=False, **look)
        self._mark.visibility = False
        self.server = get_server("lyra-petsc", client_type="vue3")
        self._state = state = self.server.state
        state.trame__title = f"{self._run.name} – lyra_petsc"
        state.title = self._run.scene.title or self._run.name
        state.fields = [PLAIN, *quantity_names(self._run)]
        state.field, state.status, state.picked, state.notice = self._first_field, self._status(), "", ""
        state.playing, state.last = False, len(self._run) - 1
        state.frame = 0 if self._run.finished else state.last
        self._view = self._build_layout()
        state.change("frame")(self._show)
        state.change("field")(self._colour)
        state.change("playing")(self._play_or_pause)
        interactor = self._plotter.render_window.GetInteractor()
        interactor.AddObserver("LeftButtonPressEvent", self._press)
        # while a button is held VTK's interaction takes all other events, such as its release
        interactor.AddObserver("EndInteractionEvent", self._pick)
        self._show()

    def _status(self) -> str:
        run = self._run
        return f"{len(run.rest):,} vertices · {len(run)} states · {run.outcome}"

    # -- what is shown -------------------------------------------------------------------------------

    def _show(self, **_: Any) -> None:
        """Show the state whose number the page has."""
        state = self._state
        try:
            self._drawing.show(self._frame)
            self._show_picked()
            state.notice = self._farewell
        except LyraError as error:
            state.notice = str(error)
        self._view.update()

    @property
    def _frame(self) -> int:
        """Number of the state; a page may send any value."""
        frame = self._state.frame
        return min(max(int(frame), 0), self._state.last) if isinstance(frame, int) else 0

    def _colour(self, **_: Any) -> None:
        """Colour the sheets by the field that the page has, in a range fitted to the states so far."""
        name, plan = self._state.field, self._plan
        if name not in self._state.fields:
            return
        self._coloured_states = len(self._run)
        shown, limits = None, (0.0, 1.0)
        if name != PLAIN:
            shown = quantity(self._run, name).on_vertices(self._run)
            states = spread_states(self._run.times, FEW_STATES)
            chosen = plan.limits if name == self._first_field else None
            limits = shown.limits(np.array([shown.percentiles(i) for i in states]), chosen)
        self._drawing.colour_by(shown, limits)
        self._show()

    def _show_picked(self) -> None:
        """Mark the picked vertex, and show its number, position and the value of the field."""
        self._mark.visibility = self._picked >= 0
        if self._picked < 0:
            self._state.picked = ""
            return
        x = self._run.positions[self._frame][self._picked]
        self._mark.mapper.dataset.points = x[None]
        text = f"vertex {self._picked}: ({x[0]:.5g}, {x[1]:.5g}, {x[2]:.5g}) m"
        if self._state.field != PLAIN:
            shown = quantity(self._run, self._state.field).on_vertices(self._run)
            if not shown.on_triangles:
                text += f", {shown.label}: {shown.values(self._frame)[self._picked]:.5g}"
        self._state.picked = text

    def _press(self, interactor: Any, _: str) -> None:
        self._pressed = interactor.GetEventPosition()

    def _pick(self, interactor: Any, _: str) -> None:
        """Pick the vertex nearest to a click on a sheet; a click beside the sheets picks none."""
        at, pressed, self._pressed = interactor.GetEventPosition(), self._pressed, None
        if pressed is None or math.dist(at, pressed) > CLICK_PIXELS:
            return  # the camera was moved
        picker = vtkCellPicker()
        picker.SetTolerance(0.0)
        picker.Pick(at[0], at[1], 0.0, self._plotter.renderer)
        self._picked = -1
        if picker.GetActor() is not None:
            distances = np.linalg.norm(self._run.positions[self._frame] - picker.GetPickPosition(), axis=1)
            self._picked = int(distances.argmin())
        with self._state:
            self._show()

    # -- tasks ---------------------------------------------------------------------------------------

    def _play_or_pause(self, playing: Any, **_: Any) -> None:
        if not playing:
            self._playing.clear()
            return
        if self._frame == self._state.last:
            self._state.frame = 0
        self._playing.set()

    async def play(self) -> None:
        """Show the states when they are due while the page plays; runs forever."""
        while True:
            if not self._playing.is_set():
                await self._playing.wait()
                before, due = clock.monotonic(), self._frame
                time = float(self._run.times[due])
            await asyncio.sleep(FRAME_SECONDS)
            now = clock.monotonic()
            if self._frame != due:  # the user has moved the slider
                time = float(self._run.times[self._frame])
            time, before = time + self._speed * (now - before), now
            due = int(self._run.times.searchsorted(time, side="right")) - 1
            with self._state as state:
                state.frame = due
                state.playing = bool(state.playing) and due < state.last

    async def follow(self) -> None:
        """Show new states of the run soon after they are written; runs forever."""
        while True:
            await asyncio.sleep(POLL_SECONDS)
            with self._state as state:
                try:
                    self._refresh()
                except LyraError as error:
                    state.notice = str(error)

    def _refresh(self) -> None:
        state, run = self._state, self._run
        newest = self._frame == state.last and not state.playing
        if run.refresh():
            if not np.array_equal(run.triangles, self._triangles):
                raise InputError("holds another run now; start view again", file=run.folder)
            state.last = len(run) - 1
            if len(run) >= 2 * self._coloured_states:
                self._colour()
            if newest:
                state.frame = state.last
        state.status = self._status()

    def show_end(self, text: str) -> None:
        """Show the newest state, and a text which says that the run has ended."""
        with self._state as state:
            with suppress(LyraError):
                self._refresh()
            state.notice = self._farewell = text

    # -- layout --------------------------------------------------------------------------------------

    def _build_layout(self) -> Any:
        """Create the page's elements; returns PyVista's view."""
        row = "display: flex; gap: 12px; align-items: center; padding: 6px 12px"
        compact = {"density": "compact", "hide_details": True}
        over = "position: absolute; right: 8px; padding: 2px 8px; background: #fffd"
        with (
            VAppLayout(self.server),
            html.Div(style="display: flex; flex-direction: column; position: fixed; inset: 0"),
        ):
            client.Style("html { overflow: hidden }")
            with html.Div(style=row):
                html.B("{{ title }}", id="title")
                html.Span("{{ status }}", id="status", style="flex: 1")
                v.VSelect(
                    v_model=("field",), items=("fields",), id="field", style="max-width: 260px", **compact
                )
            with html.Div(id="picture", style="position: relative; flex: 1; min-height: 0"):
                # PyVista's viewer ends parallel projection first, by which the camera returns to its place
                self._plotter.enable_parallel_projection()
                view = plotter_ui(self._plotter, mode="server", server=self.server)
                html.Div("{{ picked }}", v_if="picked", id="picked", style=f"{over}; top: 8px")
                html.Div("{{ notice }}", v_if="notice", id="notice", style=f"{over}; top: 48px")
            with html.Div(style=row):
                icon = ("playing ? 'mdi-pause' : 'mdi-play'",)
                v.VBtn(icon=icon, id="play", click="playing = !playing", variant="text")
                v.VSlider(v_model=("frame",), min=0, max=("last",), step=1, id="frame", **compact)
                html.Span("{{ frame }} of {{ last }}", id="state")
        return view


def playing_speed(run: StoredRun) -> float:
    """Simulated seconds per second: real time, or the power of ten that takes about ten seconds."""
    span = float(run.times[-1] - run.times[0])
    shortest, longest = PLAY_SECONDS
    return 1.0 if span <= 0.0 or shortest <= span <= longest else 10.0 ** (round(math.log10(span)) - 1)
