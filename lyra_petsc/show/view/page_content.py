"""Content of the page: the state to show at a time, the colours of a quantity, plots of the history.

The content is plain data and needs none of the page's packages.
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

REAL_TIME_MIN, REAL_TIME_MAX = 0.5, 60.0
"""Motions of a duration [s] between these bounds are initially played in real time."""
PLAY_SECONDS = 10.0
"""Approximate time [s] in which other motions are initially played."""
SPEED_FACTORS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Selectable speeds, relative to the initial one."""

RANGE_STATES = 12
"""Number of states from which the range of the colours is initially computed."""

MAPS = ("viridis", "cividis", "plasma", "turbo", "coolwarm", "gray")
"""Selectable colour maps of matplotlib."""

MAX_POINTS = 600
"""Maximum number of points of a plotted line; of a longer history, evenly spaced rows are drawn."""
LINE_COLOURS = {
    "kinetic": "#0072b2",
    "membrane": "#d55e00",
    "bending": "#009e73",
    "potential": "#cc79a7",
    "total": "#222222",
}


class Player:
    """Determines the state to show: when playing, moving the slider, or following a running simulation.

    Parameters
    ----------
    run : StoredRun

    Attributes
    ----------
    shown : int
        Number of the state that the page should show.
    speed : float
        Simulated seconds per second.
    playing : bool
    changed : asyncio.Event
        Set when another state should be shown.
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
        """Play from the present state or, if it is the last, from the first one."""
        if self.shown >= self.last:
            self.shown = 0
        self.playing = self.shown < self.last  # a single state does not play
        self._restart()

    def pause(self) -> None:
        """Stop playing at the present state."""
        self.playing = False

    def go(self, state: int) -> None:
        """Show a state by its number; playing continues from there."""
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
        """Seconds until another state is due; infinite when not playing."""
        if not self.playing or self.shown >= self.last:
            return math.inf
        return max(0.0, (float(self._run.times[self.shown + 1]) - self._now()) / self.speed)

    def _now(self) -> float:
        """Simulated time [s] that playing has reached."""
        return self._from + self.speed * (clock.monotonic() - self._begun)

    def follow(self) -> bool:
        """Read new states of the run; returns whether there are any.

        If the present state is the newest, the new newest state is shown next.

        Raises
        ------
        InputError
            If the results have been removed.
        """
        newest = self.shown >= self.last and not self.playing
        if not self._run.refresh():
            return False
        self.shown = self.last if newest else min(self.shown, self.last)
        self.changed.set()
        return True


def first_speed(run: StoredRun) -> float:
    """Initial speed: real time, or for short or long motions the power of ten that takes about 10 s."""
    span = float(run.times[-1] - run.times[0])
    if span <= 0 or REAL_TIME_MIN <= span <= REAL_TIME_MAX:
        return 1.0
    return float(10.0 ** round(math.log10(span / PLAY_SECONDS)))


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

    def values(self, state: int, position: Array, only: str = "") -> list[dict[str, str]]:
        """Names and values, with units, of the vertex in a state.

        Parameters
        ----------
        state : int
        position : (3,)
            Position of the vertex [m].
        only : str
            Name of a single quantity; empty: all quantities.
        """
        numbers = ", ".join(f"{x:.5g}" for x in position)
        lines = [{"name": f"vertex {self.vertex}", "value": f"({numbers}) m"}]
        for name, shown in self._quantities.items():
            if only in ("", name) and not shown.on_triangles:
                lines.append({"name": shown.label, "value": f"{float(shown.values(state)[self.vertex]):.5g}"})
        return lines


class Palette:
    """Colours of a quantity's values, and the colour bar; zero is in the middle of signed values' range.

    Parameters
    ----------
    run : StoredRun
    name : str
        One of `names`.
    chosen : ColourRange, optional
        The range of the colours; by default computed from the values.
    colour_map : str
        One of ``MAPS``; empty: chosen by the quantity.
    cells : bool
        Whether each triangle has the colour of its own value; else vertices have the colours of means.

    Raises
    ------
    InputError
        If a state cannot be read.
    """

    def __init__(
        self,
        run: StoredRun,
        name: str,
        chosen: ColourRange | None = None,
        colour_map: str = "",
        *,
        cells: bool = False,
    ) -> None:
        from matplotlib import colormaps

        self._run, self._name, self._chosen, self._cells = run, name, chosen, cells
        self._quantity = self._find_quantity()
        table = colormaps[colour_map or ("coolwarm" if self._quantity.signed else MAPS[0])]
        self._table: Colours = table(np.linspace(0, 1, 256), bytes=True)[:, :3]
        self._percentiles = [self._quantity.percentiles(i) for i in sample(len(run), RANGE_STATES)]
        self._low, self._high = self._limits()

    def _find_quantity(self) -> ColourQuantity:
        named = quantity(self._run, self._name)
        return named if self._cells else named.on_vertices(self._run)

    def _limits(self) -> tuple[float, float]:
        return self._quantity.limits(np.array(self._percentiles), self._chosen)

    def update(self) -> None:
        """Use new states of the run, and include the newest one in the range."""
        self._quantity = self._find_quantity()
        self._percentiles.append(self._quantity.percentiles(len(self._run) - 1))
        if len(self._percentiles) > 4 * RANGE_STATES:  # keep every second one, and the newest
            self._percentiles = [*self._percentiles[:-1:2], self._percentiles[-1]]
        self._low, self._high = self._limits()

    def colours(self, state: int) -> tuple[Colours, bool]:
        """(V, 3) or (F, 3) red, green, blue from 0 to 255, and whether they belong to triangles."""
        values, span = self._quantity.values(state), self._high - self._low
        fraction = np.zeros(len(values))
        if 0 < span < np.inf:
            fraction = np.nan_to_num(((values - self._low) / span).clip(0, 1))
        return self._table[(255 * fraction).astype(np.uint8)], self._quantity.on_triangles

    def bar(self) -> dict[str, Any]:
        """The colour bar: title with unit, ticks from top to bottom, shades from bottom to top."""
        shades = ", ".join(f"rgb({r} {g} {b})" for r, g, b in self._table[::17])
        ends = (self._high, self._low) if self._low <= self._high else (0.0, 0.0)
        return {
            "title": self._quantity.label,
            "ticks": [_number(value, ends[0] - ends[1]) for value in np.linspace(*ends, 5)],
            "shades": shades,
        }


def _number(value: float, span: float) -> str:
    """A number with three digits; zero if it is negligible compared with ``span``."""
    return f"{float(f'{value:.3g}'):g}" if abs(value) > 1e-6 * span else "0"


def sample(count: int, maximum: int) -> list[int]:
    """At most ``maximum`` of the numbers below ``count``, evenly spaced, with the first and the last."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, maximum))})


