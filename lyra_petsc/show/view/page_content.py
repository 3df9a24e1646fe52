"""What the page shows of a run: which state when, the colours of a quantity, plots of the history.

Plain data; no package of the page itself is needed.
"""

from __future__ import annotations

import asyncio
import math
import time as clock
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.show.render.colour_quantities import DERIVED, ColourQuantity, ColourRange, quantity

Colours = NDArray[np.uint8]
Columns = Mapping[str, NDArray[Any]]

SHORTEST, LONGEST = 0.5, 60.0
"""Motions of such lengths [s] are played in real time at first; all others in about `USUAL`."""
USUAL = 10.0
"""[s]"""
SPEED_FACTORS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Speeds to choose from, relative to the first one."""

RANGE_STATES = 12
"""States from which the range of the colours is taken at first."""

MAPS = ("viridis", "cividis", "plasma", "turbo", "coolwarm", "gray")
"""Colour maps of matplotlib to choose from."""

MOST_POINTS = 600
"""Points of a plotted line; of a longer history evenly spaced rows are drawn."""
LINE_COLOURS = {
    "kinetic": "#0072b2",
    "membrane": "#d55e00",
    "bending": "#009e73",
    "potential": "#cc79a7",
    "total": "#222222",
}


class Player:
    """Decides which state is shown: playing, moving the slider, following a run that goes on.

    Parameters
    ----------
    run : StoredRun

    Attributes
    ----------
    shown : int
        Number of the state that the page should show.
    speed : float
        Simulated seconds in a second.
    playing : bool
    changed : asyncio.Event
        Set when another state is wanted.
    """

    def __init__(self, run: StoredRun) -> None:
        self._run = run
        self.shown = 0 if run.finished else len(run) - 1
        self.speed = first_speed(run)
        self.playing = False
        self.changed = asyncio.Event()
        self._begun, self._from = 0.0, 0.0

    @property
    def last(self) -> int:
        """Number of the newest state."""
        return len(self._run) - 1

    def play(self) -> None:
        """Play from the state shown, or from the first one if that is the last."""
        if self.shown >= self.last:
            self.shown = 0
        self.playing = self.shown < self.last  # a single state does not play
        self._restart()

    def pause(self) -> None:
        """Stay at the state shown."""
        self.playing = False

    def go(self, state: int) -> None:
        """Show a state; playing continues from there."""
        self.shown = min(max(state, 0), self.last)
        self._restart()

    def set_speed(self, speed: float) -> None:
        """Change the speed from now on."""
        self.speed = speed
        self._restart()

    def _restart(self) -> None:
        self._begun, self._from = clock.monotonic(), float(self._run.times[self.shown])
        self.changed.set()

    def due(self) -> int:
        """Number of the state to show now; playing stops at the last one."""
        if self.playing:
            due = int(self._run.times.searchsorted(self._now(), side="right")) - 1
            self.shown = max(due, self.shown, 0)
            if self.shown >= self.last:
                self.playing = False
        return self.shown

    def next_due(self) -> float:
        """Seconds until another state is due; infinite while it does not play."""
        if not self.playing or self.shown >= self.last:
            return math.inf
        return max(0.0, (float(self._run.times[self.shown + 1]) - self._now()) / self.speed)

    def _now(self) -> float:
        """Simulated time [s] that playing has reached."""
        return self._from + self.speed * (clock.monotonic() - self._begun)

    def follow(self) -> bool:
        """Look for new states of the run; whether there are any.

        If the newest state was shown, the new newest one is shown next.

        Raises
        ------
        InputError
            If the results are gone.
        """
        newest = self.shown >= self.last and not self.playing
        if not self._run.refresh():
            return False
        self.shown = self.last if newest else min(self.shown, self.last)
        self.changed.set()
        return True


def first_speed(run: StoredRun) -> float:
    """Real time for motions that are neither short nor long, else the power of ten that takes about 10 s."""
    span = float(run.times[-1] - run.times[0])
    if span <= 0 or SHORTEST <= span <= LONGEST:
        return 1.0
    return float(10.0 ** round(math.log10(span / USUAL)))


def names(run: StoredRun) -> list[str]:
    """Names of the quantities by which a run's states can be coloured."""
    derived = [name for name in DERIVED if name != "speed" or "velocity" in run.fields]
    return derived + [name for name in run.fields if name not in {"velocity", *derived}]


