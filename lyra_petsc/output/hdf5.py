"""Distributed arrays to and from HDF5 files, with or without an MPI build of h5py.

A file is built in three steps, so that a full disk is met where it does no harm: rank 0
reserves the whole size and lays the file out, then the ranks write their slabs, then the
finished file takes its name. (An HDF5 file that cannot grow while it is closed takes the
process down with it.)
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.output.agreement import HDF5_ERRORS, raise_together, reason
from lyra_petsc.output.h5py_loader import import_h5py
from lyra_petsc.output.slabs import cannot_write, write_by_all, write_by_root
from lyra_petsc.parallel import on_root

if TYPE_CHECKING:
    from lyra_petsc.output.ordering import FileOrder

Attributes = Mapping[str, Mapping[str, int | float | str]]

# set to 1 to write through rank 0 even where h5py could write collectively
SERIAL_VARIABLE = "LYRA_PETSC_SERIAL_HDF5"

# bytes that a file with a few dozen datasets needs beyond their data and attributes
LARGEST_OVERHEAD = 1 << 16


def writes_collectively(comm: MPI.Comm) -> bool:
    """Whether all ranks can write to one file at the same time. Collective."""
    if comm.size == 1:
        return False
    able = bool(import_h5py().get_config().mpi) and os.environ.get(SERIAL_VARIABLE, "0") in ("", "0")
    return bool(comm.allreduce(able, MPI.LAND))


def write_collective(
    path: str | os.PathLike[str],
    datasets: Mapping[str, NDArray[Any]],
    attributes: Attributes,
    comm: MPI.Comm,
) -> None:
    """Write distributed arrays to a new HDF5 file, which appears under its name when complete.

    Parameters
    ----------
    path : path
        The file; one that exists is replaced.
    datasets : mapping of str to (n_slab, ...) array
        This rank's rows of each dataset; ranks' rows follow each other in rank order. Names,
        types and trailing shapes are the same on every rank; a rank may have no rows.
    attributes : mapping of str to mapping
        Attributes of groups and datasets, by their path in the file; read on rank 0.
    comm : MPI.Comm
        All ranks; collective.

    Raises
    ------
    OutputError
        On every rank, if the file could not be written; what stood there before stands.
    """
    path = Path(path)
    part = path.with_name(path.name + ".part")
    slabs = {name: np.ascontiguousarray(slab) for name, slab in datasets.items()}
    counts = {name: comm.allgather(len(slab)) for name, slab in slabs.items()}
    try:
        rows = {name: sum(count) for name, count in counts.items()}
        on_root(comm, lambda: _guarded(path, lambda: _lay_out(part, slabs, rows, attributes)))
        if not (writes_collectively(comm) and write_by_all(path, part, slabs, counts, comm)):
            write_by_root(path, part, slabs, counts, comm)
        on_root(comm, lambda: _guarded(path, lambda: _finish(part, path)))
    except LyraError:
        if comm.rank == 0:
            part.unlink(missing_ok=True)
        raise


def read_slab(path: str | os.PathLike[str], dataset: str, order: FileOrder) -> NDArray[Any]:
    """This rank's slab of a dataset, whatever number of ranks wrote it.

    Parameters
    ----------
    path : path
        An HDF5 file that every rank can open.
    dataset : str
        Name of an (n_global, ...) dataset.
    order : FileOrder
        The slabs; collective over its ranks.

    Returns
    -------
    (n_slab, ...) array

    Raises
    ------
    InputError
        On every rank, if the file is damaged or the dataset missing or of another length.
    """
    problem: LyraError | None = None
    slab: NDArray[Any] = np.empty(0)
    try:
        with import_h5py().File(path, "r") as file:
            stored = file[dataset]
            if stored.shape[:1] != (order.n_global,):
                problem = InputError(
                    f"{dataset} has {stored.shape[0] if stored.shape else 'no'} rows, "
                    f"{order.n_global} are expected",
                    file=path,
                )
            else:
                slab = stored[order.start : order.start + order.n_slab]
    except HDF5_ERRORS as error:
        problem = InputError(f"{dataset} cannot be read: {reason(error)}", file=path)
    raise_together(order.comm, problem)
    return slab


def _guarded(path: Path, work: Callable[[], None]) -> None:
    try:
        work()
    except HDF5_ERRORS as error:
        raise cannot_write(path, error) from error


def _lay_out(
    part: Path, slabs: Mapping[str, NDArray[Any]], rows: Mapping[str, int], attributes: Attributes
) -> None:
    """Create the file with every dataset in its place and its whole size reserved on disk."""
    h5py = import_h5py()
    texts = sum(len(str(value)) for values in attributes.values() for value in values.values())
    data = sum(rows[name] * slab.itemsize * math.prod(slab.shape[1:]) for name, slab in slabs.items())
    with open(part, "wb") as raw:
        os.posix_fallocate(raw.fileno(), 0, data + texts + LARGEST_OVERHEAD)
    early = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    early.set_layout(h5py.h5d.CONTIGUOUS)
    early.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    early.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    links = h5py.h5p.create(h5py.h5p.LINK_CREATE)
    links.set_create_intermediate_group(True)
    with h5py.File(part, "w") as file:
        for name, slab in slabs.items():
            space = h5py.h5s.create_simple((rows[name], *slab.shape[1:]))
            kind = h5py.h5t.py_create(slab.dtype, logical=True)
            h5py.h5d.create(file.id, name.lstrip("/").encode(), kind, space, early, links)
        for owner, values in attributes.items():
            for key, value in values.items():
                (file[owner] if owner in file else file.create_group(owner)).attrs[key] = value
    with open(part, "r+b") as raw:
        os.posix_fallocate(raw.fileno(), 0, max(part.stat().st_size, 1))


def _finish(part: Path, path: Path) -> None:
    with open(part, "rb") as raw:
        os.fsync(raw.fileno())
    os.replace(part, path)
