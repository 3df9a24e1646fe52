"""history.csv and its like as columns."""

from __future__ import annotations

import csv
import importlib.util
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.output.agreement import reason

Columns: TypeAlias = dict[str, NDArray[Any]]

COUNTS = frozenset({"step", "newton_iterations", "linear_iterations", "rejected"})
"""Columns of whole numbers."""


def read_table(path: Path) -> Columns:
    """The columns of a table, without a last row that is not whole yet.

    Raises
    ------
    InputError
        If it is missing or damaged.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot be read: {reason(error)}", file=path) from None
    except UnicodeDecodeError:
        raise InputError("is damaged", file=path) from None
    header, *rows = list(csv.reader(text[: text.rfind("\n") + 1].splitlines())) or [[]]
    if not header or any(len(row) != len(header) for row in rows):
        raise InputError("is damaged", file=path)
    try:
        return {
            name: np.array([row[i] for row in rows], dtype="U64").astype(
                np.int64 if name in COUNTS else float
            )
            for i, name in enumerate(header)
        }
    except ValueError:
        raise InputError("is damaged", file=path) from None


def _type(name: str) -> type:
    return np.int64 if name in COUNTS else np.float64


def as_frame(columns: Columns) -> Any:
    """A pandas frame where pandas is installed, else the columns as they are."""
    if importlib.util.find_spec("pandas") is None:
        return columns
    import pandas

    return pandas.DataFrame(columns)
