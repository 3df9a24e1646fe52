"""Distributed arrays to and from HDF5 files, by any build of h5py.

A file is built in three steps, so that a full disk is met where it does no harm: one rank
reserves the whole size and lays the file out, then all ranks write their slabs, then it is
synced and takes its name, for which nobody need wait. (An HDF5 file that cannot grow while
it is closed takes the process down with it.) As datasets are contiguous and have their
places then, the slabs need no HDF5: its collective open alone takes longer than writing a
state of moderate size.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.output import layout
from lyra_petsc.output.agreement import HDF5_ERRORS, on_each, raise_together, reason
from lyra_petsc.output.background import Background
from lyra_petsc.output.h5py_loader import import_h5py
from lyra_petsc.output.slabs import cannot_write, write_slabs
from lyra_petsc.parallel import on_one_machine, on_root

if TYPE_CHECKING:
    from lyra_petsc.output.ordering import FileOrder

Result = TypeVar("Result")


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
        Attributes of groups and datasets, by their path in the file; of the last file read on rank 0,
        of others on any rank.
    publish : callable
        What rank 0 does when all files have their names.
    """

    path: Path
    datasets: Mapping[str, NDArray[Any]]
    attributes: layout.Attributes
    publish: Callable[[], None] = _nothing

    @property
    def part(self) -> Path:
        """What it is called until all files are complete."""
        return self.path.with_name(self.path.name + ".part")


def write_collective(files: Sequence[NewFile], comm: MPI.Comm, background: Background | None = None) -> None:
    """Write distributed arrays to new HDF5 files; they get their names, in this order, when all are complete.

    Parameters
    ----------
    files : sequence of NewFile
        As many on every rank. Where the ranks share a machine, one lays out a file while another does the
        next.
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
    shared = comm.size if on_one_machine(comm) else 1
    owners = [number % shared for number in reversed(range(len(files)))]
    mine = [number for number, owner in enumerate(owners) if owner == comm.rank]

    def lay_out(number: int) -> list[int]:
        file, rows = files[number], lengths[number].sum(axis=0).tolist()
        return _guarded(file.path, lambda: layout.lay_out(file.part, slabs[number], rows, file.attributes))

    try:
        known = comm.allgather(on_each(comm, lambda: {number: lay_out(number) for number in mine}))
        for number, file in enumerate(files):
            places, before = known[owners[number]][number], lengths[number][: comm.rank].sum(axis=0).tolist()
            pieces = [
                (place + start * slab.itemsize * math.prod(slab.shape[1:]), slab)
                for place, start, slab in zip(places, before, slabs[number].values(), strict=True)
            ]
            write_slabs(file.path, file.part, pieces, comm)
    except LyraError:
        for number in mine:
            files[number].part.unlink(missing_ok=True)
        raise
    if background is not None:
        background.begin(partial(_complete, files))
    else:
        on_root(comm, partial(_complete, files))


def _complete(files: Sequence[NewFile]) -> None:
    """Sync the files, then give them their names. Call on one rank."""
    try:
        for file in files:
            _guarded(file.path, partial(_sync, file.part))
        for file in files:
            _guarded(file.path, partial(os.replace, file.part, file.path))
    except LyraError:
        for file in files:
            file.part.unlink(missing_ok=True)
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


def _guarded(path: Path, work: Callable[[], Result]) -> Result:
    try:
        return work()
    except HDF5_ERRORS as error:
        raise cannot_write(path, error) from error


def _sync(part: Path) -> None:
    with open(part, "rb") as raw:
        os.fsync(raw.fileno())
