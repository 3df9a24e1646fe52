"""Reference positions of handles: those of their vertices when the handle started to act."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.points import Layout


class ReferencePositions:
    """Positions of the vertices of handles and springs at each time at which a handle or spring starts.

    Parameters
    ----------
    layout : Layout
    rows : (n,) int64
        Local rows of these vertices, in any order.
    starts : iterable of float
        Times [s] at which handles and springs start.

    Attributes
    ----------
    late : dict of float to (n_owned, 3) array
        Positions [m] of all owned rows at each start after t = 0, for checkpoints.
    """

    def __init__(self, layout: Layout, rows: Ints, starts: Iterable[float]) -> None:
        self._layout, self._rows = layout, np.unique(rows)
        self._starts = sorted({0.0, *starts})
        self._positions: dict[float, Array] = {}
        self.late: dict[float, Array] = {}

    def record_starts(self, time: float, x: Array) -> None:
        """Record positions x (n_local, 3) for every start up to ``time`` [s] not recorded before."""
        for start in self._starts:
            if start <= time and start not in self._positions:
                self._begin(start, x)

    def restore(self, start: float, x: Array) -> None:
        """Restore from a checkpoint the positions x (n_owned, 3) at ``start`` [s]; collective."""
        self._begin(start, self._layout.extended(x))

    def _begin(self, start: float, x: Array) -> None:
        if start > 0.0:
            self.late[start] = x[: self._layout.n_owned].copy()
        self._positions[start] = x[self._rows]

    def at(self, start: float, rows: Ints) -> Array:
        """Positions (n, 3) [m] of local rows at a start; if it is to come, at the latest start so far."""
        positions = self._positions.get(start)
        if positions is None:
            positions = self._positions[max(self._positions)]
        return positions[np.searchsorted(self._rows, rows)]
