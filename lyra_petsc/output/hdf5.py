"""Distributed arrays to and from HDF5 files, by any build of h5py.

A file is built in three steps, so that a full disk is met where it does no harm: one rank reserves the whole
size and lays the file out, then all ranks write their slabs, then it is synced and renamed in the background.
(An HDF5 file that cannot grow while it is closed takes the process down with it.) As datasets are contiguous
and have their places then, the slabs need no HDF5: its collective open alone takes longer than writing a
state of moderate size. On one machine all ranks write at once, as processes may; on several they do so
through MPI-IO, or where that fails one after the other. Syncing and renaming is done by a thread of rank 0
while the steps go on.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.output.agreement import (
    HDF5_ERRORS,
    cannot_write,
    on_each,
    raise_together,
    writing,
)
from lyra_petsc.output.ordering import row_type
from lyra_petsc.output.stored import import_h5py, open_stored
from lyra_petsc.parallel import on_one_machine, on_root

if TYPE_CHECKING:
    from lyra_petsc.output.ordering import FileOrder


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


Result = TypeVar("Result")
Attributes: TypeAlias = Mapping[str, Mapping[str, int | float | str]]
Piece: TypeAlias = tuple[int, NDArray[Any]]
"""Offset in the file [bytes] of a rank's rows of a dataset, and the rows; they are contiguous."""

TURNS_VARIABLE = "LYRA_PETSC_WRITE_IN_TURN"
"""Set to 1 for rank 0 where MPI-IO opens files, but fails to write them."""

# bytes that a file needs beyond its data and attributes, and more for each dataset
LARGEST_OVERHEAD = 1 << 16
OF_A_DATASET = 1 << 10


def _nothing() -> None:
    pass


@dataclass(frozen=True)
class NewFile:
    """A file to be written.

    Attributes
    ----------
    path : Path
        One that exists is replaced.
    datasets : mapping of str to (n_slab, ...) array
        This rank's rows of each dataset; ranks' rows follow each other in rank order. Names,
        types and trailing shapes are the same on every rank; a rank may have no rows.
    attributes : mapping of str to mapping
        Attributes of groups and datasets, by their path in the file; read on rank 0.
    publish : callable
        What rank 0 does when all files have their names.
    places : sequence of int or None
        Where its datasets stand [bytes] in a file that is there already, and is written in place.
    prepare : callable
        What rank 0 does when all rows are written, before the file is synced.
    """

    path: Path
    datasets: Mapping[str, NDArray[Any]]
    attributes: Attributes
    publish: Callable[[], None] = _nothing
    places: Sequence[int] | None = None
    prepare: Callable[[], None] = _nothing

    @property
    def part(self) -> Path:
        """Its name until all files are complete."""
        return self.path if self.places is not None else self.path.with_name(self.path.name + ".part")

    def discard(self) -> None:
        """Remove the incomplete file."""
        if self.places is None:
            self.part.unlink(missing_ok=True)


def write_collective(files: Sequence[NewFile], comm: MPI.Comm, background: Background | None = None) -> None:
    """Write distributed arrays to HDF5 files; new ones get their names, in this order, when all are complete.

    Parameters
    ----------
    files : sequence of NewFile
        As many on every rank.
    comm : MPI.Comm
        All ranks; collective.
    background : Background or None
        Who syncs the files and gives them their names, after what it was given before.

    Raises
    ------
    OutputError
        On every rank, if a file could not be written; then none gets its name, and what stood there stands.
        Or if one could not be published; then the ones before it are. With ``background`` of the files
        before, and of these when it is asked next.
    """
    if background is not None:
        background.settle()
    slabs = [{name: np.ascontiguousarray(slab) for name, slab in file.datasets.items()} for file in files]
    of_ranks = comm.allgather([[len(slab) for slab in of_file.values()] for of_file in slabs])
    lengths = [np.array([of_files[number] for of_files in of_ranks]) for number in range(len(files))]

    def laid_out(number: int) -> list[int]:
        file, rows = files[number], lengths[number].sum(axis=0).tolist()
        if file.places is not None:
            return list(file.places)
        with writing(file.path, HDF5_ERRORS):
            return lay_out(file.part, slabs[number], rows, file.attributes)

    try:
        known = on_root(comm, lambda: [laid_out(number) for number in range(len(files))])
        for number, (file, places) in enumerate(zip(files, known, strict=True)):
            before = lengths[number][: comm.rank].sum(axis=0).tolist()
            pieces = [
                (place + start * slab.itemsize * math.prod(slab.shape[1:]), slab)
                for place, start, slab in zip(places, before, slabs[number].values(), strict=True)
            ]
            write_slabs(file.path, file.part, pieces, comm)
    except LyraError:
        for file in files if comm.rank == 0 else ():
            file.discard()
        raise
    if background is not None:
        background.begin(partial(_complete, files))
    else:
        on_root(comm, partial(_complete, files))


