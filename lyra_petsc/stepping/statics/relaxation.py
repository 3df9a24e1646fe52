"""Under-relaxation of loads that follow the shape, so that their fixed-point iteration does not oscillate.

Source: Aitken's Δ² for vectors, Irons & Tuck, Int. J. Numer. Meth. Engng 1 (1969) 275-277.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array

MIN_FACTOR, MAX_FACTOR = 0.02, 1.0


class Relaxation:
    """Loads of the next solve, from the loads of the last solve and those at the shape that it found."""

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._factor = MAX_FACTOR
        self._loads: Array | None = None
        self._change: Array | None = None

    def relax(self, loads: Array) -> Array:
        """Loads (n_owned, 3) [N] for the next solve, from those at the present shape; collective."""
        if self._loads is None:
            return loads
        change = loads - self._loads
        if self._change is not None:
            turn = change - self._change
            dot, square = self._comm.allreduce(
                np.array([np.vdot(self._change, turn), np.vdot(turn, turn)], dtype=np.float64)
            )
            if square > 0.0:
                self._factor = min(MAX_FACTOR, max(MIN_FACTOR, -self._factor * dot / square))
        self._change = change
        return self._loads + self._factor * change

    def record(self, loads: Array) -> None:
        """Note the loads (n_owned, 3) [N] of the last solve."""
        self._loads = loads
