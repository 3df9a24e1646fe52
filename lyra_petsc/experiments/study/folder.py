"""The folder of a study: chosen before anything runs, locked while it does."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from mpi4py import MPI

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.experiments.study.request import REQUEST_FILE
from lyra_petsc.output.agreement import reason
from lyra_petsc.output.run_folder import check_creatable, free_name
from lyra_petsc.parallel import on_root

STUDIES = Path("studies")
CASES = "cases"
LOCK_FILE = "study.lock"

# what a study writes beside its cases, and nothing else: --force removes no other file
RESULT = re.compile(
    r"(study\.(csv|json|lock)|request\.json|report\.(html|md)"
    r"|(work-precision|convergence)[\w.+-]*\.(png|svg))(\.part)?"
)


@dataclass(frozen=True)
class StudyFolder:
    """The choice.

    Attributes
    ----------
    path : Path
    resume : bool
        It holds a study that goes on.
    force : bool
        What stands there is replaced.
    given : bool
        Named by the user; otherwise another name is found if this one is taken meanwhile.
    first : Path or None
        To which that name is added a number.
    """

    path: Path
    resume: bool = False
    force: bool = False
    given: bool = False
    first: Path | None = None


def choose_folder(stem: str, out: Path | None, *, force: bool, resume: bool) -> StudyFolder:
    """Decide on the folder without touching the disk. For rank 0.

    Parameters
    ----------
    stem : str
        File name of the scene without its ending.
    out : Path or None
        ``--out``. Without it ``studies/<stem>``, or ``…-2``, ``…-3`` when that exists; with ``resume``
        the newest study of that scene, with ``force`` always ``studies/<stem>``.

    Raises
    ------
    InputError
        If the folder cannot be used.
    """
    if force and resume:
        raise InputError("--force begins anew and --resume goes on: give one of them", key="--force")
    if out is not None and not os.fspath(out).strip():
        raise InputError("is empty; give the folder to write to", key="--out")
    first = STUDIES / stem
    if out is None and resume:
        return StudyFolder(_newest(stem), resume=True, given=True)
    path = out if out is not None else (first if force else free_name(first))
    choice = StudyFolder(path, resume=resume, force=force, given=out is not None or force, first=first)
    try:
        _check(choice)
    except OSError as error:
        raise InputError(f"cannot be used: {reason(error)}", file=path, key="--out") from None
    return choice


def _check(choice: StudyFolder) -> None:
    path = choice.path
    if os.path.lexists(path) and not path.is_dir():
        raise InputError("is a file; name a folder", file=path, key="--out")
    if choice.resume and not (path / REQUEST_FILE).is_file():
        raise InputError("holds no study to resume", file=path, key="--resume")
    if path.exists() and not (choice.resume or choice.force):
        raise InputError(
            "exists; name another folder, or give --resume to go on with its study or --force to replace it",
            file=path,
            key="--out",
        )
    check_creatable(path, "--out")


def _newest(stem: str) -> Path:
    ours = re.compile(re.escape(stem) + r"(-\d+)?")
    ages = [
        ((path / REQUEST_FILE).stat().st_mtime, path)
        for path in (STUDIES.iterdir() if STUDIES.is_dir() else [])
        if ours.fullmatch(path.name) and (path / REQUEST_FILE).is_file()
    ]
    if not ages:
        raise InputError(f"no study of {stem} under {STUDIES}; run without --resume", key="--resume")
    return max(ages)[1]


class Lock:
    """Holds a study's folder: created if need be, and locked so that no second study writes into it.

    The lock is the kernel's and goes with the process, however it ends. Construction is collective.

    Attributes
    ----------
    path : Path
        The folder.

    Raises
    ------
    InputError
        On every rank, if another study is at work in it or it cannot be created.
    """

    def __init__(self, comm: MPI.Comm, choice: StudyFolder) -> None:
        self._file: TextIO | None = None
        path = on_root(comm, lambda: self._open(choice))
        assert path is not None
        self.path = path

    def _open(self, choice: StudyFolder) -> Path:
        path = choice.path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            while True:
                try:
                    path.mkdir(exist_ok=choice.resume or choice.force)
                    break
                except FileExistsError:
                    if choice.given:
                        raise
                    path = free_name(choice.first or choice.path)
            self._file = (path / LOCK_FILE).open("a", encoding="utf-8")
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    "another study is at work in this folder; wait for it, or name another with --out",
                    file=path,
                    key="--out",
                ) from None
            except OSError:
                pass  # the file system has no locks
            if choice.force:
                clear(path)
            (path / CASES).mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot be created: {reason(error)}", file=path, key="--out") from None
        return path

    @property
    def descriptor(self) -> int:
        """Of the locked file, on rank 0."""
        assert self._file is not None
        return self._file.fileno()

    def release(self) -> None:
        """Release the lock of the folder; not collective."""
        if self._file is not None:
            self._file.close()
            self._file = None


def clear(path: Path) -> None:
    """Remove a study's results from its folder, and nothing else."""
    for entry in sorted(path.iterdir()):
        if entry.name == LOCK_FILE:
            continue
        if RESULT.fullmatch(entry.name):
            entry.unlink()
    shutil.rmtree(path / CASES, ignore_errors=True)


def empty_case(folder: Path) -> None:
    """An empty folder for a case; what a stopped one left is removed.

    Raises
    ------
    OutputError
    """
    try:
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be prepared: {reason(error)}") from error
