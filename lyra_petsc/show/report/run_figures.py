"""Figures of one run: energies, their balance, steps and iterations, wall time by phase."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.show.report.document import Drawing
from lyra_petsc.show.report.plots import HEIGHT, colour, drawn, empty_figure
from lyra_petsc.show.report.run_facts import ENERGIES, Facts

Array = NDArray[np.float64]

MANY_POINTS = 3000
"""Points of a line from which it is drawn as pixels."""


def energies(facts: Facts) -> Drawing:
    """Energies over time, the potential one from its start."""
    figure, (axes,) = _axes(facts, ["energy [J]"], 0.75 * HEIGHT)
    for number, (column, name) in enumerate(ENERGIES.items()):
        values = facts.columns[column]
        if column == "potential_energy":
            values, name = values - values[0], "potential, change"
        if values.any():
            _line(axes, facts.columns["time"], values, number, name)
    if axes.lines:
        axes.legend(fontsize=8)
    return drawn(figure, "energies", f"Energies over {_abscissa(facts)}")


def balance(facts: Facts) -> Drawing:
    """Where the energy came from and where it went."""
    figure, (axes,) = _axes(facts, ["energy [J]"], 0.75 * HEIGHT)
    time = facts.columns["time"]
    _line(axes, time, facts.total_energy - facts.total_energy[0], 0, "change of the total energy")
    _line(axes, time, facts.columns["external_work"], 3, "work of loads and handles")
    _line(axes, time, -facts.columns["dissipation"], 1, "taken by damping")
    _line(axes, time, -facts.scheme_loss, 4, "taken by the time scheme")
    axes.legend(fontsize=8)
    caption = "Energy balance: the first line is the sum of the other three"
    return drawn(figure, "balance", caption)


def effort(facts: Facts) -> Drawing:
    """Δt, iterations and wall time of each step."""
    time, newton = facts.steps("time"), facts.steps("newton_iterations")
    panels = {
        "increment" if facts.static else "Δt [s]": facts.steps("dt"),
        "Newton its": newton,
        "linear its": facts.steps("linear_iterations") / np.maximum(newton, 1.0),
        "wall [s]": facts.steps("wall_seconds"),
    }
    figure, axes = _axes(facts, list(panels), 1.5 * HEIGHT)
    for panel, values in zip(axes, panels.values(), strict=True):
        _line(panel, time, values, 0, "")
        panel.set_ylim(bottom=0)
    rejected = facts.steps("rejected") > 0
    if rejected.any():
        at, dt = time[rejected], facts.steps("dt")[rejected]
        axes[0].plot(at, dt, "x", color=colour(1), ms=5, label="after rejected attempts")
        axes[0].legend(fontsize=8)
    caption = "Each step: its length, Newton iterations, linear iterations of a Newton iteration, wall time"
    return drawn(figure, "steps", caption)


def phases(wall: Mapping[str, float]) -> Drawing:
    """Wall time by phase, as one bar."""
    figure = empty_figure(1.4)
    axes = figure.add_subplot()
    left = 0.0
    for number, (name, value) in enumerate(wall.items()):
        axes.barh(0, value, left=left, color=colour(number), label=name)
        left += value
    axes.set_yticks([])
    axes.set_xlabel("wall time [s]")
    axes.legend(fontsize=8, ncols=len(wall), loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return drawn(figure, "phases", "Wall time by phase")


def _abscissa(facts: Facts) -> str:
    return "load factor" if facts.static else "time"


def _axes(facts: Facts, labels: Sequence[str], height: float) -> tuple[Any, Any]:
    """A figure of panels above each other that share the time axis."""
    figure = empty_figure(height)
    axes = figure.subplots(len(labels), 1, sharex=True, squeeze=False)[:, 0]
    for panel, label in zip(axes, labels, strict=True):
        panel.set_ylabel(label)
        panel.grid(True, color="#dfe3e8", lw=0.8)
        for side in ("top", "right"):
            panel.spines[side].set_visible(False)
    axes[-1].set_xlabel("load factor" if facts.static else "time [s]")
    return figure, axes


def _line(axes: Any, x: Array, y: Array, number: int, name: str) -> None:
    pixels = len(x) > MANY_POINTS
    axes.plot(x, y, color=colour(number), label=name or None, lw=1.4, rasterized=pixels)
