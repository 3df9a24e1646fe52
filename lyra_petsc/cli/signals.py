"""Signals: a run finishes its step and writes a checkpoint; during the set-up the process ends at once."""

from __future__ import annotations

import os
import signal
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mpi4py import MPI

ASKED = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
LOST = signal.SIGHUP
"""The terminal was closed; ignored under nohup, where it stays so."""


def watched() -> tuple[signal.Signals, ...]:
    """The signals that ask a run to stop."""
    return ASKED if signal.getsignal(LOST) == signal.SIG_IGN else (*ASKED, LOST)


def leave_at_once() -> None:
    """Let these signals end the process without a message, until a run watches them."""
    for number in watched():
        signal.signal(number, _leave)


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(130 if number == signal.SIGINT else 143)


class StopRequest:
    """Notes the first signal that this rank receives; a second SIGINT ends the job at once."""

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._seen = 0
        for number in watched():
            signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._seen and number == signal.SIGINT:
            self._comm.Abort(130)
        self._seen = self._seen or number

    def signal_number(self) -> int:
        """The signal that any rank has received, else 0; collective."""
        from mpi4py import MPI

        return int(self._comm.allreduce(self._seen, MPI.MAX))
