"""Writing and reading distributed arrays in HDF5 files.

Rank 0 creates a file with all of its datasets, at its full size on disk. Afterwards only rows of datasets
change, never HDF5's own data. The file can therefore be read at any time, a killed process leaves a readable
file, and a full disk is found before anything is written: HDF5 crashes if a file cannot grow while it is
closed.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.output.file_operations import HDF5_ERRORS, on_every_rank, open_output, writing
from lyra_petsc.output.stored import import_h5py, open_stored
from lyra_petsc.parallel import on_one_machine, on_root

if TYPE_CHECKING:
    from lyra_petsc.output.ordering import FileOrder

Attributes: TypeAlias = Mapping[str, Mapping[str, int | float | str | np.uint64]]
"""Attributes of groups and datasets by their path in the file."""

# upper bounds of the bytes that a file needs besides data and attributes: in total, and per dataset
MAX_OVERHEAD = 1 << 16
DATASET_OVERHEAD = 1 << 10

BLOCK = 1 << 22
"""Number of bytes that rank 0 receives and writes at a time."""


class Empty(NamedTuple):
    """A dataset whose rows are written later."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


def create_file(
    path: Path, content: Mapping[str, NDArray[Any] | Empty], attributes: Attributes = MappingProxyType({})
) -> None:
    """Create a file, or replace it atomically. Call on one rank.

    Raises
    ------
    OutputError
        If the file cannot be written; then an existing file is kept.
    """
    part = path.with_name(path.name + ".part")
    with writing(path, HDF5_ERRORS):
        try:
            _create(part, content, attributes)
            os.replace(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def write_rows(
    path: Path,
    slabs: Mapping[str, NDArray[Any]],
    comm: MPI.Comm,
    prepare: Callable[[Sequence[int]], None] = lambda lengths: None,
    publish: Callable[[], None] = lambda: None,
) -> None:
    """Write distributed arrays to datasets of an existing file.

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
    prepare : callable
        Called on rank 0 with the number of rows of each dataset, before any is written.
    publish : callable
        Called on rank 0 after all rows are written.

    Raises
    ------
    OutputError
        On every rank, if a rank cannot write.
    """
    slabs = {name: np.ascontiguousarray(rows) for name, rows in slabs.items()}
    lengths = np.array(comm.allgather([len(rows) for rows in slabs.values()])).reshape(comm.size, len(slabs))
    in_parallel = import_h5py().get_config().mpi and not on_one_machine(comm)

    def write(blocks: Iterable[tuple[str, int, NDArray[Any]]]) -> None:
        with rows_writable(path, **({"driver": "mpio", "comm": comm} if in_parallel else {})) as file:
            for name, start, rows in blocks:
                file[name][start : start + len(rows)] = rows

    if in_parallel:
        on_root(comm, lambda: prepare(lengths.sum(axis=0).tolist()))
        starts = lengths[: comm.rank].sum(axis=0).tolist()
        on_every_rank(comm, lambda: write(zip(slabs, starts, slabs.values(), strict=True)))
        on_root(comm, publish)
        return
    for rows in slabs.values() if comm.rank else ():
        for block in _blocks(rows):
            comm.Send(block, 0)

    def receive_and_write() -> None:
        arriving = _arriving_blocks(slabs, lengths, comm)
        try:
            prepare(lengths.sum(axis=0).tolist())
            write(arriving)
        finally:
            for _ in arriving:  # other ranks wait until their rows are received
                pass
        publish()

    on_root(comm, receive_and_write)


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


def _arriving_blocks(
    slabs: Mapping[str, NDArray[Any]], lengths: NDArray[Any], comm: MPI.Comm
) -> Iterator[tuple[str, int, NDArray[Any]]]:
    """Dataset, first row and rows of each block of all ranks' rows (rank 0)."""
    for (name, own), counts in zip(slabs.items(), lengths.T.tolist(), strict=True):
        start = 0
        for rank, count in enumerate(counts):
            rows = own if rank == 0 else np.broadcast_to(own.dtype.type(0), (count, *own.shape[1:]))
            for block in _blocks(rows):
                if rank:
                    block = np.empty(block.shape, own.dtype)
                    comm.Recv(block, rank)
                yield name, start, block
                start += len(block)


def _blocks(rows: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Consecutive rows of at most `BLOCK` bytes."""
    size = max(1, BLOCK // (rows.itemsize * math.prod(rows.shape[1:])))
    return (rows[i : i + size] for i in range(0, len(rows), size))


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
                raise InputError(
                    f"{dataset} has {rows} rows, {order.n_global} are expected", file=path
                )
            return np.asarray(stored[order.start : order.start + order.n_slab])

    return on_every_rank(order.comm, work)


def _create(path: Path, content: Mapping[str, NDArray[Any] | Empty], attributes: Attributes) -> None:
    """Create a file of full size.

    Raises
    ------
    One of `HDF5_ERRORS`
        If the file cannot be created.
    """
    h5py = import_h5py()
    data = sum(math.prod(rows.shape) * rows.dtype.itemsize for rows in content.values())
    texts = sum(len(str(value).encode()) for values in attributes.values() for value in values.values())
    early = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    early.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    early.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    with open_output(path) as raw:
        os.posix_fallocate(raw.fileno(), 0, data + texts + MAX_OVERHEAD + DATASET_OVERHEAD * len(content))
    # older formats of groups and headers have no check sums, and HDF5 crashes if they are damaged
    with h5py.File(path, "w", libver=("v108", "v108")) as file:
        owners = {"/": file}
        for name, rows in content.items():
            owners[name] = file.create_dataset(name, rows.shape, rows.dtype, dcpl=early)
            if isinstance(rows, np.ndarray):
                owners[name][...] = rows
        for name, values in attributes.items():
            owner = owners[name] if name in owners else file.require_group(name)
            for key, value in values.items():
                # fixed-length text: HDF5 stores text of variable length in a heap without check sums
                text = value.encode() if isinstance(value, str) else b""
                kind = h5py.string_dtype("utf-8", max(1, len(text))) if isinstance(value, str) else None
                owner.attrs.create(key, text if kind else value, dtype=kind)
    with open_output(path, "r+b") as raw:
        os.posix_fallocate(raw.fileno(), 0, os.fstat(raw.fileno()).st_size)
