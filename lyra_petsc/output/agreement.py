"""File operations: small files replaced at once, and errors in words, raised alike on all ranks."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TypeVar, cast

from lyra_petsc.errors import LyraError, OutputError

if TYPE_CHECKING:
    from mpi4py import MPI


Result = TypeVar("Result")

# what h5py raises when the library reports a failure, depending on the call and its version
HDF5_ERRORS = (OSError, RuntimeError, ValueError, KeyError, TypeError)


def reason(error: BaseException) -> str:
    """The cause of a failed file operation, in a few words on one line."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)
    return " ".join(str(error).split())[:200] or type(error).__name__


def cannot_write(path: Path, error: BaseException) -> OutputError:
    """The refusal of a file that could not be written; that its folder is gone HDF5 says in other words."""
    why = reason(error) if path.parent.is_dir() else os.strerror(errno.ENOENT)
    return OutputError(f"{path}: cannot be written: {why}")


@contextmanager
def writing(path: Path, errors: tuple[type[Exception], ...] = (OSError,)) -> Iterator[None]:
    """A context in which a file is written; what goes wrong is raised as `cannot_write` says."""
    try:
        yield
    except errors as error:
        raise cannot_write(path, error) from error


@contextmanager
def replaced(path: Path) -> Iterator[BinaryIO]:
    """A new file that takes the place of another in one instant, at the end of the context. Call on one rank.

    Raises
    ------
    OutputError
        If it could not be written; what stood there before stands.
    """
    part = path.with_name(path.name + ".part")
    with writing(path):
        try:
            with open(part, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def raise_together(comm: MPI.Comm, problem: LyraError | None) -> None:
    """Raise on every rank the problem of the lowest rank that has one. Collective.

    Parameters
    ----------
    comm : MPI.Comm
        All ranks that took part.
    problem : LyraError or None
        This rank's problem.

    Raises
    ------
    LyraError
        The same on every rank, if any rank has one.
    """
    from mpi4py import MPI

    first = comm.allreduce(comm.size if problem is None else comm.rank, MPI.MIN)
    if first == comm.size:
        return
    shared = comm.bcast(problem, root=first)
    raise shared


def on_each(comm: MPI.Comm, work: Callable[[], Result]) -> Result:
    """This rank's result of ``work``; if it fails on any rank, all raise the same. Collective.

    Raises
    ------
    LyraError
        What it raised on the lowest of those ranks.
    """
    problem: LyraError | None = None
    result: Result | None = None
    try:
        result = work()
    except LyraError as error:
        problem = error
    raise_together(comm, problem)
    return cast(Result, result)


def replace_text(path: str | os.PathLike[str], text: str) -> None:
    """Put ``text`` into a file in one instant. Call on one rank.

    Raises
    ------
    OutputError
        If it could not be written; what stood there before stands.
    """
    replace_bytes(path, text.encode("utf-8"))


def replace_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """As `replace_text`, for content that is no text."""
    with replaced(Path(path)) as file:
        file.write(content)
