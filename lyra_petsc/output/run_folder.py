"""The folder of a run: chosen before anything is done, then created, locked and cleared of old results."""

from __future__ import annotations

import fcntl
import os
import re
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from lyra_petsc.errors import InputError
from lyra_petsc.output.agreement import HDF5_ERRORS, reason
from lyra_petsc.output.self_contained import check_folder, open_own
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
    r"|(history|probes|reactions)\.csv|scene\.yaml|summary\.json|failure\.(h5|xdmf|txt))(\.part)?"
)

EXISTS = "exists; name another folder, or give --resume to go on with its run or --force to replace it"
NO_CHECKPOINT = "holds no checkpoint to resume from; run without --resume"


def checkpoint_files(folder: str | os.PathLike[str], comm: MPI.Comm | None = None) -> list[Path]:
    """The checkpoints of a run that exist, newest first; with ``comm`` as rank 0 sees them."""

    def work() -> list[Path]:
        # a kill between the two replacements of a write leaves the newest under NEXT
        files = [Path(folder) / name for name in (NEXT, CHECKPOINT, PREVIOUS)]
        return [file for file in files if file.is_file()]

    return work() if comm is None else on_root(comm, work) or []


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
    """

    path: Path
    resume: bool = False
    given: bool = False
    force: bool = False
    first: Path | None = None


def choose(
    comm: MPI.Comm,
    scene_stem: str,
    out: str | os.PathLike[str] | None = None,
    *,
    force: bool = False,
    resume: bool = False,
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

    Raises
    ------
    InputError
        On every rank, if the folder cannot be used.
    """
    choice = on_root(comm, lambda: _choose(scene_stem, out, force, resume))
    assert choice is not None
    return choice


def _choose(stem: str, out: str | os.PathLike[str] | None, force: bool, resume: bool) -> FolderChoice:
    if force and resume:
        raise InputError("--force begins anew and --resume goes on: give one of them", key="--force")
    key = "--out"
    if out is None:
        first = RUNS / stem
        if resume:
            return FolderChoice(_newest(stem), resume=True, given=True)
        choice = FolderChoice(first if force else free_name(first), given=force, force=force, first=first)
        key = "output folder"
    else:
        if not os.fspath(out):
            raise InputError("is empty; give the folder to write to", key=key)
        choice = FolderChoice(Path(out), resume=resume, given=True, force=force)
    try:
        _check(choice, key)
    except OSError as error:
        raise InputError(f"cannot be used: {reason(error)}", file=choice.path, key=key) from error
    return choice


def _check(choice: FolderChoice, key: str) -> None:
    path = choice.path
    if os.path.lexists(path) and not path.is_dir():
        raise InputError("is a file; name a folder", file=path, key=key)
    if choice.resume:
        if not path.is_dir():
            raise InputError("does not exist, so there is no run to resume", file=path, key="--resume")
        if not checkpoint_files(path):
            raise InputError(NO_CHECKPOINT, file=path, key="--resume")
        check_folder(path)  # some of its files are written on
        for file in checkpoint_files(path):
            with suppress(*HDF5_ERRORS), open_own(file):  # a damaged one has one before it
                pass
    elif choice.given and not choice.force and path.exists() and os.listdir(path) != [LOCK_FILE]:
        raise InputError(EXISTS, file=path, key=key)
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


def _newest(stem: str) -> Path:
    ours = re.compile(re.escape(stem) + r"(-\d+)?")
    folders = [path for path in RUNS.iterdir() if ours.fullmatch(path.name)] if RUNS.is_dir() else []
    ages = [
        (max(file.stat().st_mtime for file in files), path)
        for path in folders
        if (files := checkpoint_files(path))
    ]
    if not ages:
        raise InputError(
            f"no run of {stem} with a checkpoint under {RUNS}; run without --resume", key="--resume"
        )
    return max(ages)[1]


class RunDirectory:
    """The folder chosen for one run, created and locked until the run's end; construction is collective.

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
        assert found is not None
        self.path, held = found
        self.note = None if held else f"{self.path}: this file system has no locks: keep other runs out of it"

    def clean(self) -> None:
        """Remove old results (``--force``) or what a kill left half-written (``--resume``); collective.

        Raises
        ------
        InputError
            On every rank, if they cannot be removed.
        """
        on_root(self._comm, self._clear)

    def release(self) -> None:
        """Unlock the folder; not collective."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None
        self._unmake()

    def __enter__(self) -> RunDirectory:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()

    def _take(self) -> tuple[Path, bool]:
        choice, path = self._choice, self._choice.path
        fresh = not (choice.resume or choice.force)
        while True:
            try:
                self._make(path)
                self._lock = FolderLock(path)
                if fresh and os.listdir(path) != [LOCK_FILE]:
                    raise FileExistsError
                if choice.resume and not checkpoint_files(path):  # replaced by another run meanwhile
                    raise InputError(NO_CHECKPOINT, file=path)
                return path, self._lock.held
            except (FileExistsError, Busy) as obstacle:
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
        if isinstance(obstacle, Busy):
            return InputError(
                f"another run is at work in this folder ({obstacle}); wait for it, or name another folder",
                file=path,
                key="--resume" if self._choice.resume else "--out",
            )
        return InputError(EXISTS, file=path, key="--out")

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
        try:
            for entry in sorted(self.path.iterdir()):
                match = RESULT.fullmatch(entry.name)
                if match and (self._choice.force or entry.name.endswith(".part")):
                    entry.unlink()
        except OSError as error:
            raise InputError(f"cannot be cleared: {reason(error)}", file=self.path, key="--out") from error


class Busy(Exception):
    """Another process holds the lock; the text says which."""


class FolderLock:
    """Lock a folder; for one rank.

    The lock is the kernel's (``flock``) on a file of its own in the folder. A process that is
    killed leaves the file behind and the lock free; one that ends by itself removes the file.

    Parameters
    ----------
    folder : Path
        An existing folder.

    Attributes
    ----------
    held : bool
        False where the file system knows no locks.

    Raises
    ------
    Busy
        If another process holds it.
    OSError
        If the file cannot be created.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / LOCK_FILE
        while True:
            self._descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            try:
                self.held = self._lock()
                if self._stands():
                    break
            except BaseException:
                os.close(self._descriptor)
                raise
            os.close(self._descriptor)  # its former holder removed it meanwhile
        with suppress(OSError):  # on a full disk the lock holds without its text
            os.ftruncate(self._descriptor, 0)
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            os.pwrite(
                self._descriptor, f"process {os.getpid()} on {socket.gethostname()}, {since}".encode(), 0
            )

    def _lock(self) -> bool:
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Busy(self._holder()) from None
        except OSError:
            return False
        return True

    def _holder(self) -> str:
        text = os.pread(self._descriptor, 200, 0).decode("utf-8", "replace")
        return "".join(c for c in text if c.isprintable()) or "a process that has not said which"

    def _stands(self) -> bool:
        """Whether the file locked is still the one that others would find."""
        try:
            return os.path.samestat(os.fstat(self._descriptor), os.stat(self.path))
        except FileNotFoundError:
            return False

    def release(self) -> None:
        """Remove the file, then release the lock."""
        with suppress(OSError):  # the folder itself may be gone
            if self._stands():
                self.path.unlink()
        with suppress(OSError):
            os.close(self._descriptor)


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
