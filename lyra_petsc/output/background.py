"""File operations of rank 0 in a thread of its own, while the steps go on."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from mpi4py import MPI

from lyra_petsc.errors import LyraError
from lyra_petsc.output.agreement import raise_together


class Background:
    """One task at a time, in a thread of rank 0; a task must not call MPI.

    Parameters
    ----------
    comm : MPI.Comm
        All ranks.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="lyra-petsc files")
        self._work: Future[None] | None = None

    def begin(self, work: Callable[[], None]) -> None:
        """Start a task on rank 0; call `settle` before."""
        if self._comm.rank == 0:
            self._work = self._worker.submit(work)

    def settle(self) -> None:
        """Wait for the task; collective.

        Raises
        ------
        LyraError
            On every rank what the task raised, once.
        """
        problem = None if self._work is None else self._work.exception()
        self._work = None
        if problem is not None and not isinstance(problem, LyraError):
            raise problem  # a mistake of ours, which ends the other ranks as any does
        raise_together(self._comm, problem)

    def close(self) -> None:
        """Wait for the task and end the thread; errors of the task are dropped. For one rank."""
        self._worker.shutdown()
