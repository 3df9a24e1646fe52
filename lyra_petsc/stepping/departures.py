"""Shapes from which handles and springs that start to act in the course of a run set out."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.handles.held import Held
from lyra_petsc.partition.points import Points
from lyra_petsc.terms.term import Elastic

Array = NDArray[np.float64]


class Departures:
    """Tells handles and terms when they begin.

    Parameters
    ----------
    points : Points
    held : Held
    elastic : list of Elastic
    starts : iterable of float
        Times [s] at which something starts to act.

    Attributes
    ----------
    late : dict of float to (n_owned, 3) array
        Positions [m] at starts after t = 0, which a checkpoint must hold.
    """

    def __init__(self, points: Points, held: Held, elastic: list[Elastic], starts: Iterable[float]) -> None:
        self._points, self._held, self._elastic = points, held, elastic
        self._starts = sorted(set(starts))
        self._begun: set[float] = set()
        self.late: dict[float, Array] = {}

    def until(self, time: float, x: Array) -> None:
        """Let everything that starts to act by ``time`` [s] set out from positions x (n_local, 3)."""
        for start in self._starts:
            if start <= time and start not in self._begun:
                self._set_out(start, x)

    def resume(self, start: float, x: Array) -> None:
        """Let what started at ``start`` [s] set out from positions x (n_owned, 3); collective."""
        shape = np.zeros((self._points.n_local, 3))
        shape[: self._points.n_owned] = x
        self._points.update_ghosts(shape)
        self._set_out(start, shape)

    def _set_out(self, start: float, x: Array) -> None:
        self._begun.add(start)
        if start > 0.0:
            self.late[start] = x[: self._points.n_owned].copy()
        self._held.begin(start, x)
        for term in self._elastic:
            term.begin(start, x)
