"""Loads that follow the shape, found by iteration: under-relaxed, so that it does not swing.

Source: Aitken's Δ² for vectors, Irons & Tuck, Int. J. Numer. Meth. Engng 1 (1969) 275-277.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array

LEAST, MOST = 0.02, 1.0


class Relaxation:
    """The loads to solve with next, from those last solved with and those of the shape that came out."""

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._share = MOST
        self._loads: Array | None = None
        self._change: Array | None = None

    def following(self, loads: Array) -> Array:
        """Loads (n_owned, 3) [N] for the next solve; ``loads`` are those at the present shape; collective."""
        if self._loads is None:
            return loads
        change = loads - self._loads
        if self._change is not None:
            turn = change - self._change
            dot, square = self._comm.allreduce(
                np.array([np.vdot(self._change, turn), np.vdot(turn, turn)], dtype=np.float64)
            )
            if square > 0.0:
                self._share = min(MOST, max(LEAST, -self._share * dot / square))
        self._change = change
        return self._loads + self._share * change

    def solved_with(self, loads: Array) -> None:
        """These loads (n_owned, 3) [N] were in balance, or nearly."""
        self._loads = loads
