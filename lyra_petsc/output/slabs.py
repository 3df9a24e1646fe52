"""How slabs get into an HDF5 file that is laid out already: by all ranks, or through rank 0."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import LyraError, OutputError
from lyra_petsc.output.agreement import HDF5_ERRORS, missing_folder, raise_together, reason
from lyra_petsc.output.h5py_loader import import_h5py


def cannot_write(path: Path, error: BaseException) -> OutputError:
    return OutputError(f"{path}: cannot be written: {missing_folder(path) or reason(error)}")


def _write_rows(dataset: Any, start: int, slab: NDArray[Any], transfer: Any) -> None:
    """Write (n, ...) rows at ``start``; takes part in a collective write also with n = 0."""
    h5py = import_h5py()
    target, source = dataset.id.get_space(), h5py.h5s.create_simple(slab.shape)
    if slab.size:
        target.select_hyperslab((start,) + (0,) * (slab.ndim - 1), slab.shape)
    else:
        target.select_none()
        source.select_none()
    dataset.id.write(source, target, slab, dxpl=transfer)


def write_by_all(
    path: Path,
    part: Path,
    slabs: Mapping[str, NDArray[Any]],
    counts: Mapping[str, list[int]],
    comm: MPI.Comm,
) -> bool:
    """All ranks write at once; ``False`` if none could open the file so (two different MPIs)."""
    h5py = import_h5py()
    problem: LyraError | None = None
    try:
        file = h5py.File(part, "r+", driver="mpio", comm=comm)
    except HDF5_ERRORS as error:
        problem = cannot_write(path, error)
    if comm.allreduce(problem is not None, MPI.LAND):
        return False
    raise_together(comm, problem)

    transfer = h5py.h5p.create(h5py.h5p.DATASET_XFER)
    transfer.set_dxpl_mpio(h5py.h5fd.MPIO_COLLECTIVE)
    for name, slab in slabs.items():
        try:
            _write_rows(file[name], sum(counts[name][: comm.rank]), slab, transfer)
        except HDF5_ERRORS as error:
            problem = problem or cannot_write(path, error)
    try:
        file.close()
    except HDF5_ERRORS as error:
        problem = problem or cannot_write(path, error)
    raise_together(comm, problem)
    return True


def write_by_root(
    path: Path,
    part: Path,
    slabs: Mapping[str, NDArray[Any]],
    counts: Mapping[str, list[int]],
    comm: MPI.Comm,
) -> None:
    """Rank 0 writes slab after slab, holding one of another rank at a time."""
    if comm.rank > 0:
        raise_together(comm, None)  # opened on rank 0?
        for slab in slabs.values():
            _transfer(comm.Send, slab, 0)
        raise_together(comm, None)
        return

    problem: LyraError | None = None
    try:
        file = import_h5py().File(part, "r+")
    except HDF5_ERRORS as error:
        problem = cannot_write(path, error)
    raise_together(comm, problem)
    for name, slab in slabs.items():
        start = 0
        for rank, count in enumerate(counts[name]):
            arrived = slab if rank == 0 else np.empty((count, *slab.shape[1:]), slab.dtype)
            if rank > 0:  # received even after a failure: the sender must not wait for ever
                _transfer(comm.Recv, arrived, rank)
            try:
                if problem is None and count:
                    _write_rows(file[name], start, arrived, None)
            except HDF5_ERRORS as error:
                problem = cannot_write(path, error)
            start += count
    try:
        file.close()
    except HDF5_ERRORS as error:
        problem = problem or cannot_write(path, error)
    raise_together(comm, problem)


def _transfer(send_or_receive: Callable[..., None], slab: NDArray[Any], other: int) -> None:
    # counting in rows keeps the count within 32 bits
    width = slab.dtype.itemsize * int(np.prod(slab.shape[1:], dtype=np.int64))
    row_type = MPI.BYTE.Create_contiguous(width).Commit()
    try:
        send_or_receive([slab, len(slab), row_type], other)
    finally:
        row_type.Free()
