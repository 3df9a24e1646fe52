"""Which folder a run writes to: chosen before anything is done."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from mpi4py import MPI

from lyra_petsc.errors import InputError
from lyra_petsc.output.agreement import reason
from lyra_petsc.output.checkpoint import checkpoint_files
from lyra_petsc.output.lock import LOCK_FILE
from lyra_petsc.parallel import on_root

RUNS = Path("runs")

# what a run writes, and nothing else: --force removes no other file
RESULT = re.compile(
    r"(states-\d{4,}\.h5|(mesh|cells)\.h5|checkpoint(-previous|-next)?\.h5|states\.(xdmf|vtkhdf)"
    r"|(history|probes|reactions)\.csv|scene\.yaml|summary\.json|failure\.(h5|xdmf|txt))(\.part)?"
)

Result = TypeVar("Result")


@dataclass(frozen=True)
class RunFolder:
    """The choice.

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
) -> RunFolder:
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
    return _shared(comm, lambda: _choose(scene_stem, out, force, resume))


def _shared(comm: MPI.Comm, work: Callable[[], Result]) -> Result:
    result = on_root(comm, work)
    assert result is not None
    return result


def _choose(stem: str, out: str | os.PathLike[str] | None, force: bool, resume: bool) -> RunFolder:
    if force and resume:
        raise InputError("--force begins anew and --resume goes on: give one of them", key="--force")
    key = "--out"
    if out is None:
        first = RUNS / stem
        if resume:
            return RunFolder(_newest(stem), resume=True, given=True)
        choice = RunFolder(first if force else free_name(first), given=force, force=force, first=first)
        key = "output folder"
    else:
        if not os.fspath(out):
            raise InputError("is empty; give the folder to write to", key=key)
        choice = RunFolder(Path(out), resume=resume, given=True, force=force)
    try:
        _check(choice, key)
    except OSError as error:
        raise InputError(f"cannot be used: {reason(error)}", file=choice.path, key=key) from error
    return choice


def _check(choice: RunFolder, key: str) -> None:
    path = choice.path
    if os.path.lexists(path) and not path.is_dir():
        raise InputError("is a file; name a folder", file=path, key=key)
    if choice.resume:
        if not path.is_dir():
            raise InputError("does not exist, so there is no run to resume", file=path, key="--resume")
        if not checkpoint_files(path):
            raise InputError(
                "holds no checkpoint to resume from; run without --resume", file=path, key="--resume"
            )
    elif choice.given and not choice.force and path.exists() and os.listdir(path) != [LOCK_FILE]:
        raise InputError(
            "exists; name another folder, or give --resume to go on with its run or --force to replace it",
            file=path,
            key=key,
        )
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
