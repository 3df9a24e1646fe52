"""Figures of errors against resolution and run time, and of surfaces.

Only matplotlib's Agg and SVG backends are used, which need no display and no global state.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.show.report.document import Drawing, short

COLOURS = ("#0b62a4", "#d1495b", "#2a9d5c", "#e08e0b", "#7b4fa6", "#14858f", "#8c5a3c", "#5b6470")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
WIDTH, HEIGHT = 7.2, 4.6  # inches
MOST_INSIDE, BELOW = 12, 0.16
"""Entries of a legend within the axes, at most; height [inches] of a row of a longer one, below them."""


@dataclass(frozen=True)
class Series:
    """One line of a figure.

    Attributes
    ----------
    name : str
    x, y : sequences of float
        Points, joined in this order; points that are not finite and positive are omitted.
    low, high : sequences of float
        Smallest and largest x of each point, optional.
    labels : sequence of str
        Label of each point, optional.
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float] = ()
    high: Sequence[float] = ()
    labels: Sequence[str] = field(default_factory=tuple)

    @property
    def shown(self) -> Series:
        """The series of the points that a logarithmic figure can show."""
        at = [i for i, point in enumerate(zip(self.x, self.y, strict=True)) if all(map(_visible, point))]

        def kept(values: Sequence[Any]) -> list[Any]:
            return [values[i] for i in at if i < len(values)]

        return Series(self.name, *map(kept, (self.x, self.y, self.low, self.high, self.labels)))


def convergence(
    series: Sequence[Series],
    *,
    name: str,
    caption: str,
    x_label: str,
    y_label: str,
    floor: float | None = None,
    floor_label: str = "",
) -> Drawing:
    """Errors against a step or mesh size, log-log, with the fitted slope of each line in the legend.

    Parameters
    ----------
    series : sequence of Series
    name, caption : str
        Name and caption of the drawing.
    x_label, y_label : str
    floor : float, optional
        Errors below this value cannot be resolved; the range is shaded.
    floor_label : str
    """
    figure, axes = _axes(x_label, y_label)
    lines = [line.shown for line in series]
    for line, look in _with_styles(lines):
        slope = fitted_slope(line.x, line.y)
        label = line.name if math.isnan(slope) else f"{line.name}: slope {slope:.2f}"
        axes.plot(line.x, line.y, label=label, lw=1.6, **look)
    _reference_slopes(axes, [point for line in lines for point in zip(line.x, line.y, strict=True)])
    _shade_floor(axes, floor, floor_label)
    _finish_axes(axes)
    return make_drawing(figure, name, caption)


def work_precision(
    series: Sequence[Series],
    *,
    name: str,
    caption: str,
    y_label: str,
    x_label: str = "run time [s]",
    front: Sequence[tuple[float, float]] = (),
    bounds: Sequence[tuple[float, float]] = (),
    recommended: tuple[float, float] | None = None,
    recommendation: str = "",
    floor: float | None = None,
    floor_label: str = "",
) -> Drawing:
    """Error against run time, log-log: spread of the time, Pareto front, recommended setting.

    Parameters
    ----------
    series : sequence of Series
    front : sequence of (time, error)
        The Pareto front: points for which no other point is better in both; drawn as a staircase.
    bounds : sequence of (time, error)
        Points whose error is only known to be at most this large.
    recommended : (time, error), optional
    recommendation : str
        Name of the recommended setting.
    """
    figure, axes = _axes(x_label, y_label)
    for line, look in _with_styles([line.shown for line in series]):
        spread = None
        if line.low and line.high:
            spread = np.maximum(0.0, [np.subtract(line.x, line.low), np.subtract(line.high, line.x)])
        axes.errorbar(line.x, line.y, xerr=spread, label=line.name, lw=1.4, capsize=2, elinewidth=1.0, **look)
        for label, *point in zip(line.labels, line.x, line.y, strict=False):
            axes.annotate(
                label, point, xytext=(5, 4), textcoords="offset points", fontsize=7, color=look["color"]
            )
    best = sorted(point for point in front if all(map(_visible, point)))
    if best:
        times, errors = zip(*best, strict=True)
        axes.step(
            times, errors, where="post", color="#1b1f24", lw=5, alpha=0.13, label="Pareto front", zorder=0
        )
        axes.plot(times, errors, "o", ms=10, mfc="none", mec="#1b1f24", mew=0.9, zorder=0)
    at_most = [point for point in bounds if all(map(_visible, point))]
    if at_most:
        times, errors = zip(*at_most, strict=True)
        axes.plot(times, errors, "v", ms=7, mfc="none", mec="#5b6470", label="not resolved: at most")
    if recommended is not None and all(map(_visible, recommended)):
        axes.plot(
            *recommended, "*", ms=17, mfc="#f6c344", mec="#1b1f24", mew=0.9, zorder=5,
            label=f"recommended: {recommendation}",
        )  # fmt: skip
    _shade_floor(axes, floor, floor_label)
    _finish_axes(axes)
    return make_drawing(figure, name, caption)


