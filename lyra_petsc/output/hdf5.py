"""Writing and reading distributed arrays in HDF5 files, with a serial or parallel build of h5py.

A file is written in three steps. (1) Rank 0 reserves the whole size on disk and creates all datasets, so that
a full disk is found before data are written; HDF5 would crash the process if a file could not grow while it
is closed. (2) All ranks write their slabs. Datasets are contiguous and their offsets are known, so plain file
writes suffice; HDF5's collective open alone takes longer than writing a state of moderate size. On one
machine all ranks write at the same time; on several machines they use MPI-IO or, if that fails, write one
after the other. (3) A thread of rank 0 syncs and renames the file while the simulation continues.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeAlias, TypeVar

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.output.file_operations import (
    HDF5_ERRORS,
    cannot_write,
    on_every_rank,
    open_output,
    raise_on_all_ranks,
    writing,
)
from lyra_petsc.output.ordering import row_type
from lyra_petsc.output.stored import hdf5_properties, import_h5py, open_stored
from lyra_petsc.parallel import on_one_machine, on_root

if TYPE_CHECKING:
    from lyra_petsc.output.ordering import FileOrder


class Background:
    """Runs one task at a time in a thread of rank 0; a task must not call MPI.

    Parameters
    ----------
    comm : MPI.Comm
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="lyra-petsc files")
        self._task: Future[None] | None = None

    def submit(self, task: Callable[[], None]) -> None:
        """Start a task on rank 0; the previous task must have been waited for."""
        if self._comm.rank == 0:
            self._task = self._worker.submit(task)

    def wait(self) -> None:
        """Wait for the task; collective.

        Raises
        ------
        LyraError
            On every rank, the error of the task; a second call does not raise it again.
        """
        problem = None if self._task is None else self._task.exception()
        self._task = None
        if problem is not None and not isinstance(problem, LyraError):
            raise problem  # a programming error, which aborts the other ranks
        raise_on_all_ranks(self._comm, problem)

    def close(self) -> None:
        """Wait for the task and end the thread; errors of the task are ignored. Not collective."""
        self._worker.shutdown()


Result = TypeVar("Result")
Attributes: TypeAlias = Mapping[str, Mapping[str, int | float | str]]
Piece: TypeAlias = tuple[int, NDArray[Any]]
"""A rank's contiguous rows of a dataset, preceded by their offset in the file [bytes]."""

TURNS_VARIABLE = "LYRA_PETSC_WRITE_IN_TURN"
"""Environment variable of rank 0; 1: ranks write in turn, for MPI-IO that opens files but cannot write."""

# upper bounds of the bytes that a file needs besides data and attributes: in total, and per dataset
MAX_OVERHEAD = 1 << 16
DATASET_OVERHEAD = 1 << 10


def _do_nothing() -> None:
    pass


@dataclass(frozen=True)
class NewFile:
    """A file to be written.

    Attributes
    ----------
    path : Path
        An existing file is replaced.
    datasets : mapping of str to (n_slab, ...) array
        This rank's rows of each dataset, which are stored in rank order. Names, types and trailing
        shapes are the same on every rank; a rank may have no rows.
    attributes : mapping of str to mapping
        Attributes of groups and datasets by their path in the file; read on rank 0.
    publish : callable
        Called on rank 0 after all files have their final names.
    offsets : sequence of int or None
        If the file exists and is written in place: offsets of its datasets [bytes].
    before_sync : callable
        Called on rank 0 after all rows are written, before the file is synced.
    """

    path: Path
    datasets: Mapping[str, NDArray[Any]]
    attributes: Attributes
    publish: Callable[[], None] = _do_nothing
    offsets: Sequence[int] | None = None
    before_sync: Callable[[], None] = _do_nothing

    @property
    def part(self) -> Path:
        """Path of the file until all files are complete."""
        return self.path if self.offsets is not None else self.path.with_name(self.path.name + ".part")

    def discard(self) -> None:
        """Remove the incomplete file."""
        if self.offsets is None:
            self.part.unlink(missing_ok=True)


