"""The folder of a run or a study: chosen before any work, then created, locked and cleaned."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lyra_petsc.errors import InputError
from lyra_petsc.output.file_operations import open_regular_file, possible_path, reason
from lyra_petsc.output.layout import CHECKPOINT, LOCK_FILE, PREVIOUS, RESULT
from lyra_petsc.output.stored import OutsideFolderError, check_folder, open_stored
from lyra_petsc.parallel import on_root

if TYPE_CHECKING:
    from mpi4py import MPI

RUNS = Path("runs")


@dataclass(frozen=True)
class FolderKind:
    """The kind of a folder: of a run, a study or a fit.

    Attributes
    ----------
    noun : str
        Name of the kind in messages, as in ``run``, and of the lock file, as in ``run.lock``.
    parent : Path
        Parent of folders that the user does not name.
    result : re.Pattern
        Names of the result files; ``--force`` removes no other file.
    resumed_from : tuple of str
        Names of the files of which one at least must exist for a folder to be resumed.
    missing : str
        Text for messages: what is missing if none exists.
    folders : tuple of str
        Names of subfolders that ``--force`` removes.
    """

    noun: str
    parent: Path
    result: re.Pattern[str]
    resumed_from: tuple[str, ...]
    missing: str
    folders: tuple[str, ...] = ()

    @property
    def lock(self) -> str:
        """Name of the lock file."""
        return f"{self.noun}.lock"

    def resumable(self, folder: Path) -> list[Path]:
        """The files from which a folder can be resumed."""
        return [folder / name for name in self.resumed_from if (folder / name).is_file()]

    def check_content(self, folder: Path) -> None:
        """Refuse results that are links, or that take data from other files."""
        check_folder(folder)
        for file in self.resumable(folder):
            if file.suffix == ".h5":
                try:
                    with open_stored(file):
                        pass
                except OutsideFolderError:
                    raise
                except InputError:  # if one is damaged, another is read
                    continue

    def exists_error(self, path: Path, key: str) -> InputError:
        """The error for a folder that exists already."""
        return InputError(
            f"exists; name another folder, or give --resume to go on with its {self.noun} or --force to "
            "replace it",
            file=path,
            key=key,
        )

    def newest(self, stem: str) -> Path:
        """The most recently written resumable folder of a scene.

        Raises
        ------
        InputError
            If the scene has no resumable folder.
        """
        of_scene = re.compile(re.escape(stem) + r"(-\d+)?")
        folders = self.parent.iterdir() if self.parent.is_dir() else []
        ages = [
            (max(file.stat().st_mtime for file in files), path)
            for path in folders
            if of_scene.fullmatch(path.name) and (files := self.resumable(path))
        ]
        if not ages:
            raise InputError(
                f"no {self.noun} of {stem} under {self.parent} that can go on; run without --resume",
                key="--resume",
            )
        return max(ages)[1]


RUN = FolderKind("run", RUNS, RESULT, (CHECKPOINT, PREVIOUS), "no checkpoint to resume from")


@dataclass(frozen=True)
class FolderChoice:
    """The folder chosen for a run.

    Attributes
    ----------
    path : Path
        The folder as the user would write it.
    resume : bool
        The folder holds a run to be resumed.
    named : bool
        The user named the folder or gave ``--force``; otherwise another name is chosen if another
        process creates the folder first.
    force : bool
        Results in the folder are replaced.
    first : Path or None
        The name without a number, if the name of the folder may get one (``…-2``, ``…-3``).
    kind : FolderKind
    """

    path: Path
    resume: bool = False
    named: bool = False
    force: bool = False
    first: Path | None = None
    kind: FolderKind = RUN


def choose_folder(
    comm: MPI.Comm,
    scene_stem: str,
    out: str | os.PathLike[str] | None = None,
    *,
    force: bool = False,
    resume: bool = False,
    kind: FolderKind = RUN,
) -> FolderChoice:
    """Choose the folder without creating it; rank 0 chooses for all. Collective.

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
    return on_root(comm, lambda: _choose_folder(kind, scene_stem, out, force, resume))


def _choose_folder(
    kind: FolderKind, stem: str, out: str | os.PathLike[str] | None, force: bool, resume: bool
) -> FolderChoice:
    if force and resume:
        raise InputError("--force begins anew and --resume goes on: give one of them", key="--force")
    key = "--out"
    if out is None:
        first = kind.parent / stem
        path = kind.newest(stem) if resume else first if force else free_name(first)
        choice = FolderChoice(path, resume, named=force or resume, force=force, first=first, kind=kind)
        key = "output folder"
        if path.is_symlink():
            raise InputError("is a link; name the folder to write to by --out", file=path, key=key)
    else:
        if not isinstance(out, str | os.PathLike):
            raise InputError(f"must be the path of a folder, not {out!r}", key=key)
        if not os.fspath(out).strip():
            raise InputError("is empty; give the folder to write to", key=key)
        choice = FolderChoice(possible_path(out, key), resume=resume, named=True, force=force, kind=kind)
    try:
        _check_choice(choice, key)
    except OSError as error:
        raise InputError(f"cannot be used: {reason(error)}", file=choice.path, key=key) from error
    return choice


def _check_choice(choice: FolderChoice, key: str) -> None:
    path, kind = choice.path, choice.kind
    if os.path.lexists(path) and not path.is_dir():
        raise InputError("is a file; name a folder", file=path, key=key)
    if choice.resume:
        if not path.is_dir():
            raise InputError(
                f"does not exist, so there is no {kind.noun} to resume", file=path, key="--resume"
            )
        if not kind.resumable(path):
            raise InputError(f"holds {kind.missing}; run without --resume", file=path, key="--resume")
        kind.check_content(path)
    elif choice.named and not choice.force and path.exists() and os.listdir(path) != [kind.lock]:
        raise kind.exists_error(path, key)
    check_creatable(path, key)


