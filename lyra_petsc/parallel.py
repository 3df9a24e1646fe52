"""Operations on all ranks: work on rank 0 whose result or error is broadcast, machine layout, signals."""

from __future__ import annotations

import errno
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar, overload

from lyra_petsc.errors import InputError, LyraError

if TYPE_CHECKING:
    from mpi4py import MPI

Result = TypeVar("Result")

GRACE = 5.0
"""Time [s] for which a rank that failed waits for the other ranks to fail as well."""


class SingleProcess:
    """Stands for a communicator in a process without MPI."""

    rank, size = 0, 1

    def bcast(self, value: Result, root: int = 0) -> Result:
        """The value."""
        return value

    def allgather(self, value: Result) -> list[Result]:
        """The value of the only rank."""
        return [value]

    gather = allgather

    def allreduce(self, value: Result, op: object = None) -> Result:
        """The value."""
        return value


ALONE: Any = SingleProcess()
"""The only rank of a process without MPI."""


def restore_signal_handlers() -> None:
    """Restore Python's handlers of SIGPIPE and SIGHUP, which PETSc replaces when it is initialised.

    With PETSc's handlers, a closed pipe or terminal would end the process.
    """
    for number in (signal.SIGPIPE, signal.SIGHUP):
        with suppress(ValueError):  # not in the main thread
            signal.signal(number, signal.getsignal(number))


def all_ranks_arrive(comm: MPI.Comm) -> bool:
    """Whether all ranks call this function within `GRACE` seconds, each after an error of its own.

    If it returns False, no collective operation may follow on this communicator.
    """
    if comm.size == 1:
        return True
    request, deadline = comm.Ibarrier(), time.monotonic() + GRACE
    while not request.Test():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


def on_one_machine(comm: MPI.Comm) -> bool:
    """Whether all ranks share a machine. The first call is collective; the communicator keeps the result."""
    from mpi4py import MPI

    known = comm.Get_attr(_one_machine())
    if known is None:
        here = comm.Split_type(MPI.COMM_TYPE_SHARED)
        known = here.size == comm.size
        here.Free()
        comm.Set_attr(_one_machine(), known)
    return bool(known)


@cache
def _one_machine() -> int:
    from mpi4py import MPI

    return int(MPI.Comm.Create_keyval())


@overload
def on_root(comm: MPI.Comm, work: Callable[[], Result]) -> Result: ...
@overload
def on_root(comm: MPI.Comm, work: Callable[[], Result], *, share: bool) -> Result | None: ...
def on_root(comm: MPI.Comm, work: Callable[[], Result], *, share: bool = True) -> Result | None:
    """Run ``work`` on rank 0 only; every rank returns the result or raises the error of ``work``.

    Parameters
    ----------
    comm : MPI.Comm
        The communicator; collective.
    work : callable
        Called without arguments on rank 0.
    share : bool
        With ``False``, for results as large as a mesh, only success or the error is broadcast; the
        other ranks get ``None``.

    Raises
    ------
    LyraError
        On every rank, the error that ``work`` raised on rank 0.
    """
    result: Result | None = None
    problem: LyraError | None = None
    if comm.rank == 0:
        try:
            result = work()
        except LyraError as error:
            problem = error
        except OSError as error:
            if error.errno != errno.ENAMETOOLONG:
                raise
            problem = InputError("file name too long", file=error.filename)  # all names are user input
    problem, shared = comm.bcast((problem, result if share else None), root=0)
    if problem is not None:
        raise problem
    return result if comm.rank == 0 else shared
