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
    rows : (n,) int
        Block rows that couple to prescribed coordinates.
    blocks : (n,) int
        The blocks in them.
    goal : (n_owned, 3)
        Positions [m] at the end of the step; those of free coordinates at its start. Empty without handles.
    velocity : (n_owned, 3)
        Velocities [m/s] at the stage; 0 in free coordinates. Empty without handles.
    """

    def __init__(self, points: Points, held: Held, blocks: BlockRows) -> None:
        self._points, self.held, self._blocks = points, held, blocks
        self._active: tuple[int, ...] | None = None
        self._span = (0.0, 0.0)
        self.mask: Mask = np.zeros((points.n_local, 3), dtype=bool)
        self.free: Mask = ~self.mask[: points.n_owned]
        self.rows = self.blocks = np.empty(0, dtype=np.int64)
        self.goal, self.velocity = (np.zeros((points.n_owned, 3)) if held else np.empty((0, 3)) for _ in "ab")

    def begin_step(self, t0: float, t1: float, x: Array) -> bool:
        """Take the handles of the step t0..t1 [s] and positions x; whether they changed; collective."""
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
            self.rows, self.blocks = self._blocks.beside(self.mask)
        self.goal[:] = x[:n]
        self.held.targets(t0, t1, t1, self.goal)
        return changed

    def solve(self, x_h: Array, reach: float) -> None:
        """Take the velocities that lead from the history x_h (n_owned, 3) to the goal."""
        if self.held:
            self.velocity = np.where(self.free, 0.0, (self.goal - x_h) / reach)

    def give(self, at: float, x_h: Array, reach: float) -> None:
        """Take position and velocity at time ``at`` [s], and change x_h (n_owned, 3) to agree with them."""
        position, rate = np.zeros_like(x_h), np.zeros_like(x_h)
        self.held.targets(*self._span, at, position)
        self.held.velocities(*self._span, at, rate)
        np.copyto(x_h, position - reach * rate, where=~self.free)
        self.velocity = np.where(self.free, 0.0, rate)

    def overwrite_with_rates(self, velocity: Array) -> None:
        """Write ẋ* [m/s] at the end of the step over the prescribed coordinates of ``velocity``."""
        if self.held and self._span[1] > self._span[0]:
            self.held.velocities(*self._span, self._span[1], velocity)
