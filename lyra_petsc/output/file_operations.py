"""Opening files for writing, atomic writes of small files, and file errors that all ranks raise together."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TypeVar, cast

from lyra_petsc.errors import InputError, LyraError, OutputError

if TYPE_CHECKING:
    from mpi4py import MPI


Result = TypeVar("Result")

# the exceptions by which h5py reports a failure of HDF5, depending on the call and the version
HDF5_ERRORS = (OSError, RuntimeError, ValueError, KeyError, TypeError)


def reason(error: BaseException) -> str:
    """The cause of a failed file operation as a short text on one line."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)
    return " ".join(str(error).split())[:200] or type(error).__name__


def possible_path(path: str | os.PathLike[str], key: str | None = None) -> Path:
    """The path, which need not exist.

    Raises
    ------
    InputError
        If no file can have it: it holds a null character, or half of a surrogate pair.
    """
    try:
        with suppress(OSError):
            os.lstat(path)
    except ValueError:
        raise InputError(f"no file can have the name {os.fspath(path)!r}", key=key) from None
    return Path(path)


def cannot_write(path: Path, error: BaseException) -> OutputError:
    """The error for a file that could not be written; HDF5's own message hides that a folder is missing."""
    why = reason(error) if path.parent.is_dir() else os.strerror(errno.ENOENT)
    return OutputError(f"{path}: cannot be written: {why}")


@contextmanager
def writing(path: Path, errors: tuple[type[Exception], ...] = (OSError,)) -> Iterator[None]:
    """A context for writing the file ``path`` that turns ``errors`` into the error of `cannot_write`."""
    try:
        yield
    except errors as error:
        raise cannot_write(path, error) from error


def open_output(path: str | os.PathLike[str], mode: str = "wb", *, buffering: int = -1) -> BinaryIO:
    """Open a file for writing; every result is opened here.

    A folder from somebody else may hold a link in the place of a result, by which writing would change one of
    the user's own files. Links are therefore not followed.

    Parameters
    ----------
    path : path
    mode : str
        As of ``open``, but ``wb`` makes a new file, which takes the place of an existing one.
    buffering : int
        As of ``open``.

    Raises
    ------
    OSError
        If the file cannot be opened, is not a regular one, or has a second name (a hard link).
    """
    if mode.startswith("w"):
        with suppress(FileNotFoundError):
            kind = os.lstat(path).st_mode
            if stat.S_ISREG(kind) or stat.S_ISLNK(kind):
                os.unlink(path)
        mode = mode.replace("w", "x")
    return cast(BinaryIO, open(path, mode, buffering, opener=open_regular_file))


def open_regular_file(path: str | os.PathLike[str], flags: int) -> int:
    """Descriptor of a regular file without a second name; see `open_output`."""
    try:
        # a pipe without a reader fails instead of blocking
        descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.ENXIO):
            raise
        raise _not_plain(path) from None
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
        os.close(descriptor)
        raise _not_plain(path)
    return descriptor


def _not_plain(path: str | os.PathLike[str]) -> OSError:
    name = os.path.basename(path)
    return OSError(f"{name} is a link, has a second name (a hard link), or is no plain file; remove it")


def make_folder(path: Path) -> None:
    """Create a folder within a folder of results, unless it exists.

    Raises
    ------
    OSError
        If it cannot be created, or a link or a file is in its place.
    """
    try:
        path.mkdir()
    except FileExistsError:
        if path.is_symlink() or not path.is_dir():
            raise


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """A new file, open in the context, that replaces ``path`` atomically at its end. Call on one rank.

    Raises
    ------
    OutputError
        If the file cannot be written; then the old file is kept.
    """
    part = path.with_name(path.name + ".part")
    with writing(path):
        try:
            with open_output(part) as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def sync(path: Path) -> None:
    """Write a file from the memory of the operating system to disk.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    with writing(path), open(path, "rb") as file:
        os.fsync(file.fileno())


def raise_on_all_ranks(comm: MPI.Comm, problem: LyraError | None) -> None:
    """Raise on every rank the error of the lowest rank that has one. Collective.

    Parameters
    ----------
    comm : MPI.Comm
    problem : LyraError or None
        The error on this rank.

    Raises
    ------
    LyraError
        The same error on every rank, if any rank has one.
    """
    first = comm.allreduce(comm.size if problem is None else comm.rank, min)
    if first < comm.size:
        shared = comm.bcast(problem, root=first)
        raise shared


def on_every_rank(comm: MPI.Comm, work: Callable[[], Result]) -> Result:
    """Run ``work`` on every rank and return this rank's result. Collective.

    Raises
    ------
    LyraError
        If ``work`` fails on any rank: on every rank, the error of the lowest rank that failed.
    """
    problem: LyraError | None = None
    result: Result | None = None
    try:
        result = work()
    except LyraError as error:
        problem = error
    raise_on_all_ranks(comm, problem)
    return cast(Result, result)


def replace_text(path: str | os.PathLike[str], text: str) -> None:
    """Replace the content of a file by ``text`` atomically. Call on one rank.

    Raises
    ------
    OutputError
        If the file cannot be written; then the old file is kept.
    """
    replace_bytes(path, text.encode("utf-8", "backslashreplace"))  # names of folders may be no text


def replace_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """As `replace_text`, for binary content."""
    with atomic_write(Path(path)) as file:
        file.write(content)
