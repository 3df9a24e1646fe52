"""Reading HDF5 files of a run: what is damaged is one line that names the file, never another exception.

h5py and the library below it raise nearly anything for a file with changed bytes, and numbers that were
changed raise nothing at all: datasets have check sums, beside them or in the table of the states' file.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.output.agreement import reason
from lyra_petsc.output.self_contained import open_own

if TYPE_CHECKING:
    from mpi4py import MPI

SUM = "sum"
"""Attribute of a dataset: its check sum, as text."""

TABLE = "written"
"""Group of a file of states with a row for each that it has room for: ``step`` (−1: not written), ``time``
and ``sums``, whose columns are named by the attribute ``columns``; row 0 is of the state ``first``."""

STATE = re.compile(r"/?states/(\d+)/[^/]+")


def check_sum(array: NDArray[Any]) -> int:
    """Sum modulo 2⁶⁴ of all 64-bit words (of bytes, where elements are shorter); sums of parts add up."""
    words = np.ascontiguousarray(array).reshape(-1).view(np.uint64 if array.dtype.itemsize == 8 else np.uint8)
    return int(words.sum(dtype=np.uint64))


def check_sums(slabs: Iterable[NDArray[Any]], comm: MPI.Comm) -> NDArray[np.uint64]:
    """Check sums of distributed arrays, the same on any number of ranks; collective."""
    mine = np.array([check_sum(slab) for slab in slabs], dtype=np.uint64)
    total = np.empty_like(mine)
    comm.Allreduce(mine, total)
    return total


@contextmanager
def open_stored(path: Path) -> Iterator[Any]:
    """A file, open for reading.

    Raises
    ------
    InputError
        For whatever goes wrong with it, also within the context.
    """
    try:
        with open_own(path) as file:
            yield file
    except LyraError:
        raise
    except Exception as error:
        why = reason(error) if path.exists() else "no such file"
        raise InputError(f"cannot be read, or is damaged: {why}", file=path) from error


def read_stored(
    path: Path, dataset: str, shape: tuple[int | None, ...] | None = None, kinds: str = "fiu"
) -> NDArray[Any]:
    """A whole dataset of a file.

    Parameters
    ----------
    path : Path
    dataset : str
    shape : tuple of int or None
        What it must have; ``None`` stands for any length.
    kinds : str
        numpy's letters of the kinds of numbers that it may hold.

    Raises
    ------
    InputError
        If it is missing, of another shape or kind, differs from its check sum, or is not finite.
    """
    with open_stored(path) as file:
        stored = file[dataset]
        if stored.dtype.kind not in kinds or not _fits(stored.shape, shape):
            words = " × ".join("any" if n is None else str(n) for n in shape or ())
            raise InputError(
                f"is damaged: {dataset.lstrip('/')} holds {stored.dtype} of shape {stored.shape}"
                + (f", not numbers of shape {words}" if words else ""),
                file=path,
            )
        array: NDArray[Any] = stored[()]
        expected = _expected(file, stored, dataset)
    if expected is not None and check_sum(array) != expected:
        raise InputError(f"is damaged: the check sum of {dataset.lstrip('/')} does not fit", file=path)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise InputError(f"is damaged: {dataset.lstrip('/')} holds numbers that are not finite", file=path)
    return array


def text_of(owner: Any, name: str) -> str:
    """An attribute that is text, of fixed or (in older files) variable length."""
    value = owner.attrs[name]
    return value.decode() if isinstance(value, bytes) else str(value)


def _fits(found: tuple[int, ...], shape: tuple[int | None, ...] | None) -> bool:
    if shape is None:
        return True
    return len(found) == len(shape) and all(n in (None, m) for n, m in zip(shape, found, strict=True))


def _expected(file: Any, stored: Any, dataset: str) -> int | None:
    """The check sum of a dataset; None where an older version wrote none."""
    if SUM in stored.attrs:
        return int(text_of(stored, SUM))
    state = STATE.fullmatch(dataset)
    if state is None or TABLE not in file:
        return None
    table = file[TABLE]
    row = int(state[1]) - int(table.attrs["first"])
    columns = [name for name, _ in json.loads(text_of(table, "columns"))]
    return int(table["sums"][row, columns.index(dataset.rpartition("/")[2])])
