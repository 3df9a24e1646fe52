"""Reference positions of handles: where their vertices were when they started to act."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.points import Layout


class ReferencePositions:
    """Positions of the vertices of handles and springs at each time at which one of them starts.

    Parameters
    ----------
    layout : Layout
    rows : (n,) int64
        Local rows of all these vertices, in any order.
    starts : iterable of float
        Times [s] at which something starts to act.

    Attributes
    ----------
    late : dict of float to (n_owned, 3) array
        All positions [m] at starts after t = 0, which a checkpoint must hold.
    """

    def __init__(self, layout: Layout, rows: Ints, starts: Iterable[float]) -> None:
        self._layout, self._rows = layout, np.unique(rows)
        self._starts = sorted({0.0, *starts})
        self._positions: dict[float, Array] = {}
        self.late: dict[float, Array] = {}

    def until(self, time: float, x: Array) -> None:
        """Let everything that starts to act by ``time`` [s] do so from positions x (n_local, 3)."""
        for start in self._starts:
            if start <= time and start not in self._positions:
                self._begin(start, x)

    def resume(self, start: float, x: Array) -> None:
        """What started at ``start`` [s] did so from positions x (n_owned, 3); collective."""
        shape = np.zeros((self._layout.n_local, 3))
        shape[: len(x)] = x
        self._layout.update_ghosts(shape)
        self._begin(start, shape)

    def _begin(self, start: float, x: Array) -> None:
        if start > 0.0:
            self.late[start] = x[: self._layout.n_owned].copy()
        self._positions[start] = x[self._rows]

    def at(self, start: float, rows: Ints) -> Array:
        """Positions (n, 3) [m] of local rows at a start; before it, those at the latest start so far."""
        found = self._positions.get(start)
        if found is None:
            found = self._positions[max(self._positions)]
        return found[np.searchsorted(self._rows, rows)]