def check_creatable(path: Path, key: str) -> None:
    """Check that a folder can be created and written into.

    Parameters
    ----------
    path : Path
    key : str
        The option that gives the folder, for messages.

    Raises
    ------
    InputError
        If a file is in the way or permission is missing.
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
    """The folder chosen for a run or study, created and locked until `release`; construction is collective.

    Folders that were created for it and are empty in the end are removed again.

    Parameters
    ----------
    comm : MPI.Comm
        All ranks; rank 0 holds the lock.
    choice : FolderChoice

    Attributes
    ----------
    path : Path
    note : str or None
        Warning for the user if the file system has no locks.

    Raises
    ------
    InputError
        On every rank, if the folder cannot be created or another run uses it.
    """

    def __init__(self, comm: MPI.Comm, choice: FolderChoice) -> None:
        self._comm, self._choice = comm, choice
        self._created: list[Path] = []
        self._lock: FolderLock | None = None
        self.path, held = on_root(comm, self._create_and_lock)
        self.note = None if held else f"{self.path}: this file system has no locks: keep others out of it"

    def clean(self) -> None:
        """Remove old results (``--force``) or incomplete files of a killed run (``--resume``); collective.

        Raises
        ------
        InputError
            On every rank, if a file cannot be removed.
        """
        on_root(self._comm, self._remove_results)

    @property
    def descriptor(self) -> int:
        """Descriptor of the lock file, on rank 0; processes that inherit it keep the folder locked."""
        assert self._lock is not None
        return self._lock.descriptor

    def release(self) -> None:
        """Unlock the folder; not collective."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None
        self._remove_empty_folders()

    def __enter__(self) -> RunDirectory:
        return self

    def __exit__(self, *error: object) -> None:
        self.release()

    def _create_and_lock(self) -> tuple[Path, bool]:
        choice, path, kind = self._choice, self._choice.path, self._choice.kind
        fresh = not (choice.resume or choice.force)
        while True:
            try:
                self._create_folders(path)
                self._lock = FolderLock(path, kind.lock)
                if fresh and os.listdir(path) != [kind.lock]:
                    raise FileExistsError
                if choice.resume and not kind.resumable(path):  # another process has replaced it
                    raise InputError(f"holds {kind.missing}; run without --resume", file=path)
                return path, self._lock.held
            except (FileExistsError, FolderLocked) as error:
                self.release()
                if not fresh or choice.named:
                    raise self._taken_error(path, error) from None
                path = free_name(choice.first or choice.path)
            except OSError as error:
                self.release()
                raise InputError(f"cannot be used: {reason(error)}", file=path, key="--out") from error
            except InputError:
                self.release()
                raise

    def _taken_error(self, path: Path, error: Exception) -> InputError:
        if not isinstance(error, FolderLocked):
            return self._choice.kind.exists_error(path, "--out")
        text = f"another {self._choice.kind.noun} is at work in this folder ({error}); wait for it, or "
        key = "--resume" if self._choice.resume else "--out"
        return InputError(text + "name another folder", file=path, key=key)

    def _create_folders(self, path: Path) -> None:
        """Create the folder and its missing parents, and remember which folders were created."""
        missing = [folder for folder in (path, *path.parents) if not folder.exists()]
        for folder in reversed(missing):
            with suppress(FileExistsError):  # another run created it at the same moment
                folder.mkdir()
                self._created.append(folder)
        if not path.is_dir():
            raise NotADirectoryError(20, os.strerror(20))

    def _remove_empty_folders(self) -> None:
        for folder in reversed(self._created):
            try:
                folder.rmdir()
            except OSError:  # no longer empty
                break
        self._created.clear()

    def _remove_results(self) -> None:
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
    """Another process holds the lock; the message names it."""


class FolderLock:
    """A lock on a folder; for one rank.

    The kernel locks (``flock``) a lock file in the folder. A process that is killed leaves the file
    behind, unlocked; a process that ends normally removes it.

    Parameters
    ----------
    folder : Path
        An existing folder.
    name : str
        Name of the lock file.

    Attributes
    ----------
    descriptor : int
        Descriptor of the lock file.
    held : bool
        False if the file system does not support locks.

    Raises
    ------
    FolderLocked
        If another process holds the lock.
    OSError
        If the file cannot be created.
    """

    def __init__(self, folder: Path, name: str = LOCK_FILE) -> None:
        self.path = folder / name
        while True:
            self.descriptor = open_regular_file(self.path, os.O_RDWR | os.O_CREAT)
            try:
                self.held = self._lock()
                if self._is_current():
                    break
            except BaseException:
                os.close(self.descriptor)
                raise
            os.close(self.descriptor)  # the former holder removed the file after it was opened here
        with suppress(OSError):  # the lock is held even if a full disk prevents writing its text
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

    def _is_current(self) -> bool:
        """Whether the locked file is still the file at its path."""
        try:
            return os.path.samestat(os.fstat(self.descriptor), os.stat(self.path))
        except FileNotFoundError:
            return False

    def release(self) -> None:
        """Remove the lock file, then release the lock."""
        with suppress(OSError):  # the folder may have been removed
            if self._is_current():
                self.path.unlink()
        with suppress(OSError):
            os.close(self.descriptor)


def is_locked(folder: Path) -> bool:
    """Whether a process holds the lock of a folder; also True if the file system does not support locks."""
    try:
        descriptor = open_regular_file(folder / LOCK_FILE, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)  # releases the lock at once
    return False