class Probe:
    """The values of all quantities at a vertex.

    Parameters
    ----------
    run : StoredRun
    vertex : int
        Its number in the mesh file, from 0.
    """

    def __init__(self, run: StoredRun, vertex: int) -> None:
        self._run, self.vertex = run, vertex
        self._quantities = {name: quantity(run, name).on_vertices(run) for name in names(run)}

    def values(self, state: int, place: Array, only: str = "") -> list[dict[str, str]]:
        """Names and values with units in a state; ``place`` (3,) [m]; of one quantity alone if ``only``."""
        numbers = ", ".join(f"{x:.5g}" for x in place)
        found = [{"name": f"vertex {self.vertex}", "value": f"({numbers}) m"}]
        for name, shown in self._quantities.items():
            if only in ("", name) and not shown.on_triangles:
                found.append({"name": shown.label, "value": f"{float(shown.values(state)[self.vertex]):.5g}"})
        return found


class Palette:
    """Colours of a quantity's values and the bar that explains them; zero is in the middle of signed values.

    Parameters
    ----------
    run : StoredRun
    name : str
        One of `names`.
    asked : ColourRange, optional
        The range of the colours.
    colour_map : str
        One of ``MAPS``; empty: what suits the quantity.
    cells : bool
        Each triangle has the colour of its own value; else vertices have means.

    Raises
    ------
    InputError
        If a state cannot be read.
    """

    def __init__(
        self,
        run: StoredRun,
        name: str,
        asked: ColourRange | None = None,
        colour_map: str = "",
        *,
        cells: bool = False,
    ) -> None:
        from matplotlib import colormaps

        self._run, self._name, self._asked, self._cells = run, name, asked, cells
        self._quantity = self._found()
        table = colormaps[colour_map or ("coolwarm" if self._quantity.signed else MAPS[0])]
        self._table: Colours = table(np.linspace(0, 1, 256), bytes=True)[:, :3]
        self._percentiles = [self._quantity.percentiles(i) for i in sample(len(run), RANGE_STATES)]
        self._low, self._high = self._limits()

    def _found(self) -> ColourQuantity:
        found = quantity(self._run, self._name)
        return found if self._cells else found.on_vertices(self._run)

    def _limits(self) -> tuple[float, float]:
        return self._quantity.limits(np.array(self._percentiles), self._asked)

    def renew(self) -> None:
        """Take in the states that the run has written meanwhile; the newest takes part in the range."""
        self._quantity = self._found()
        self._percentiles.append(self._quantity.percentiles(len(self._run) - 1))
        if len(self._percentiles) > 4 * RANGE_STATES:  # every second one but the newest
            self._percentiles = [*self._percentiles[:-1:2], self._percentiles[-1]]
        self._low, self._high = self._limits()

    def colours(self, state: int) -> tuple[Colours, bool]:
        """(V, 3) or (F, 3) red, green, blue, 0-255; whether they belong to triangles."""
        values, span = self._quantity.values(state), self._high - self._low
        share = np.zeros(len(values))
        if 0 < span < np.inf:
            share = np.nan_to_num(((values - self._low) / span).clip(0, 1))
        return self._table[(255 * share).astype(np.uint8)], self._quantity.on_triangles

    def bar(self) -> dict[str, Any]:
        """The bar beside the cloth: title with unit, ticks from the top, shades from the bottom."""
        shades = ", ".join(f"rgb({r} {g} {b})" for r, g, b in self._table[::17])
        ends = (self._high, self._low) if self._low <= self._high else (0.0, 0.0)
        return {
            "title": self._quantity.label,
            "ticks": [_number(value, ends[0] - ends[1]) for value in np.linspace(*ends, 5)],
            "shades": shades,
        }


