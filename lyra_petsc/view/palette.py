"""The colours that stand for a quantity's values, and the bar that says so."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.render.quantities import DERIVED, Quantity, quantity
from lyra_petsc.results.run import Run

Array = NDArray[np.float64]
Colours = NDArray[np.uint8]

SAMPLES = 12
"""States that the range of the colours is taken from at first."""


def names(run: Run) -> list[str]:
    """What a run's states can be coloured by, by the names that `render.quantities` knows."""
    derived = [name for name in DERIVED if name != "speed" or "velocity" in run.fields]
    return derived + [name for name in run.fields if name != "velocity"]


class Palette:
    """Colours from the least to the largest value of some states, zero in the middle where it has a sign.

    Parameters
    ----------
    run : Run
    name : str
        One of `names`.

    Raises
    ------
    InputError
        If the states cannot be read.
    """

    def __init__(self, run: Run, name: str) -> None:
        from matplotlib import colormaps

        self._run, self._name = run, name
        self._quantity: Quantity = quantity(run, name)
        table = colormaps["coolwarm" if self._quantity.signed else "viridis"]
        self._table: Colours = table(np.linspace(0, 1, 256), bytes=True)[:, :3]
        self._low, self._high = np.inf, -np.inf
        for state in sample(len(run), SAMPLES):
            self._widen(state)

    def renew(self) -> None:
        """See the states that the run has written meanwhile, the newest of them in the range."""
        self._quantity = quantity(self._run, self._name)
        self._widen(len(self._run) - 1)

    def _widen(self, state: int) -> None:
        low, high = self._quantity.span(state)
        self._low, self._high = min(self._low, low), max(self._high, high)

    def colours(self, state: int) -> tuple[Colours, bool]:
        """(V, 3) or (F, 3) red, green, blue, 0-255; whether they are the triangles'."""
        values, span = self._quantity.values(state), self._high - self._low
        share = np.zeros(len(values))
        if 0 < span < np.inf:
            share = np.nan_to_num(((values - self._low) / span).clip(0, 1))
        return self._table[(255 * share).astype(np.uint8)], self._quantity.on_triangles

    def bar(self) -> dict[str, Any]:
        """What the page shows beside the cloth: title with unit, numbers from above, shades from below."""
        shades = ", ".join(f"rgb({r} {g} {b})" for r, g, b in self._table[::17])
        ends = (self._high, self._low) if self._low <= self._high else (0.0, 0.0)
        return {
            "title": self._quantity.label,
            "ticks": [_number(value, ends[0] - ends[1]) for value in np.linspace(*ends, 5)],
            "shades": shades,
        }


def _number(value: float, span: float) -> str:
    """Three digits; what is rounding beside the span is zero."""
    return f"{float(f'{value:.3g}'):g}" if abs(value) > 1e-6 * span else "0"


def sample(count: int, most: int) -> list[int]:
    """At most so many of the numbers below ``count``, evenly spread, the first and the last among them."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, most))})
