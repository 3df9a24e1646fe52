"""Exports a run: the formats, the choice of states, and the folder, which is complete or not there."""

from __future__ import annotations

import csv
import os
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from lyra_petsc.errors import InputError, OutputError, nearest
from lyra_petsc.extras import require
from lyra_petsc.output.agreement import reason
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.run_folder import check_creatable
from lyra_petsc.show.export import formats

OURS = re.compile(r".+(_\d{4,}\.(obj|ply)|\.(glb|usdc|npz|vtkhdf))|times\.csv")
"""Files that an export writes: --force removes no folder that holds others."""


@dataclass(frozen=True)
class ExportFormat:
    """A format, which ``formats.write_<name>`` writes.

    Attributes
    ----------
    packages : tuple of str
        What it needs of the extra ``export``.
    fields : bool
        Whether it holds more than positions.
    sequence : bool
        Whether each state has a file, which does not hold its time.
    """

    packages: tuple[str, ...] = ()
    fields: bool = True
    sequence: bool = False


FORMATS = {
    "obj": ExportFormat(fields=False, sequence=True),
    "ply": ExportFormat(("meshio",), sequence=True),
    "gltf": ExportFormat(("pygltflib",), fields=False),
    "usd": ExportFormat(("pxr",)),
    "vtkhdf": ExportFormat(),
    "npz": ExportFormat(),
}
"""Formats by the names that ``--to`` takes."""


@dataclass(frozen=True)
class Exported:
    """What was written.

    Attributes
    ----------
    folder : Path
    files : tuple of str
        Their names, sorted.
    states : int
    """

    folder: Path
    files: tuple[str, ...]
    states: int


def export_run(
    run: str | Path,
    to: str,
    out: Path | None = None,
    *,
    times: str | None = None,
    every: int | None = None,
    displacement: bool = False,
    force: bool = False,
) -> Exported:
    """Write states of a run in another format.

    Parameters
    ----------
    run : path
        A run's folder.
    to : str
        One of ``FORMATS``.
    out : path, optional
        Else a folder in the run's, with the name of the format.
    times : str, optional
        Numbers [s] with commas between: the states nearest to them.
    every : int, optional
        Every nth state.
    displacement : bool
        Add the displacement from the run's first state as a field.
    force : bool
        Replace a former export.

    Raises
    ------
    InputError
        Bad input; nothing is written.
    OutputError
        If the files cannot be written; nothing is left of them.
    """
    if to not in FORMATS:
        raise InputError(f"unknown format {to!r}, {nearest(to, FORMATS)}", key="--to")
    if displacement and not FORMATS[to].fields:
        able = ", ".join(name for name, form in FORMATS.items() if form.fields)
        raise InputError(f"{to} holds positions alone; take --to {able}", key="--displacement")
    require(f"export --to {to}", FORMATS[to].packages, "export")
    found = StoredRun(run)
    folder = out if out is not None else found.folder / to
    check_folder(folder, force=force)
    states = replace(formats.choose(found, times, every), displacement=displacement)
    # without characters that Windows or a shell treats specially; letters of any script stay
    name = re.sub(r"[^\w.+-]", "_", found.name).strip(".") or "run"

    def work(part: Path) -> None:
        getattr(formats, f"write_{to}")(states, part, name)
        if FORMATS[to].sequence and len(states) > 1:
            with open(part / "times.csv", "w", encoding="utf-8", newline="") as file:
                table = csv.writer(file, lineterminator="\n")
                table.writerow(("file", "state", "time"))
                numbered = enumerate(zip(states.chosen, states.times.tolist(), strict=True))
                table.writerows((number, state, repr(time)) for number, (state, time) in numbered)

    fill_folder(folder, work)
    return Exported(folder, tuple(sorted(file.name for file in folder.iterdir())), len(states))


def check_folder(path: Path, *, force: bool) -> None:
    """Check that a folder can be created or replaced, before anything is done.

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
    """Let ``work`` write into a new folder, which gets its name at the end and replaces a former one.

    Raises
    ------
    OutputError
        If it could not be written; a former folder is left as it was.
    """
    part, old = (path.with_name(path.name + ending) for ending in (".part", ".old"))
    created = [folder for folder in path.absolute().parents if not folder.exists()]
    try:
        _remove(part)  # left by a process that was killed
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
        for folder in created:
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