def _number(value: float, span: float) -> str:
    """Three digits; zero if negligible beside the span."""
    return f"{float(f'{value:.3g}'):g}" if abs(value) > 1e-6 * span else "0"


def sample(count: int, most: int) -> list[int]:
    """At most ``most`` of the numbers below ``count``, evenly spread, with the first and the last."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, most))})


def energies(history: Columns, unit: str) -> dict[str, Any]:
    """Figure (for plotly) of the energies [J] over time; the potential energy counts from the start."""
    rows = _rows(len(history["time"]))
    parts = {name: history[f"{name}_energy"] for name in ("kinetic", "membrane", "bending", "potential")}
    parts["potential"] = parts["potential"] - parts["potential"][:1]
    parts["total"] = np.sum(list(parts.values()), axis=0)
    times = history["time"][rows]
    lines = [_line(name, times, values[rows], LINE_COLOURS[name]) for name, values in parts.items()]
    lines[-1]["line"]["width"] = 2
    return {"data": lines, "layout": _layout("energy [J] (potential: since the start)", unit)}


def iterations(history: Columns, unit: str) -> dict[str, Any]:
    """Figure of the Newton and linear iterations of each step; the maximum where steps share a point."""
    starts = _rows(len(history["time"]))
    lines = []
    for name, axis, colour in (("Newton", "y", "#0072b2"), ("linear", "y2", "#d55e00")):
        column = history[f"{name.lower()}_iterations"]
        most = np.maximum.reduceat(column, starts) if len(column) else column
        lines.append(_line(name, history["time"][starts], most, colour, shape="hv") | {"yaxis": axis})
    layout = _layout("iterations a step", unit)
    layout["yaxis"] |= {"rangemode": "tozero", "tickfont": {"color": "#0072b2"}}
    layout["yaxis2"] = {"overlaying": "y", "side": "right", "showgrid": False, "zeroline": False}
    layout["yaxis2"] |= {"rangemode": "tozero", "tickfont": {"color": "#d55e00"}}
    layout["margin"]["r"] = 44
    return {"data": lines, "layout": layout}


def at_time(figure: Mapping[str, Any], time: float) -> dict[str, Any]:
    """The same figure with a vertical line at a time."""
    mark = {"type": "line", "xref": "x", "yref": "paper", "x0": time, "x1": time, "y0": 0, "y1": 1}
    mark["line"] = {"color": "#666", "width": 1, "dash": "dot"}
    return {"data": figure["data"], "layout": {**figure["layout"], "shapes": [mark]}}


def _rows(count: int) -> Ints:
    """Numbers of the rows to draw, ascending, with the last one."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(np.int64))


def _line(name: str, x: NDArray[Any], y: NDArray[Any], colour: str, **style: Any) -> dict[str, Any]:
    line = {"color": colour, "width": 1.5, **style}
    return {"name": name, "x": _numbers(x), "y": _numbers(y), "mode": "lines", "line": line}


def _numbers(values: NDArray[Any]) -> list[float | None]:
    """Six digits of each number, None where it is not finite: what JSON can hold."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in values]


def _layout(title: str, unit: str) -> dict[str, Any]:
    grid = {"gridcolor": "#e4e6ea", "zerolinecolor": "#c8ccd2", "automargin": True}
    place = {"x": 0.02, "xanchor": "left", "y": 0.97, "yanchor": "top"}
    return {
        "title": {"text": title, "font": {"size": 13}, **place},
        "font": {"family": "Roboto, sans-serif", "size": 11, "color": "#333"},
        "margin": {"l": 44, "r": 12, "t": 34, "b": 34},
        "xaxis": {**grid, "title": {"text": f"time [{unit}]" if unit else "load factor", "standoff": 4}},
        "yaxis": dict(grid),
        "legend": {"orientation": "h", "x": 0, "y": -0.22, "yanchor": "top", "font": {"size": 11}},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "#fff",
        "hovermode": "x unified",
        "uirevision": "keep",
    }