def _complete(files: Sequence[NewFile]) -> None:
    """Sync the files, then give them their names. Call on one rank."""
    try:
        for file in files:
            file.prepare()
            with writing(file.path), open(file.part, "rb") as raw:
                os.fsync(raw.fileno())
        for file in files:
            if file.places is None:
                with writing(file.path):
                    os.replace(file.part, file.path)
    except LyraError:
        for file in files:
            file.discard()
        raise
    for file in files:
        file.publish()


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

    def work() -> NDArray[Any]:
        with open_stored(Path(path)) as file:
            stored = file[dataset]
            if stored.shape[:1] != (order.n_global,):
                found = f"{dataset} has {stored.shape[0] if stored.shape else 'no'} rows"
                raise InputError(f"{found}, {order.n_global} are expected", file=path)
            return np.asarray(stored[order.start : order.start + order.n_slab])

    return on_each(order.comm, work)


def lay_out(
    part: Path, slabs: Mapping[str, NDArray[Any]], rows: Sequence[int], attributes: Attributes
) -> list[int]:
    """Create a file, its whole size reserved on disk; where each dataset is to be written [bytes].

    By the library's own calls: h5py's objects over them take 4.5 ms for a small state with its checkpoint
    instead of 2.7, and a run of the default scene 4 % (two ranks) to 6 % (one) longer.

    Parameters
    ----------
    part : Path
    slabs : mapping of str to array
        Name, type and trailing shape of each dataset.
    rows : sequence of int
        Rows of each dataset.
    attributes : mapping of str to mapping
        Attributes of groups and datasets, by their path in the file.

    Raises
    ------
    OSError and what else h5py raises
        If it cannot be created.
    """
    h5py = import_h5py()
    early, links, access, scalar = properties()
    shapes = [(count, *slab.shape[1:]) for count, slab in zip(rows, slabs.values(), strict=True)]
    data = sum(math.prod(shape) * slab.itemsize for shape, slab in zip(shapes, slabs.values(), strict=True))
    texts = sum(len(str(value).encode()) for values in attributes.values() for value in values.values())
    with open(part, "wb") as raw:
        os.posix_fallocate(raw.fileno(), 0, data + texts + LARGEST_OVERHEAD + OF_A_DATASET * len(slabs))
    file = h5py.h5f.create(os.fsencode(part), h5py.h5f.ACC_TRUNC, fapl=access)
    try:
        owners = {"/": file}
        for (name, slab), shape in zip(slabs.items(), shapes, strict=True):
            space, stored = h5py.h5s.create_simple(shape), h5py.h5t.py_create(slab.dtype, logical=True)
            owners[name] = h5py.h5d.create(file, name.encode(), stored, space, early, links)
        # a dataset without rows has no place
        places = [owners[name].get_offset() or 0 for name in slabs]
        for path, values in attributes.items():
            if path not in owners:
                owners[path] = (h5py.h5g.open if path in file else h5py.h5g.create)(file, path.encode())
            for key, value in values.items():
                # text of variable length would stand in a heap without check sums
                held = value.encode() if isinstance(value, str) else value
                kind = (
                    h5py.string_dtype("utf-8", max(1, len(held)))
                    if isinstance(held, bytes)
                    else np.dtype(type(held))
                )
                stored = h5py.h5t.py_create(kind, logical=True)
                attribute = h5py.h5a.create(owners[path], key.encode(), stored, scalar)
                attribute.write(np.array(held, dtype=kind), stored)
    finally:
        file.close()
    with open(part, "r+b") as raw:
        os.posix_fallocate(raw.fileno(), 0, part.stat().st_size)
    return places


@cache
def properties() -> tuple[Any, Any, Any, Any]:
    """How HDF5 creates datasets, the groups they are in, files, and the space of attributes."""
    h5py = import_h5py()
    early = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    early.set_layout(h5py.h5d.CONTIGUOUS)
    early.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    early.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    links = h5py.h5p.create(h5py.h5p.LINK_CREATE)
    links.set_create_intermediate_group(True)
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_fclose_degree(h5py.h5f.CLOSE_STRONG)
    # older forms of groups and headers have no check sums, and damaged ones take HDF5 down with them
    access.set_libver_bounds(h5py.h5f.LIBVER_V18, h5py.h5f.LIBVER_V18)
    return early, links, access, h5py.h5s.create(h5py.h5s.SCALAR)


def write_slabs(path: Path, part: Path, pieces: Sequence[Piece], comm: MPI.Comm) -> None:
    """Write each rank's pieces; collective. Pieces from other machines than rank 0's are synced to disk.

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
    with writing(path), open(part, "r+b", buffering=0) as file:
        for offset, rows in pieces:
            _write_rows(file, offset, rows)
        if sync:
            os.fsync(file.fileno())


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
