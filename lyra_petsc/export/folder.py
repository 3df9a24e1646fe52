"""The folder of an export: complete under its name, or not there."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output.agreement import reason
from lyra_petsc.output.folder import check_creatable

OURS = re.compile(r".+(_\d{4,}\.(obj|ply)|\.(glb|usdc|npz|vtkhdf))|times\.csv")
"""What exports write, and nothing else: --force removes no folder that holds more."""


def check_folder(path: Path, *, force: bool) -> None:
    """Refuse a folder that cannot be taken, before anything is done.

    Raises
    ------
    InputError
    """
    if not os.fspath(path).strip() or path == Path():
        raise InputError("is empty; give the folder to write to", key="--out")
    try:
        if os.path.lexists(path):
            _check_replaceable(path, force=force)
        check_creatable(path, "--out")
        if path.exists() and not os.access(path.absolute().parent, os.W_OK | os.X_OK):
            raise InputError("cannot be replaced: no permission in the folder above", file=path, key="--out")
    except OSError as error:
        raise InputError(f"cannot be used: {reason(error)}", file=path, key="--out") from None


def _check_replaceable(path: Path, *, force: bool) -> None:
    if path.is_symlink() or not path.is_dir():
        raise InputError("is a file; name a folder", file=path, key="--out")
    if not force:
        raise InputError("exists; name another folder, or give --force to replace it", file=path, key="--out")
    foreign = sorted(entry.name for entry in path.iterdir() if not OURS.fullmatch(entry.name))
    if foreign:
        raise InputError(
            f"holds '{foreign[0]}', which no export wrote; name another folder", file=path, key="--out"
        )


def fill_folder(path: Path, work: Callable[[Path], None]) -> None:
    """Let ``work`` write into a new folder, which takes its name, and the place of a former one, at the end.

    Raises
    ------
    OutputError
        If it could not be written; what stood there stands.
    """
    part, old = (path.with_name(path.name + ending) for ending in (".part", ".old"))
    made = [folder for folder in path.absolute().parents if not folder.exists()]
    try:
        _remove(part)  # a kill left it
        part.mkdir(parents=True)
        work(part)
        for file in part.iterdir():
            with open(file, "rb") as written:
                os.fsync(written.fileno())
        _remove(old)
        if path.exists():
            path.rename(old)
        part.rename(path)
        _remove(old)
    except BaseException as error:
        with suppress(OSError):
            _remove(part)
        for folder in made:
            with suppress(OSError):  # no longer empty
                folder.rmdir()
        if isinstance(error, OSError):
            raise OutputError(f"{path}: cannot be written: {reason(error)}") from error
        if isinstance(error, OutputError):
            raise OutputError(f"{path}: {error}") from error
        raise


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)
