"""failure.xdmf, failure.h5 and failure.txt: the states before and in a step that failed, and why."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import OutputError
from lyra_petsc.output.agreement import reason, replace_text
from lyra_petsc.output.hdf5 import NewFile, write_collective
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.xdmf import MESH_FILE, StoredField, TimeSeries, WrittenState, group_name
from lyra_petsc.parallel import on_root

Array = NDArray[np.float64]

DATA_FILE, XDMF_FILE, TEXT_FILE = "failure.h5", "failure.xdmf", "failure.txt"


@dataclass(frozen=True)
class StateInTime:
    """Positions and fields at one time.

    Attributes
    ----------
    time : float
        [s], or load factor.
    position : (n_owned, 3) float64
        [m], finite.
    fields : mapping of str to (n_owned, 3) float64
        The same names on all ranks.
    """

    time: float
    position: Array
    fields: Mapping[str, Array]


def write_failure(
    folder: str | os.PathLike[str],
    vertices: FileOrder,
    n_triangles: int,
    step: int,
    states: tuple[StateInTime, StateInTime],
    text: str,
) -> None:
    """Write the state before a step and the iterate at which it failed; collective.

    Parameters
    ----------
    folder : path
        The run's folder; holds ``mesh.h5``.
    vertices : FileOrder
        Order of the vertices each rank owns.
    n_triangles : int
        Triangles of the whole mesh.
    step : int
        Number of the state before.
    states : pair of StateInTime
        The two.
    text : str
        For ``failure.txt``.

    Raises
    ------
    OutputError
        On every rank, if something could not be written.
    """
    folder = Path(folder)
    on_root(vertices.comm, lambda: replace_text(folder / TEXT_FILE, text))
    datasets: dict[str, Array] = {}
    attributes: dict[str, dict[str, int | float | str]] = {}
    written = []
    for number, state in enumerate(states):
        group = group_name(number)
        attributes[group] = {"time": state.time, "step": step + number}
        rows = {"position": state.position, **state.fields}
        datasets |= {f"{group}/{name}": vertices.to_slab(values) for name, values in rows.items()}
        fields = tuple(
            StoredField(name, "vertex", (vertices.n_global, *values.shape[1:]), values.dtype.name)
            for name, values in state.fields.items()
        )
        written.append(WrittenState(number, step + number, state.time, DATA_FILE, fields))
    write_collective([NewFile(folder / DATA_FILE, datasets, attributes)], vertices.comm)
    document = TimeSeries(vertices.n_global, n_triangles, MESH_FILE).text(written)
    on_root(vertices.comm, lambda: replace_text(folder / XDMF_FILE, document))


def remove_failure(folder: str | os.PathLike[str]) -> None:
    """Remove what an earlier run wrote here. Call on one rank.

    Raises
    ------
    OutputError
        If it cannot be removed.
    """
    try:
        for name in (XDMF_FILE, DATA_FILE, TEXT_FILE):
            (Path(folder) / name).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: {name} cannot be removed: {reason(error)}") from error
