"""Figures of surfaces and of quantities over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.show.report.document import Drawing
from lyra_petsc.show.report.plots import HEIGHT, colour, drawn, empty_figure

Array = NDArray[np.float64]

MOST_TRIANGLES = 20_000
"""Drawn of a surface; of a larger one every k-th is."""


@dataclass(frozen=True)
class Curve:
    """One line of a figure over time."""

    name: str
    times: Sequence[float]
    values: Sequence[float]


def over_time(curves: Sequence[Curve], *, name: str, caption: str, y_label: str) -> Drawing:
    """Quantities over time [s], both axes linear."""
    figure = empty_figure(0.6 * HEIGHT)
    axes = figure.add_subplot(xlabel="time [s]", ylabel=y_label)
    for number, curve in enumerate(curves):
        axes.plot(curve.times, curve.values, color=colour(number), label=curve.name, lw=1.6, marker=".", ms=4)
    axes.grid(True, color="#dfe3e8", lw=0.8)
    axes.legend(fontsize=8)
    return drawn(figure, name, caption)


def surface(x: Array, triangles: NDArray[np.int64], *, name: str, caption: str) -> Drawing:
    """A triangle surface (V, 3) [m] seen obliquely, lit from the side."""
    every = -(-len(triangles) // MOST_TRIANGLES)
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
    return drawn(figure, name, caption)