def write_collective(files: Sequence[NewFile], comm: MPI.Comm, background: Background | None = None) -> None:
    """Write distributed arrays to HDF5 files; when all are complete, they are renamed in the given order.

    Parameters
    ----------
    files : sequence of NewFile
        The same number on every rank.
    comm : MPI.Comm
        All ranks; collective.
    background : Background or None
        Syncs and renames the files after its previous task; None: this call does so.

    Raises
    ------
    OutputError
        On every rank, if a file cannot be written; then no file is renamed and existing files are kept.
        If `NewFile.publish` of a file fails, the files before it are published. With ``background``, the
        error may be of the previous files; an error of these files is raised by the next call or `wait`.
    """
    if background is not None:
        background.wait()
    slabs = [{name: np.ascontiguousarray(slab) for name, slab in file.datasets.items()} for file in files]
    gathered = comm.allgather([[len(slab) for slab in of_file.values()] for of_file in slabs])
    lengths = [np.array([of_rank[number] for of_rank in gathered]) for number in range(len(files))]

    def offsets_of(number: int) -> list[int]:
        file, rows = files[number], lengths[number].sum(axis=0).tolist()
        if file.offsets is not None:
            return list(file.offsets)
        with writing(file.path, HDF5_ERRORS):
            return preallocate(file.part, slabs[number], rows, file.attributes)

    try:
        all_offsets = on_root(comm, lambda: [offsets_of(number) for number in range(len(files))])
        for number, (file, offsets) in enumerate(zip(files, all_offsets, strict=True)):
            before = lengths[number][: comm.rank].sum(axis=0).tolist()
            pieces = [
                (offset + start * slab.itemsize * math.prod(slab.shape[1:]), slab)
                for offset, start, slab in zip(offsets, before, slabs[number].values(), strict=True)
            ]
            write_slabs(file.path, file.part, pieces, comm)
    except LyraError:
        for file in files if comm.rank == 0 else ():
            file.discard()
        raise
    if background is not None:
        background.submit(partial(_complete, files))
    else:
        on_root(comm, partial(_complete, files))


def _complete(files: Sequence[NewFile]) -> None:
    """Sync, rename and publish the files. Call on one rank."""
    try:
        for file in files:
            file.before_sync()
            with writing(file.path), open(file.part, "rb") as raw:
                os.fsync(raw.fileno())
        for file in files:
            if file.offsets is None:
                with writing(file.path):
                    os.replace(file.part, file.path)
    except LyraError:
        for file in files:
            file.discard()
        raise
    for file in files:
        file.publish()


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
                found = f"{dataset} has {stored.shape[0] if stored.shape else 'no'} rows"
                raise InputError(f"{found}, {order.n_global} are expected", file=path)
            return np.asarray(stored[order.start : order.start + order.n_slab])

    return on_every_rank(order.comm, work)


def preallocate(
    part: Path, slabs: Mapping[str, NDArray[Any]], rows: Sequence[int], attributes: Attributes
) -> list[int]:
    """Create an HDF5 file of full size whose datasets are empty; returns the datasets' offsets [bytes].

    Uses h5py's low-level interface: the high-level one takes 4.5 ms instead of 2.7 ms for a small state with
    its checkpoint, and makes a run of the default scene 4 % (two ranks) to 6 % (one rank) longer.

    Parameters
    ----------
    part : Path
        The file to create.
    slabs : mapping of str to array
        Name, type and trailing shape of each dataset.
    rows : sequence of int
        Number of rows of each dataset.
    attributes : mapping of str to mapping
        Attributes of groups and datasets by their path in the file.

    Raises
    ------
    One of `HDF5_ERRORS`
        If the file cannot be created.
    """
    h5py = import_h5py()
    early, links, access, scalar = hdf5_properties()
    shapes = [(count, *slab.shape[1:]) for count, slab in zip(rows, slabs.values(), strict=True)]
    data = sum(math.prod(shape) * slab.itemsize for shape, slab in zip(shapes, slabs.values(), strict=True))
    texts = sum(len(str(value).encode()) for values in attributes.values() for value in values.values())
    with open_output(part, "w+b", buffering=0) as raw:
        os.posix_fallocate(raw.fileno(), 0, data + texts + MAX_OVERHEAD + DATASET_OVERHEAD * len(slabs))
        raw.truncate(0)  # there is space for it; HDF5 takes a longer file for one of its own
        access = access.copy()
        access.set_fileobj_driver(h5py.h5fd.fileobj_driver, raw)
        file = h5py.h5f.create(os.fsencode(part), h5py.h5f.ACC_TRUNC, fapl=access)
        try:
            owners = {"/": file}
            for (name, slab), shape in zip(slabs.items(), shapes, strict=True):
                space, stored = h5py.h5s.create_simple(shape), h5py.h5t.py_create(slab.dtype, logical=True)
                owners[name] = h5py.h5d.create(file, name.encode(), stored, space, early, links)
            # a dataset without rows has no offset
            offsets = [owners[name].get_offset() or 0 for name in slabs]
            for path, values in attributes.items():
                if path not in owners:
                    owners[path] = (h5py.h5g.open if path in file else h5py.h5g.create)(file, path.encode())
                for key, value in values.items():
                    # fixed-length text: HDF5 stores text of variable length in a heap without check sums
                    raw_value = value.encode() if isinstance(value, str) else value
                    kind = (
                        h5py.string_dtype("utf-8", max(1, len(raw_value)))
                        if isinstance(raw_value, bytes)
                        else np.dtype(type(raw_value))
                    )
                    stored = h5py.h5t.py_create(kind, logical=True)
                    attribute = h5py.h5a.create(owners[path], key.encode(), stored, scalar)
                    attribute.write(np.array(raw_value, dtype=kind), stored)
        finally:
            file.close()
        os.posix_fallocate(raw.fileno(), 0, os.fstat(raw.fileno()).st_size)
    return offsets


