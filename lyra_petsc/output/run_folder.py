"""The folder of a run or a study: chosen before anything is done, then created, locked and cleared."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lyra_petsc.errors import InputError
from lyra_petsc.output.agreement import HDF5_ERRORS, reason
from lyra_petsc.output.stored import check_folder, open_own
from lyra_petsc.parallel import on_root

if TYPE_CHECKING:
    from mpi4py import MPI

RUNS = Path("runs")
LOCK_FILE = "run.lock"
CHECKPOINT = "checkpoint.h5"
PREVIOUS = "checkpoint-previous.h5"
NEXT = "checkpoint-next.h5"

# what a run writes, and nothing else: --force removes no other file
RESULT = re.compile(
    r"(states-\d{4,}\.h5|(mesh|cells)\.h5|checkpoint(-previous|-next)?\.h5|states\.(xdmf|vtkhdf)"
    r"|(history|probes|reactions|obstacles)\.csv|scene\.yaml|summary\.json|failure\.(h5|xdmf|txt))(\.part)?"
)


def checkpoint_files(folder: str | os.PathLike[str]) -> list[Path]:
    """The checkpoints of a run that exist, newest first."""
    # a kill between the two replacements of a write leaves the newest under NEXT
    files = [Path(folder) / name for name in (NEXT, CHECKPOINT, PREVIOUS)]
    return [file for file in files if file.is_file()]


def present(name: str, folder: Path) -> list[Path]:
    """The file of this name in a folder, if it is there."""
    return [*folder.glob(name)]


def _check_resumable(folder: Path) -> None:
    """Refuse to resume where files of the run are links or checkpoints take data from other files."""
    check_folder(folder)
    for file in checkpoint_files(folder):
        with suppress(*HDF5_ERRORS), open_own(file):  # a damaged one has one before it
            pass


@dataclass(frozen=True)
class FolderKind:
    """The purpose of a folder: a run or a study.

    Attributes
    ----------
    what : str
        In a word.
    parent : Path
        Where folders are that the user does not name.
    lock : str
        Name of the file that is locked.
    result : re.Pattern
        Names of the files that are written; ``--force`` removes no other file.
    resumable : callable
        The files of a folder from which it goes on; empty if it cannot.
    lacks : str
        What is missing then, in words.
    check : callable, optional
        Refuses a folder that cannot go on all the same.
    folders : tuple of str
        Names of folders that ``--force`` removes.
    """

    what: str
    parent: Path
    lock: str
    result: re.Pattern[str]
    resumable: Callable[[Path], list[Path]]
    lacks: str
    check: Callable[[Path], None] | None = None
    folders: tuple[str, ...] = ()

    def exists(self, path: Path, key: str) -> InputError:
        """The refusal of a folder that is there."""
        return InputError(
            f"exists; name another folder, or give --resume to go on with its {self.what} or --force to "
            "replace it",
            file=path,
            key=key,
        )

    def newest(self, stem: str) -> Path:
        """The folder of a scene that was worked on last.

        Raises
        ------
        InputError
            If there is none that can go on.
        """
        ours = re.compile(re.escape(stem) + r"(-\d+)?")
        folders = self.parent.iterdir() if self.parent.is_dir() else []
        ages = [
            (max(file.stat().st_mtime for file in files), path)
            for path in folders
            if ours.fullmatch(path.name) and (files := self.resumable(path))
        ]
        if not ages:
            raise InputError(
                f"no {self.what} of {stem} under {self.parent} that can go on; run without --resume",
                key="--resume",
            )
        return max(ages)[1]


RUN = FolderKind(
    "run", RUNS, LOCK_FILE, RESULT, checkpoint_files, "no checkpoint to resume from", _check_resumable
)


@dataclass(frozen=True)
class FolderChoice:
    """The folder chosen for a run.

    Attributes
    ----------
    path : Path
        The folder as the user would write it.
    resume : bool
        It holds a run that goes on.
    given : bool
        Named by the user or taken over with ``--force``; otherwise another name is found if
        this one is taken meanwhile.
    force : bool
        Results that stand there are replaced.
    first : Path or None
        What a name found for it is counted on from.
    kind : FolderKind
    """

    path: Path
    resume: bool = False
    given: bool = False
    force: bool = False
    first: Path | None = None
    kind: FolderKind = RUN


def choose(
    comm: MPI.Comm,
    scene_stem: str,
    out: str | os.PathLike[str] | None = None,
    *,
    force: bool = False,
    resume: bool = False,
    kind: FolderKind = RUN,
) -> FolderChoice:
    """Decide on the folder without touching the disk; rank 0 decides for all.

    Parameters
    ----------
    comm : MPI.Comm
        All ranks.
    scene_stem : str
        File name of the scene without its ending.
    out : path, optional
        ``--out``. Without it: ``runs/<scene stem>``, or ``…-2``, ``…-3`` when that exists; with
        ``resume`` the newest run of that scene; with ``force`` always ``runs/<scene stem>``.
    force, resume : bool
        ``--force`` and ``--resume``.
    kind : FolderKind

    Raises
    ------
    InputError
        On every rank, if the folder cannot be used.
    """
    return on_root(comm, lambda: _choose(kind, scene_stem, out, force, resume))


def _choose(
    kind: FolderKind, stem: str, out: str | os.PathLike[str] | None, force: bool, resume: bool
) -> FolderChoice:
    if force and resume:
        raise InputError("--force begins anew and --resume goes on: give one of them", key="--force")
    key = "--out"
    if out is None:
        first = kind.parent / stem
        if resume:
            return FolderChoice(kind.newest(stem), resume=True, given=True, kind=kind)
        path = first if force else free_name(first)
        choice = FolderChoice(path, given=force, force=force, first=first, kind=kind)
        key = "output folder"
    else:
        if not isinstance(out, str | os.PathLike):
            raise InputError(f"must be the path of a folder, not {out!r}", key=key)
        if not os.fspath(out).strip():
            raise InputError("is empty; give the folder to write to", key=key)
        choice = FolderChoice(Path(out), resume=resume, given=True, force=force, kind=kind)
    try:
        _check(choice, key)
    except OSError as error:
        raise InputError(f"cannot be used: {reason(error)}", file=choice.path, key=key) from error
    return choice


def _check(choice: FolderChoice, key: str) -> None:
    path, kind = choice.path, choice.kind
    if os.path.lexists(path) and not path.is_dir():
        raise InputError("is a file; name a folder", file=path, key=key)
    if choice.resume:
        if not path.is_dir():
            raise InputError(
                f"does not exist, so there is no {kind.what} to resume", file=path, key="--resume"
            )
        if not kind.resumable(path):
            raise InputError(f"holds {kind.lacks}; run without --resume", file=path, key="--resume")
        if kind.check is not None:
            kind.check(path)
    elif choice.given and not choice.force and path.exists() and os.listdir(path) != [kind.lock]:
        raise kind.exists(path, key)
    check_creatable(path, key)


def check_creatable(path: Path, key: str) -> None:
    """Refuse a folder that could not be created, or written into; ``key`` is what named it.

    Raises
    ------
    InputError
        What stands in its place or above it, or the permission that is missing.
    """
    above = next(folder for folder in (path.absolute(), *path.absolute().parents) if os.path.lexists(folder))
    if not above.is_dir():
        raise InputError(f"cannot be created: {above} is a file", file=path, key=key)
    if not os.access(above, os.W_OK | os.X_OK):
        raise InputError(f"cannot be created: no permission to write in {above}", file=path, key=key)


def free_name(first: Path) -> Path:
    """``first``, or the first of ``…-2``, ``…-3``, … that does not exist."""
    path, number = first, 1
    while os.path.lexists(path):
        number += 1
        path = first.with_name(f"{first.name}-{number}")
    return path


class RunDirectory:
    """The folder chosen for a run or study, created and locked until its end; construction is collective.

    A folder made for it that is still empty at the end is removed again.

    Parameters
    ----------
    comm : MPI.Comm
        All ranks; rank 0 holds the lock.
    choice : FolderChoice

    Attributes
    ----------
    path : Path
    note : str or None
        What the user should know of the lock.

    Raises
    ------
    InputError
        On every rank, if it cannot be made or another run is at work in it.
    """

    def __init__(self, comm: MPI.Comm, choice: FolderChoice) -> None:
        self._comm, self._choice = comm, choice
        self._made: list[Path] = []
        self._lock: FolderLock | None = None
        found = on_root(comm, self._take)
        self.path, held = found
        self.note = None if held else f"{self.path}: this file system has no locks: keep others out of it"

    def clean(self) -> None:
        """Remove old results (``--force``) or what a kill left half-written (``--resume``); collective.

        Raises
        ------
        InputError
            On every rank, if they cannot be removed.
        """
        on_root(self._comm, self._clear)

    @property
    def descriptor(self) -> int:
        """Of the locked file, on rank 0: processes that inherit it keep the folder locked."""
        assert self._lock is not None
        return self._lock.descriptor

    def release(self) -> None:
        """Unlock the folder; not collective."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None
        self._unmake()

    def __enter__(self) -> RunDirectory:
        return self

    def __exit__(self, *error: object) -> None:
        self.release()

    def _take(self) -> tuple[Path, bool]:
        choice, path, kind = self._choice, self._choice.path, self._choice.kind
        fresh = not (choice.resume or choice.force)
        while True:
            try:
                self._make(path)
                self._lock = FolderLock(path, kind.lock)
                if fresh and os.listdir(path) != [kind.lock]:
                    raise FileExistsError
                if choice.resume and not kind.resumable(path):  # replaced by another meanwhile
                    raise InputError(f"holds {kind.lacks}; run without --resume", file=path)
                return path, self._lock.held
            except (FileExistsError, FolderLocked) as obstacle:
                self.release()
                if not fresh or choice.given:
                    raise self._refusal(path, obstacle) from None
                path = free_name(choice.first or choice.path)
            except OSError as error:
                self.release()
                raise InputError(f"cannot be used: {reason(error)}", file=path, key="--out") from error
            except InputError:
                self.release()
                raise

    def _refusal(self, path: Path, obstacle: Exception) -> InputError:
        if not isinstance(obstacle, FolderLocked):
            return self._choice.kind.exists(path, "--out")
        words = f"another {self._choice.kind.what} is at work in this folder ({obstacle}); wait for it, or "
        key = "--resume" if self._choice.resume else "--out"
        return InputError(words + "name another folder", file=path, key=key)

    def _make(self, path: Path) -> None:
        """Create the folder and what is missing above it, noting what was not there before."""
        missing = [folder for folder in (path, *path.parents) if not folder.exists()]
        for folder in reversed(missing):
            with suppress(FileExistsError):  # by another run at the same moment
                folder.mkdir()
                self._made.append(folder)
        if not path.is_dir():
            raise NotADirectoryError(20, os.strerror(20))

    def _unmake(self) -> None:
        for folder in reversed(self._made):
            try:
                folder.rmdir()
            except OSError:  # no longer empty
                break
        self._made.clear()

    def _clear(self) -> None:
        kind = self._choice.kind
        try:
            for entry in sorted(self.path.iterdir()):
                if self._choice.force and entry.name in kind.folders:
                    shutil.rmtree(entry)
                elif kind.result.fullmatch(entry.name) and (
                    self._choice.force or entry.name.endswith(".part")
                ):
                    entry.unlink()
        except OSError as error:
            raise InputError(f"cannot be cleared: {reason(error)}", file=self.path, key="--out") from error


