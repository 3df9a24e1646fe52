"""The history of a run as plotly's figures: plain dictionaries, drawn in the page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Columns = Mapping[str, NDArray[Any]]

MOST_POINTS = 600
"""Points of a line; of more rows, those at even distances are drawn."""

COLOURS = {
    "kinetic": "#0072b2",
    "membrane": "#d55e00",
    "bending": "#009e73",
    "potential": "#cc79a7",
    "total": "#222222",
}


def energies(history: Columns, unit: str) -> dict[str, Any]:
    """Energies [J] against time; the potential one from the start, as only its changes mean something."""
    rows = _rows(len(history["time"]))
    time = _numbers(history["time"][rows])
    parts = {name: history[f"{name}_energy"] for name in ("kinetic", "membrane", "bending", "potential")}
    parts["potential"] = parts["potential"] - parts["potential"][:1]
    parts["total"] = np.sum(list(parts.values()), axis=0)
    lines = [
        {
            "name": name,
            "x": time,
            "y": _numbers(values[rows]),
            "mode": "lines",
            "line": {"color": COLOURS[name], "width": 2 if name == "total" else 1.5},
        }
        for name, values in parts.items()
    ]
    return {"data": lines, "layout": _layout("energy [J] (potential: since the start)", unit)}


def iterations(history: Columns, unit: str) -> dict[str, Any]:
    """Newton's and the linear solver's iterations of each step; the largest, where steps share a point."""
    starts = _rows(len(history["time"]))
    time = _numbers(history["time"][starts])
    lines = []
    for name, axis, colour in (("Newton", "y", "#0072b2"), ("linear", "y2", "#d55e00")):
        column = history[f"{name.lower()}_iterations"]
        most = np.maximum.reduceat(column, starts) if len(column) else column
        line = {"color": colour, "width": 1.5, "shape": "hv"}
        lines.append(
            {"name": name, "x": time, "y": _numbers(most), "yaxis": axis, "mode": "lines", "line": line}
        )
    layout = _layout("iterations a step", unit)
    layout["yaxis"] |= {"rangemode": "tozero", "tickfont": {"color": "#0072b2"}}
    layout["yaxis2"] = {
        "overlaying": "y",
        "side": "right",
        "rangemode": "tozero",
        "showgrid": False,
        "zeroline": False,
        "tickfont": {"color": "#d55e00"},
    }
    layout["margin"]["r"] = 44
    return {"data": lines, "layout": layout}


def at_time(figure: Mapping[str, Any], time: float) -> dict[str, Any]:
    """The same figure with a line at the time shown."""
    mark = {
        "type": "line",
        "xref": "x",
        "yref": "paper",
        "x0": time,
        "x1": time,
        "y0": 0,
        "y1": 1,
        "line": {"color": "#666", "width": 1, "dash": "dot"},
    }
    return {"data": figure["data"], "layout": {**figure["layout"], "shapes": [mark]}}


def _rows(count: int) -> NDArray[np.int64]:
    """Rows to draw, in order and without doubles, the last one always."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(np.int64))


def _numbers(values: NDArray[Any]) -> list[float | None]:
    """What JSON can hold, with six digits."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in values]


def _layout(title: str, unit: str) -> dict[str, Any]:
    grid = {"gridcolor": "#e4e6ea", "zerolinecolor": "#c8ccd2", "automargin": True}
    return {
        "title": {
            "text": title,
            "x": 0.02,
            "xanchor": "left",
            "y": 0.97,
            "yanchor": "top",
            "font": {"size": 13},
        },
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
