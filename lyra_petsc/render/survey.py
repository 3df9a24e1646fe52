"""One look at all states that will be shown: how far they reach, and the range of the colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.render.quantities import Quantity
from lyra_petsc.results.run import Run

Array = NDArray[np.float64]


@dataclass
class Survey:
    """What states have in common.

    Attributes
    ----------
    reach : (n,) float64
        Largest product of a vertex with each of n normals [m].
    low, high : float
        Of the quantity that is shown.
    """

    reach: Array
    low: float = np.inf
    high: float = -np.inf

    def join(self, other: Survey) -> Survey:
        """Both together."""
        return Survey(
            np.maximum(self.reach, other.reach), min(self.low, other.low), max(self.high, other.high)
        )

    @property
    def limits(self) -> tuple[float, float]:
        """Range of the colours, never empty."""
        if not self.low < self.high:
            middle = self.low if np.isfinite(self.low) else 0.0
            return middle, middle + max(1e-12, 1e-6 * abs(middle))
        return self.low, self.high


def survey(run: Run, states: list[int], normals: Array, quantity: Quantity | None) -> Survey:
    """Look at some states.

    Parameters
    ----------
    run : Run
    states : list of int
    normals : (n, 3) float64
    quantity : Quantity or None

    Raises
    ------
    InputError
        If a state holds numbers that are not finite.
    """
    found = Survey(np.full(len(normals), -np.inf))
    for state in states:
        x = run.positions[state]
        if not np.isfinite(x).all():
            raise InputError(f"state {state} holds positions that are not finite numbers", file=run.folder)
        found = found.join(Survey((x @ normals.T).max(axis=0)))
        if quantity is not None:
            found = found.join(Survey(found.reach, *quantity.span(state)))
    return found
