"""Writing and reading distributed arrays in HDF5 files.

Rank 0 creates a file with all of its datasets, at its full size on disk. Afterwards only rows of datasets
change, never HDF5's own data. The file can therefore be read at any time, a killed process leaves a readable
file, and a full disk is found before anything is written: HDF5 crashes if a file cannot grow while it is
closed.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.output.file_operations import HDF5_ERRORS, on_every_rank, open_output, writing
from lyra_petsc.output.stored import import_h5py, open_stored
from lyra_petsc.parallel import on_one_machine, on_root

if TYPE_CHECKING:
    from mpi4py import MPI

    from lyra_petsc.output.ordering import FileOrder

Attributes: TypeAlias = Mapping[str, Mapping[str, int | float | str | np.uint64]]
"""Attributes of groups and datasets by their path in the file."""

# upper bounds of the bytes that a file needs besides data and attributes: in total, and per dataset
MAX_OVERHEAD = 1 << 16
DATASET_OVERHEAD = 1 << 10

BLOCK = 1 << 22
"""Number of bytes that rank 0 gathers and writes at a time."""


class Empty(NamedTuple):
    """A dataset whose rows are written later."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


@contextmanager
def new_file(
    path: Path, content: Mapping[str, NDArray[Any] | Empty], attributes: Attributes
) -> Iterator[Any]:
    """A context with a new file open, of full size, that replaces ``path`` at its end. Call on one rank.

    Raises
    ------
    OutputError
        If the file cannot be written, also within the context; then an existing file is kept.
    """
    h5py, part = import_h5py(), path.with_name(path.name + ".part")
    data = sum(math.prod(rows.shape) * rows.dtype.itemsize for rows in content.values())
    texts = sum(len(str(value).encode()) for values in attributes.values() for value in values.values())
    early = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    early.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    early.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    with_groups = h5py.h5p.create(h5py.h5p.LINK_CREATE)
    with_groups.set_create_intermediate_group(True)
    with writing(path, HDF5_ERRORS):
        try:
            with open_output(part) as raw:
                size = data + texts + MAX_OVERHEAD + DATASET_OVERHEAD * len(content)
                os.posix_fallocate(raw.fileno(), 0, size)
            # older formats of groups and headers have no check sums, and HDF5 crashes if they are damaged
            with h5py.File(part, "w", libver=("v108", "v108")) as file:
                for name, rows in content.items():
                    kind, space = h5py.h5t.py_create(rows.dtype), h5py.h5s.create_simple(rows.shape)
                    h5py.h5d.create(file.id, name.encode(), kind, space, early, with_groups)
                    if isinstance(rows, np.ndarray):
                        put_rows(file, name, 0, np.ascontiguousarray(rows))
                for name, values in attributes.items():
                    owner = file[name] if name in file else file.create_group(name)
                    for key, value in values.items():
                        # fixed-length text: HDF5 stores text of variable length in a heap without check sums
                        text = value.encode() if isinstance(value, str) else b""
                        kind = (
                            h5py.string_dtype("utf-8", max(1, len(text))) if isinstance(value, str) else None
                        )
                        owner.attrs.create(key, text if kind else value, dtype=kind)
                file.flush()
                with open_output(part, "r+b") as raw:
                    os.posix_fallocate(raw.fileno(), 0, file.id.get_filesize())
                yield file
            os.replace(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def put_rows(file: Any, name: str, start: int, rows: NDArray[Any]) -> None:
    """Write consecutive rows, from number ``start`` on, to a dataset of an open file.

    By h5py's low-level interface, as is the creation of datasets: the other one takes half as long again for
    a small state with its checkpoint.
    """
    h5py = import_h5py()
    dataset = h5py.h5d.open(file.id, name.encode())
    space = dataset.get_space()
    space.select_hyperslab((start, *(0 for _ in rows.shape[1:])), rows.shape)
    dataset.write(h5py.h5s.create_simple(rows.shape), space, rows)


def create_file(
    path: Path, content: Mapping[str, NDArray[Any] | Empty], attributes: Attributes = MappingProxyType({})
) -> None:
    """Create a file as by `new_file`."""
    with new_file(path, content, attributes):
        pass


def write_rows(
    path: Path, slabs: Mapping[str, NDArray[Any]], comm: MPI.Comm, create: Attributes | None = None
) -> None:
    """Write distributed arrays to datasets of a file, which `file_operations.sync` brings to disk.

    The ranks of several machines write at the same time, if h5py is built with MPI. Otherwise rank 0 writes
    all rows, which it receives in blocks; on one machine this is the faster way.

    Parameters
    ----------
    path : Path
    slabs : mapping of str to (n, ...) array
        This rank's rows of each dataset, which are stored in rank order. Names, types and trailing shapes
        are the same on every rank; a rank may have no rows.
    comm : MPI.Comm
        All ranks; collective.
    create : mapping, optional
        Create the file for these arrays first, with these attributes; otherwise it exists, with its datasets.

    Raises
    ------
    OutputError
        On every rank, if a rank cannot write.
    """
    slabs = {name: np.ascontiguousarray(rows) for name, rows in slabs.items()}
    lengths = np.array(comm.allgather([len(rows) for rows in slabs.values()])).reshape(comm.size, len(slabs))
    starts = np.concatenate([np.zeros((1, len(slabs)), int), lengths.cumsum(axis=0)])
    totals = zip(slabs.items(), starts[-1].tolist(), strict=True)
    empty = {name: Empty((n, *rows.shape[1:]), rows.dtype) for (name, rows), n in totals}

    def write(opened: AbstractContextManager[Any], blocks: Iterable[tuple[str, int, NDArray[Any]]]) -> None:
        with opened as file:
            for name, start, rows in blocks:
                put_rows(file, name, start, rows)

    if import_h5py().get_config().mpi and not on_one_machine(comm):
        if create is not None:
            on_root(comm, lambda: create_file(path, empty, create))
        mine = zip(slabs, starts[comm.rank].tolist(), slabs.values(), strict=True)
        on_every_rank(comm, lambda: write(rows_writable(path, driver="mpio", comm=comm), mine))
        return
    blocks = _gathered_blocks(slabs, starts, comm)

    def receive_and_write() -> None:
        try:
            write(rows_writable(path) if create is None else new_file(path, empty, create), blocks)
        finally:
            for _ in blocks:  # other ranks wait until their rows are received
                pass

    for _ in blocks if comm.rank else ():  # sends this rank's rows
        pass
    on_root(comm, receive_and_write)


def _gathered_blocks(
    slabs: Mapping[str, NDArray[Any]], starts: NDArray[np.int64], comm: MPI.Comm
) -> Iterator[tuple[str, int, NDArray[Any]]]:
    """Dataset, first row and rows of each block of all ranks' rows on rank 0; other ranks send theirs."""
    for (name, own), bounds in zip(slabs.items(), starts.T.tolist(), strict=True):
        size = max(1, BLOCK // (own.itemsize * math.prod(own.shape[1:])))
        for first in range(0, bounds[-1], size):
            last = min(first + size, bounds[-1])
            parts = [min(max(bound, first), last) for bound in bounds]  # where each rank's part begins
            if comm.rank:
                begin, end = (row - bounds[comm.rank] for row in parts[comm.rank : comm.rank + 2])
                if begin < end:
                    comm.Send(own[begin:end], 0)
                continue
            block = own[first:last]
            if missing := last - first - len(block):
                block = np.concatenate([block, np.empty((missing, *own.shape[1:]), own.dtype)])
            for rank in range(1, comm.size):
                if parts[rank] < parts[rank + 1]:
                    comm.Recv(block[parts[rank] - first : parts[rank + 1] - first], rank)
            yield name, first, block


@contextmanager
def rows_writable(path: Path, **how: Any) -> Iterator[Any]:
    """A context with an existing file open, to write rows of its datasets; it must not be a link.

    Raises
    ------
    OutputError
        If the file cannot be written, also within the context.
    """
    with writing(path, HDF5_ERRORS):
        open_output(path, "r+b").close()  # HDF5 would follow a link
        with import_h5py().File(path, "r+", **how) as file:
            yield file


def read_slab(path: str | os.PathLike[str], dataset: str, order: FileOrder) -> NDArray[Any]:
    """This rank's slab of a dataset, which any number of ranks may have written.

    Parameters
    ----------
    path : path
        An HDF5 file that every rank can open.
    dataset : str
        Name of an (n_global, ...) dataset.
    order : FileOrder
        Defines the slabs; collective over its ranks.

    Returns
    -------
    (n_slab, ...) array

    Raises
    ------
    InputError
        On every rank, if the file is damaged or the dataset is missing or has another length.
    """

    def work() -> NDArray[Any]:
        with open_stored(Path(path)) as file:
            stored = file[dataset]
            if stored.shape[:1] != (order.n_global,):
                rows = stored.shape[0] if stored.shape else "no"
                raise InputError(f"{dataset} has {rows} rows, {order.n_global} are expected", file=path)
            return np.asarray(stored[order.start : order.start + order.n_slab])

    return on_every_rank(order.comm, work)
