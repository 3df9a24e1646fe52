"""How the ranks' slabs get into a file that is laid out already.

On one machine all ranks write at once, as processes may; on several they do so through MPI-IO, or where
that fails one after the other.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import LyraError, OutputError
from lyra_petsc.output.agreement import HDF5_ERRORS, missing_folder, on_each, raise_together, reason
from lyra_petsc.output.ordering import row_type
from lyra_petsc.parallel import on_one_machine

TURNS_VARIABLE = "LYRA_PETSC_WRITE_IN_TURN"
"""Set to 1 for rank 0 where MPI-IO opens files, but fails to write them."""

Piece = tuple[int, NDArray[Any]]
"""Offset in the file [bytes] of a rank's rows of a dataset, and the rows; they are contiguous."""


def cannot_write(path: Path, error: BaseException) -> OutputError:
    return OutputError(f"{path}: cannot be written: {missing_folder(path) or reason(error)}")


def write_slabs(path: Path, part: Path, pieces: Sequence[Piece], comm: MPI.Comm) -> None:
    """Write each rank's pieces; collective. What other machines than rank 0's wrote is on the disk then.

    Parameters
    ----------
    path : Path
        What the file will be called; for messages.
    part : Path
        The file as it is called now; holds room for all pieces.
    pieces : sequence of (int, (n, ...) array)
        As many on every rank; n may be 0.
    comm : MPI.Comm
        All ranks.

    Raises
    ------
    OutputError
        On every rank, if any could not write.
    """
    if on_one_machine(comm):
        on_each(comm, lambda: _write_alone(path, part, pieces, sync=False))
        return
    in_turn = comm.bcast(os.environ.get(TURNS_VARIABLE) == "1", root=0)
    if in_turn or not _write_through_mpi(path, part, pieces, comm):
        for rank in range(comm.size):
            mine = pieces if rank == comm.rank else ()
            on_each(comm, partial(_write_alone, path, part, mine, sync=True))


def _write_alone(path: Path, part: Path, pieces: Sequence[Piece], *, sync: bool) -> None:
    """These pieces, if there are any, into a plain file."""
    if not pieces:
        return
    try:
        with open(part, "r+b", buffering=0) as file:
            for offset, rows in pieces:
                _write_rows(file, offset, rows)
            if sync:
                os.fsync(file.fileno())
    except OSError as error:
        raise cannot_write(path, error) from error


def _write_rows(file: FileIO, offset: int, rows: NDArray[Any]) -> None:
    file.seek(offset)
    left = rows.reshape(-1).view(np.uint8).data
    while left:  # one call writes 2 GiB at most
        left = left[file.write(left) :]


def _write_through_mpi(path: Path, part: Path, pieces: Sequence[Piece], comm: MPI.Comm) -> bool:
    """All ranks at once; ``False`` if no rank could open the file so."""
    problem: LyraError | None = None
    try:
        file = MPI.File.Open(MPI.Intracomm(comm), os.fspath(part), MPI.MODE_RDWR)
    except MPI.Exception as error:
        problem = cannot_write(path, error)
    if comm.allreduce(problem is not None, MPI.LAND):
        return False
    raise_together(comm, problem)

    for offset, rows in pieces:
        try:
            _write_rows_together(file, offset, rows)
        except HDF5_ERRORS as error:
            problem = problem or cannot_write(path, error)
    try:
        file.Sync()
        file.Close()
    except HDF5_ERRORS as error:
        problem = problem or cannot_write(path, error)
    raise_together(comm, problem)
    return True


def _write_rows_together(file: MPI.File, offset: int, rows: NDArray[Any]) -> None:
    with row_type(rows) as kind:
        file.Write_at_all(offset, [rows, len(rows), kind])
