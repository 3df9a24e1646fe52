"""What the page looks like: where its parts stand and what they are bound to."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from trame.ui.vuetify3 import VAppLayout
from trame.widgets import client, html, plotly, vtk
from trame.widgets import vuetify3 as v

if TYPE_CHECKING:
    from lyra_petsc.view.page import Page

STYLE = Path(__file__).with_name("style.css")


def build(page: Page) -> Any:
    """Lay out the page; returns trame's view of the cloth."""
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
