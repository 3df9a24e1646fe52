"""Decisions that all ranks share: made on one rank, told to all."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from mpi4py import MPI

from lyra_petsc.errors import LyraError

Result = TypeVar("Result")


def on_root(comm: MPI.Comm, work: Callable[[], Result], *, share: bool = True) -> Result | None:
    """Run ``work`` on rank 0 only; every rank gets its result or raises its error.

    Parameters
    ----------
    comm : MPI.Comm
        The communicator; collective.
    work : callable
        Called without arguments on rank 0.
    share : bool
        With ``False`` the result stays on rank 0 (others get ``None``) and only the
        outcome is told: for results as large as a mesh.

    Raises
    ------
    LyraError
        What ``work`` raised, on every rank alike, so that all leave together.
    """
    result: Result | None = None
    problem: LyraError | None = None
    if comm.rank == 0:
        try:
            result = work()
        except LyraError as error:
            problem = error
    problem, shared = comm.bcast((problem, result if share else None), root=0)
    if problem is not None:
        raise problem
    return result if comm.rank == 0 else shared
