"""SIGINT, SIGTERM and SIGUSR1 ask a run to finish its step, write a checkpoint and leave."""

from __future__ import annotations

import signal
from types import FrameType

from mpi4py import MPI

WATCHED = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)


class StopRequest:
    """Notes the first signal that this rank gets; a second SIGINT ends it at once."""

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._seen = 0
        for number in WATCHED:
            signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._seen and number == signal.SIGINT:
            self._comm.Abort(130)
        self._seen = self._seen or number

    def signal_number(self) -> int:
        """The signal that any rank has got, else 0; collective."""
        return int(self._comm.allreduce(self._seen, MPI.MAX))
