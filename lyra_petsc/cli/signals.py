"""Signals: a run finishes its step and writes a checkpoint; before that the process ends at once."""

from __future__ import annotations

import os
import signal
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mpi4py import MPI

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
HANGUP = signal.SIGHUP
"""The terminal was closed; under nohup this signal is ignored, and stays so."""


def stop_signals() -> tuple[signal.Signals, ...]:
    """The signals that request a run to stop."""
    return STOP_SIGNALS if signal.getsignal(HANGUP) == signal.SIG_IGN else (*STOP_SIGNALS, HANGUP)


def exit_on_signals() -> None:
    """Let the stop signals end the process at once without a message, until a run handles them.

    A launcher may have blocked them, since they would end Python with another exit code before this.
    """
    for number in stop_signals():
        signal.signal(number, _exit)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, stop_signals())


def _exit(number: int, frame: FrameType | None) -> None:
    os._exit(130 if number == signal.SIGINT else 143)


class StopRequest:
    """Records the first stop signal that this rank receives; a second SIGINT ends the job at once."""

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._received = 0
        for number in stop_signals():
            signal.signal(number, self._record)

    def _record(self, number: int, frame: FrameType | None) -> None:
        if self._received and number == signal.SIGINT:
            self._comm.Abort(130)
        self._received = self._received or number

    def signal_number(self) -> int:
        """The signal that any rank has received, else 0; collective."""
        return int(self._comm.allreduce(self._received, max))
