"""A run's folder while the run lasts: made, locked against a second run, cleared, let go."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from mpi4py import MPI

from lyra_petsc.errors import InputError
from lyra_petsc.output.agreement import reason
from lyra_petsc.output.checkpoint import checkpoint_files
from lyra_petsc.output.folder import RESULT, RunFolder, free_name
from lyra_petsc.output.lock import LOCK_FILE, Busy, FolderLock
from lyra_petsc.parallel import on_root


class Claim:
    """Take the folder chosen for one run, from before its set-up to its end; construction is collective.

    A folder made for it that is still empty at the end is removed again.

    Parameters
    ----------
    comm : MPI.Comm
        All ranks; rank 0 holds the lock.
    choice : RunFolder

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

    def __init__(self, comm: MPI.Comm, choice: RunFolder) -> None:
        self._comm, self._choice = comm, choice
        self._made: list[Path] = []
        self._lock: FolderLock | None = None
        found = on_root(comm, self._take)
        assert found is not None
        self.path, held = found
        self.note = None if held else f"{self.path}: this file system has no locks: keep other runs out of it"

    def clear(self) -> None:
        """Remove old results (``--force``) or what a kill left half-written (``--resume``); collective.

        Raises
        ------
        InputError
            On every rank, if they cannot be removed.
        """
        on_root(self._comm, self._clear)

    def release(self) -> None:
        """Let go of the folder; not collective."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None
        self._unmake()

    def __enter__(self) -> Claim:
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
                    raise InputError("holds no checkpoint to resume from; run without --resume", file=path)
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
        return InputError(
            "exists; name another folder, or give --resume to go on with its run or --force to replace it",
            file=path,
            key="--out",
        )

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