def energies(history: Columns, unit: str) -> dict[str, Any]:
    """Figure (for plotly) of the energies [J] over time; the potential energy is relative to its start."""
    rows = _rows(len(history["time"]))
    parts = {name: history[f"{name}_energy"] for name in ("kinetic", "membrane", "bending", "potential")}
    parts["potential"] = parts["potential"] - parts["potential"][:1]
    parts["total"] = np.sum(list(parts.values()), axis=0)
    times = history["time"][rows]
    lines = [_line(name, times, values[rows], LINE_COLOURS[name]) for name, values in parts.items()]
    lines[-1]["line"]["width"] = 2
    return {"data": lines, "layout": _layout("energy [J] (potential: since the start)", unit)}


def iterations(history: Columns, unit: str) -> dict[str, Any]:
    """Figure of the Newton and linear iterations per step; the maximum if several steps share a point."""
    starts = _rows(len(history["time"]))
    lines = []
    for name, axis, colour in (("Newton", "y", "#0072b2"), ("linear", "y2", "#d55e00")):
        column = history[f"{name.lower()}_iterations"]
        maximum = np.maximum.reduceat(column, starts) if len(column) else column
        lines.append(_line(name, history["time"][starts], maximum, colour, shape="hv") | {"yaxis": axis})
    layout = _layout("iterations a step", unit)
    layout["yaxis"] |= {"rangemode": "tozero", "tickfont": {"color": "#0072b2"}}
    layout["yaxis2"] = {"overlaying": "y", "side": "right", "showgrid": False, "zeroline": False}
    layout["yaxis2"] |= {"rangemode": "tozero", "tickfont": {"color": "#d55e00"}}
    layout["margin"]["r"] = 44
    return {"data": lines, "layout": layout}


def at_time(figure: Mapping[str, Any], time: float) -> dict[str, Any]:
    """The figure with a vertical line at a time."""
    mark = {"type": "line", "xref": "x", "yref": "paper", "x0": time, "x1": time, "y0": 0, "y1": 1}
    mark["line"] = {"color": "#666", "width": 1, "dash": "dot"}
    return {"data": figure["data"], "layout": {**figure["layout"], "shapes": [mark]}}


def _rows(count: int) -> Ints:
    """Indices of the rows to draw, ascending, including the last row."""
    return np.unique(np.linspace(0, count - 1, min(count, MAX_POINTS)).astype(np.int64))


def _line(name: str, x: NDArray[Any], y: NDArray[Any], colour: str, **style: Any) -> dict[str, Any]:
    line = {"color": colour, "width": 1.5, **style}
    return {"name": name, "x": _numbers(x), "y": _numbers(y), "mode": "lines", "line": line}


def _numbers(values: NDArray[Any]) -> list[float | None]:
    """The numbers with six digits, and None instead of numbers that are not finite, for JSON."""
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