def fitted_slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Least-squares slope of log y over log x; NaN for fewer than two different x."""
    points = np.log([point for point in zip(x, y, strict=True) if all(map(_visible, point))])
    if len(points) < 2 or np.ptp(points[:, 0]) < 1e-12:
        return math.nan
    return float(np.polyfit(points[:, 0], points[:, 1], 1)[0])


def _visible(value: float) -> bool:
    return math.isfinite(value) and value > 0.0


def colour(number: int) -> str:
    """Colour of a figure's line by its number."""
    return COLOURS[number % len(COLOURS)]


def _with_styles(lines: Sequence[Series]) -> Iterator[tuple[Series, dict[str, Any]]]:
    """The lines that have points, each with its marker and colour."""
    for number, line in enumerate(lines):
        if line.x:
            yield line, {"marker": MARKERS[number % len(MARKERS)], "color": colour(number), "ms": 5}


def empty_figure(height: float) -> Any:
    """A figure without axes, of the standard width and the given height [inches]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _axes(x_label: str, y_label: str) -> tuple[Any, Any]:
    figure = empty_figure(HEIGHT)
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel=x_label, ylabel=y_label)
    axes.grid(True, which="major", color="#dfe3e8", lw=0.8)
    axes.grid(True, which="minor", color="#eef0f3", lw=0.5)
    axes.set_axisbelow(True)
    axes.margins(x=0.09, y=0.07)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _reference_slopes(axes: Any, points: Sequence[tuple[float, float]]) -> None:
    """Dashed lines of slope 1 and 2 through the largest point, for comparison by eye."""
    if len({x for x, _ in points}) < 2:
        return
    (low, high), (bottom, top) = ((min(values), max(values)) for values in zip(*points, strict=True))
    for order, dashes in ((1, (4, 3)), (2, (1, 2))):
        end = max(low, high * (0.5 * bottom / top) ** (1.0 / order))
        axes.plot(
            [end, high], [top * (end / high) ** order, top], color="#8a939c", lw=1.0, dashes=dashes,
            label=f"slope {order}", zorder=1,
        )  # fmt: skip


def _shade_floor(axes: Any, floor: float | None, label: str) -> None:
    """Shade the range below ``floor``, unless that would stretch the figure."""
    if floor is None or not _visible(floor):
        return
    low, high = axes.get_ylim()
    if floor < low / 30.0:
        return
    axes.axhspan(min(low, floor / 10.0), floor, color="#9aa3ad", alpha=0.18, lw=0, label=label or None)
    axes.set_ylim(min(low, floor / 3.0), high)


def _finish_axes(axes: Any) -> None:
    """Add a legend, and label ticks even if an axis spans less than a decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        decades = math.log10(limits[1] / limits[0])
        marks = (1.0,) if decades > 3 else (1.0, 2.0, 5.0)
        axis.set_major_locator(LogLocator(base=10.0, subs=marks, numticks=30))
        axis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
        axis.set_minor_formatter(NullFormatter())
    number = len(axes.get_legend_handles_labels()[0])
    if number > MOST_INSIDE:
        axes.figure.set_figheight(HEIGHT + BELOW * math.ceil(number / 2))
        axes.figure.legend(loc="outside lower center", ncols=2, fontsize=7, frameon=False)
    elif number:
        axes.legend(fontsize=8, framealpha=0.9, edgecolor="#d5d9de")


def make_drawing(figure: Any, name: str, caption: str) -> Drawing:
    """A matplotlib figure as SVG, and as PNG when that is first used."""
    from matplotlib import rc_context
    from matplotlib.text import Text

    # without LaTeX, whatever a matplotlibrc says, of which one may lie in the working directory
    for text in figure.findobj(Text):
        text.set_usetex(False)

    def png() -> bytes:
        content = io.BytesIO()
        with rc_context({"text.usetex": False}):
            figure.savefig(content, format="png", dpi=150, metadata={"Software": None})
        return content.getvalue()

    svg = io.BytesIO()
    # without date and with a fixed salt, the same data give the same file
    with rc_context({"text.usetex": False, "svg.hashsalt": name}):
        figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
    return Drawing(name, caption, png, svg.getvalue())


MAX_TRIANGLES = 20_000
"""Maximum number of triangles drawn; of a larger surface, every k-th triangle is drawn."""


def surface(x: Array, triangles: Ints, *, name: str, caption: str) -> Drawing:
    """A triangle surface (V, 3) [m] seen obliquely, lit from the side."""
    every = -(-len(triangles) // MAX_TRIANGLES)
    figure = empty_figure(HEIGHT)
    axes: Any = figure.add_subplot(projection="3d")
    axes.plot_trisurf(
        x[:, 0], x[:, 1], x[:, 2], triangles=triangles[::every], color="#8fb7d9", edgecolor="#2b4a66",
        linewidth=0.1, shade=True, rasterized=True,
    )  # fmt: skip
    # the same scale on all axes
    centre, half = 0.5 * (x.max(axis=0) + x.min(axis=0)), max(0.5 * float(np.ptp(x, axis=0).max()), 1e-12)
    for axis, middle in zip("xyz", centre, strict=True):
        getattr(axes, f"set_{axis}lim")(middle - half, middle + half)
        getattr(axes, f"set_{axis}label")(f"{axis} [m]")
        axes.locator_params(axis=axis, nbins=4)
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(elev=18, azim=-65)
    return make_drawing(figure, name, caption)