class FolderLocked(Exception):
    """Another process holds the lock; the text says which."""


class FolderLock:
    """Lock a folder; for one rank.

    The lock is the kernel's (``flock``) on a file of its own in the folder. A process that is
    killed leaves the file behind and the lock free; one that ends by itself removes the file.

    Parameters
    ----------
    folder : Path
        An existing folder.
    name : str
        Of the file.

    Attributes
    ----------
    descriptor : int
        Of the file.
    held : bool
        False where the file system knows no locks.

    Raises
    ------
    FolderLocked
        If another process holds it.
    OSError
        If the file cannot be created.
    """

    def __init__(self, folder: Path, name: str = LOCK_FILE) -> None:
        self.path = folder / name
        while True:
            self.descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            try:
                self.held = self._lock()
                if self._stands():
                    break
            except BaseException:
                os.close(self.descriptor)
                raise
            os.close(self.descriptor)  # its former holder removed it meanwhile
        with suppress(OSError):  # on a full disk the lock holds without its text
            os.ftruncate(self.descriptor, 0)
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            os.pwrite(
                self.descriptor, f"process {os.getpid()} on {socket.gethostname()}, {since}".encode(), 0
            )

    def _lock(self) -> bool:
        try:
            fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise FolderLocked(self._holder()) from None
        except OSError:
            return False
        return True

    def _holder(self) -> str:
        text = os.pread(self.descriptor, 200, 0).decode("utf-8", "replace")
        return "".join(c for c in text if c.isprintable()) or "a process that has not said which"

    def _stands(self) -> bool:
        """Whether the locked file is still the one at its path."""
        try:
            return os.path.samestat(os.fstat(self.descriptor), os.stat(self.path))
        except FileNotFoundError:
            return False

    def release(self) -> None:
        """Remove the file, then release the lock."""
        with suppress(OSError):  # the folder itself may be gone
            if self._stands():
                self.path.unlink()
        with suppress(OSError):
            os.close(self.descriptor)


def in_use(folder: Path) -> bool:
    """Whether a process holds the lock of a folder; also True where the file system knows no locks."""
    try:
        descriptor = os.open(folder / LOCK_FILE, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)  # releases the lock at once
    return False