def write_slabs(path: Path, part: Path, pieces: Sequence[Piece], comm: MPI.Comm) -> None:
    """Write each rank's pieces; collective. Pieces from other machines than rank 0's are synced to disk.

    Parameters
    ----------
    path : Path
        Final path of the file, for messages.
    part : Path
        Present path of the file, which is large enough for all pieces.
    pieces : sequence of (int, (n, ...) array)
        The same number on every rank; n may be 0.
    comm : MPI.Comm
        All ranks.

    Raises
    ------
    OutputError
        On every rank, if any rank fails to write.
    """
    if on_one_machine(comm):
        on_every_rank(comm, lambda: _write_serial(path, part, pieces, sync=False))
        return
    in_turn = comm.bcast(os.environ.get(TURNS_VARIABLE) == "1", root=0)
    if in_turn or not _write_with_mpi_io(path, part, pieces, comm):
        for rank in range(comm.size):
            mine = pieces if rank == comm.rank else ()
            on_every_rank(comm, partial(_write_serial, path, part, mine, sync=True))


def _write_serial(path: Path, part: Path, pieces: Sequence[Piece], *, sync: bool) -> None:
    """Write this rank's pieces, if there are any, with plain file writes."""
    if not pieces:
        return
    with writing(path), open_output(part, "r+b", buffering=0) as file:
        for offset, rows in pieces:
            _write_rows(file, offset, rows)
        if sync:
            os.fsync(file.fileno())


def _write_rows(file: BinaryIO, offset: int, rows: NDArray[Any]) -> None:
    file.seek(offset)
    remaining = rows.reshape(-1).view(np.uint8).data
    while remaining:  # one call writes at most 2 GiB
        remaining = remaining[file.write(remaining) :]


def _write_with_mpi_io(path: Path, part: Path, pieces: Sequence[Piece], comm: MPI.Comm) -> bool:
    """Write all ranks' pieces by MPI-IO; ``False`` if no rank can open the file with MPI-IO."""
    problem: LyraError | None = None
    try:
        open_output(part, "r+b").close()  # MPI-IO would follow a link
        file = MPI.File.Open(MPI.Intracomm(comm), os.fspath(part), MPI.MODE_RDWR)
    except (OSError, MPI.Exception) as error:
        problem = cannot_write(path, error)
    if comm.allreduce(problem is not None, MPI.LAND):
        return False
    raise_on_all_ranks(comm, problem)

    for offset, rows in pieces:
        try:
            _write_rows_collective(file, offset, rows)
        except HDF5_ERRORS as error:
            problem = problem or cannot_write(path, error)
    try:
        file.Sync()
        file.Close()
    except HDF5_ERRORS as error:
        problem = problem or cannot_write(path, error)
    raise_on_all_ranks(comm, problem)
    return True


def _write_rows_collective(file: MPI.File, offset: int, rows: NDArray[Any]) -> None:
    with row_type(rows) as kind:
        file.Write_at_all(offset, [rows, len(rows), kind])
