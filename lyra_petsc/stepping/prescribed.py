"""Coordinates that handles prescribe in a step: which, where to, and with what velocity at the stage."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.assembly.blocks import BlockRows
from lyra_petsc.handles.held import Held
from lyra_petsc.partition.points import Points

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Prescribed:
    """The exact handles of a scene in one step on one rank.

    Attributes
    ----------
    mask : (n_local, 3) bool
        Prescribed coordinates.
    free : (n_owned, 3) bool
        The others.
    at : (m,) int
        Which of all owned coordinates, row by row, are prescribed.
    rows : (n,) int
        Block rows that couple to prescribed coordinates.
    blocks : (n,) int
        The blocks in them.
    goal : (m,)
        Positions [m] of the prescribed coordinates at the end of the step.
    velocity : (m,)
        Their velocities [m/s] at the stage.
    """

    def __init__(self, points: Points, held: Held, blocks: BlockRows) -> None:
        self._points, self.held, self._blocks = points, held, blocks
        self._active: tuple[int, ...] | None = None
        self._span = (0.0, 0.0)
        self.mask: Mask = np.zeros((points.n_local, 3), dtype=bool)
        self.free: Mask = ~self.mask[: points.n_owned]
        self.at = self.rows = self.blocks = np.empty(0, dtype=np.int64)
        self.goal, self.velocity = np.empty(0), np.empty(0)

    def begin_step(self, t0: float, t1: float) -> bool:
        """Take the handles of the step t0..t1 [s]; whether they changed; collective."""
        if not self.held:
            return False
        n = self._points.n_owned
        self._span = t0, t1
        active = self.held.active(t0, t1)
        changed = self._active is not None and active != self._active
        if active != self._active:
            self._active = active
            # ranks own different vertices of a handle, but all agree on which handles hold
            flags = np.zeros((self._points.n_local, 3))
            flags[:n] = self.held.mask(t0, t1, n)
            self._points.update_ghosts(flags)
            self.mask = flags > 0.5
            self.free = ~self.mask[:n]
            self.at = np.flatnonzero(self.mask[:n])
            self.rows, self.blocks = self._blocks.beside(self.mask)
        self.goal = self._positions(t1)
        return changed

    def solve(self, x_h: Array, reach: float) -> None:
        """Take the velocities that lead from the history x_h (n_owned, 3) to the goal."""
        self.velocity = (self.goal - x_h.take(self.at)) / reach

    def give(self, at: float, x_h: Array, reach: float) -> None:
        """Take position and velocity at time ``at`` [s], and change x_h (n_owned, 3) to agree with them."""
        self.velocity = self._rates(at)
        self.put(x_h, self._positions(at) - reach * self.velocity)

    def put(self, values: Array, prescribed: Array) -> None:
        """Overwrite the prescribed coordinates of ``values`` (n_owned, 3) by ``prescribed`` (m,)."""
        np.put(values, self.at, prescribed)

    def overwrite_with_rates(self, velocity: Array) -> None:
        """Write ẋ* [m/s] at the end of the step over the prescribed coordinates of ``velocity``."""
        if self.held and self._span[1] > self._span[0]:
            self.put(velocity, self._rates(self._span[1]))

    def _positions(self, at: float) -> Array:
        out = np.empty((self._points.n_owned, 3))
        self.held.targets(*self._span, at, out)
        return out.take(self.at)

    def _rates(self, at: float) -> Array:
        out = np.empty((self._points.n_owned, 3))
        self.held.velocities(*self._span, at, out)
        return out.take(self.at)
