"""From a run's folder to a folder with files for other programs."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path

from lyra_petsc.errors import InputError
from lyra_petsc.export.folder import check_folder, fill_folder
from lyra_petsc.export.frames import Frames, choose
from lyra_petsc.export.registry import FORMATS
from lyra_petsc.extras import require
from lyra_petsc.nearest import nearest
from lyra_petsc.results.run import Run


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
        Every so manieth state.
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
    require(f"export --to {to}", FORMATS[to].packages, "export")
    found = Run(run)
    folder = out if out is not None else found.folder / to
    check_folder(folder, force=force)
    frames = choose(found, times, every)
    name = _file_name(found.name)

    def work(part: Path) -> None:
        FORMATS[to].write(frames, part, name)
        if len(list(part.iterdir())) > 1:
            _write_times(part / "times.csv", frames)

    fill_folder(folder, work)
    return Exported(folder, tuple(sorted(file.name for file in folder.iterdir())), len(frames))


def _file_name(name: str) -> str:
    """The run's name without what Windows or a shell stumbles over; letters of any script stay."""
    return re.sub(r"[^\w.+-]", "_", name).strip(".") or "run"


def _write_times(path: Path, frames: Frames) -> None:
    """Which file is which state: times are not in the files of a sequence."""
    with open(path, "w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("file", "state", "time"))
        for number, (state, time) in enumerate(zip(frames.chosen, frames.times.tolist(), strict=True)):
            table.writerow((number, state, repr(time)))
