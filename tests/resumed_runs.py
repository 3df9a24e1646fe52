"""Runs that are stopped and resumed, and what of two runs must be the same."""

from __future__ import annotations

import csv
import itertools
import json
import signal
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from physics import direct_solver, options, scene_of

from lyra_petsc.api.run_loop import ProgressCallbacks, simulate
from lyra_petsc.arrays import Array
from lyra_petsc.errors import Interrupted
from lyra_petsc.output.run_folder import FolderChoice
from lyra_petsc.output.stored import import_h5py

OF_THE_SOLVER = ("newton_iterations", "linear_iterations", "residual")
"""Columns that depend on rounding if the order of a sum changes."""


def simulate_until(
    comm: MPI.Comm, scene: dict[str, Any], folder: Path, stop: int | None, *, resume: bool = False
) -> tuple[int, float]:
    """Run up to step ``stop`` with a direct solver; returns step number and time."""
    asked = itertools.count(last(folder)[0] if resume else 0)  # before the first step, and after each
    with suppress(Interrupted), options(direct_solver(comm) | {"ksp_rtol": "1e-12"}):
        simulate(
            comm,
            scene_of(scene),
            FolderChoice(folder, resume=resume),
            ProgressCallbacks(),
            lambda: signal.SIGINT if next(asked) == stop else 0,
        )
    comm.Barrier()
    return last(folder)


def summary(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


def last(folder: Path) -> tuple[int, float]:
    """Step and time of the checkpoint."""
    with import_h5py().File(folder / "checkpoint.h5", "r") as file:
        scalars = json.loads(file["entries"][64:].tobytes())["scalars"]
    return scalars["step"], scalars["time"]


def kept(folder: Path) -> dict[str, Array]:
    """Positions, velocities and state of the integrator, in the order of the mesh."""
    with import_h5py().File(folder / "checkpoint.h5", "r") as file:
        return {name: np.array(data) for name, data in file["vertices"].items()}


def table(folder: Path, name: str) -> dict[str, Array]:
    """The columns of a table, without wall times; text as text."""
    with open(folder / name, encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    columns = (np.array(column) for column in zip(*rows, strict=True))
    named = {column: values for column, values in zip(header, columns, strict=True) if "wall" not in column}
    for column, values in named.items():
        with suppress(ValueError):
            named[column] = values.astype(float)
    return named


def same_tables(one: Path, other: Path, tolerance: float) -> None:
    """Check that both folders have the same tables, up to ``tolerance`` of the largest number of a column, or
    of the three of a vector.
    """
    names = sorted(path.name for path in other.glob("*.csv"))
    assert sorted(path.name for path in one.glob("*.csv")) == names
    for name in names:
        columns, others = table(one, name), table(other, name)
        assert columns.keys() == others.keys(), name
        sizes: dict[str, float] = {}  # of vectors, by their names without the axis
        for column, values in others.items():
            finite = np.abs(values[np.isfinite(values)]) if values.dtype.kind == "f" else np.zeros(1)
            vector = column.rstrip("xyz")
            sizes[vector] = max(sizes.get(vector, 0.0), float(finite.max(initial=0.0)))
        for column, values in others.items():
            if column in OF_THE_SOLVER:
                continue
            where = f"{name}: {column}"
            if values.dtype.kind == "U":
                np.testing.assert_array_equal(columns[column], values, err_msg=where)
                continue
            within = max(tolerance * sizes[column.rstrip("xyz")], 1e-3 * tolerance)
            np.testing.assert_allclose(columns[column], values, rtol=0.0, atol=within, err_msg=where)
