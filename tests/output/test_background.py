"""Work that rank 0 does in the background: waiting for it, and reporting its failures on all ranks."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from lyra_petsc.errors import OutputError
from lyra_petsc.output.hdf5 import Background, NewFile, write_collective

pytestmark = pytest.mark.parallel(3)


def fail() -> None:
    raise OutputError("a.h5: cannot be written: No space left on device")


def test_work_continues_in_the_background_and_is_waited_for(comm: MPI.Comm) -> None:
    background, go, done = Background(comm), threading.Event(), []

    def work() -> None:
        go.wait()
        done.append(comm.rank)

    background.submit(work)
    assert not done
    go.set()
    background.wait()
    assert done == [0] * (comm.rank == 0)
    background.close()


def test_failures_are_reported_once_on_every_rank(comm: MPI.Comm) -> None:
    background = Background(comm)
    background.submit(fail)
    with pytest.raises(OutputError, match="No space left"):
        background.wait()
    background.wait()
    background.close()


def test_programming_errors_are_not_hidden(comm: MPI.Comm) -> None:
    background = Background(comm)
    background.submit(lambda: [][0])
    if comm.rank == 0:
        with pytest.raises(IndexError):
            background.wait()
    background.close()


def test_files_are_renamed_when_waiting_is_over(comm: MPI.Comm, shared_tmp: Path) -> None:
    background, go, row = Background(comm), threading.Event(), {"x": np.full(3, float(comm.rank))}

    def last_word() -> None:
        go.wait()
        fail()

    first = NewFile(shared_tmp / "a.h5", row, {}, publish=last_word)
    write_collective([first], comm, background)
    go.set()
    with pytest.raises(OutputError, match="No space left"):
        write_collective([NewFile(shared_tmp / "b.h5", row, {})], comm, background)
    comm.Barrier()
    assert [path.name for path in shared_tmp.iterdir()] == ["a.h5"]
    background.close()
