"""CSV tables with rows for each accepted step: history.csv, probes.csv, reactions.csv, obstacles.csv."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from lyra_petsc.errors import InputError
from lyra_petsc.output.file_operations import atomic_write, open_output, writing
from lyra_petsc.parallel import on_root
from lyra_petsc.terms.energies import ENERGIES

if TYPE_CHECKING:
    from mpi4py import MPI

HISTORY_COLUMNS = (
    "step",
    "time",
    "dt",
    "newton_iterations",
    "linear_iterations",
    "rejected",
    "kinetic_energy",
    *ENERGIES,
    "external_work",
    "dissipation",
    "residual",
    "wall_seconds",
)

OBSTACLE_COLUMNS = ("step", "time", "obstacle", "fx", "fy", "fz", "tx", "ty", "tz", "normal", "friction")


def vector_columns(names: Sequence[str]) -> tuple[str, ...]:
    """``step, time`` and the columns ``<name>_x, <name>_y, <name>_z`` of each name."""
    return ("step", "time", *(f"{name}_{axis}" for name in names for axis in "xyz"))


class History:
    """A CSV table on disk that rank 0 writes row by row. Construction is collective.

    Parameters
    ----------
    path : path
        The file; an existing file is replaced or, with ``resume_after``, continued.
    columns : sequence of str
        The header; the first column is ``step``.
    comm : MPI.Comm
        All ranks of the run.
    resume_after : int, optional
        Keep the rows up to and including this step, remove later and incomplete rows, and append after
        them. A missing file is created.

    Attributes
    ----------
    kept_until : int
        Step of the last row that was kept; −1 without one.

    Raises
    ------
    InputError
        On all ranks, if the file to be continued has other columns.
    OutputError
        On all ranks, if the file cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        columns: Sequence[str],
        comm: MPI.Comm,
        *,
        resume_after: int | None = None,
    ) -> None:
        self.path = Path(path)
        self.columns = tuple(columns)
        self._file: BinaryIO | None = None
        self.kept_until = -1
        on_root(comm, lambda: self._open(resume_after))
        self.kept_until = comm.bcast(self.kept_until, root=0)

    def append(self, *rows: Mapping[str, float | str]) -> None:
        """Write the rows of a step. Call on rank 0 within `on_root`, so that all ranks raise its errors.

        Parameters
        ----------
        rows : mapping
            A number or a name for each column.

        Raises
        ------
        OutputError
            On rank 0.
        """
        with writing(self.path):
            self._write([_format(values[name]) for name in self.columns] for values in rows)

    def close(self) -> None:
        """Close the file; nothing can be appended afterwards.

        ``append`` flushes every row, so only the rest of a failed row is lost.
        """
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None

    def _open(self, resume_after: int | None) -> None:
        with writing(self.path):
            continued = resume_after is not None and self.path.exists()
            if resume_after is not None and continued:
                self._truncate(resume_after)
            self._file = open_output(self.path, "ab" if continued else "wb")
            if not continued:
                self._write([self.columns])

    def _write(self, rows: Iterable[Sequence[str]]) -> None:
        """Write all rows in one call."""
        assert self._file is not None
        lines = StringIO()
        csv.writer(lines, lineterminator="\n").writerows(rows)
        self._file.write(lines.getvalue().encode())
        self._file.flush()

    def _truncate(self, last_step: int) -> None:
        """Replace the file atomically by its header and its complete rows up to ``last_step``."""
        check_columns(self.path, self.columns)
        with open(self.path, "rb") as old, atomic_write(self.path) as new:
            new.write(old.readline())
            for line in old:
                if not line.endswith(b"\n") or not _is_row_until(line, last_step):
                    break
                self.kept_until = int(line.split(b",", 1)[0])
                new.write(line)


def check_columns(path: Path, columns: Sequence[str]) -> None:
    """Check that a table to be continued has these columns. Call on one rank.

    Raises
    ------
    InputError
        If the columns differ. A missing or unreadable file is not an error here; `History` reports it.
    """
    with suppress(OSError), open(path, encoding="utf-8", errors="replace", newline="") as table:
        header = next(csv.reader([table.readline()]), [])
        if tuple(header) != tuple(columns):
            raise InputError(
                f"has the columns {', '.join(header)}; this run writes {', '.join(columns)}: "
                "resume with the scene it was begun with",
                file=path,
            )


def _is_row_until(line: bytes, last_step: int) -> bool:
    try:
        return int(line.split(b",", 1)[0]) <= last_step
    except ValueError:
        return False


def _format(value: float | str) -> str:
    """The shortest text that reads back as the same number; a name on one line."""
    if isinstance(value, str):
        return " ".join(value.splitlines())
    return str(int(value)) if isinstance(value, int | np.integer) else repr(float(value))
