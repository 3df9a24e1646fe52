"""States of a run: files states-NNNN.h5, each for several states from number NNNN on, and states.xdmf.

A file is created with preallocated datasets for several states. To write a state is to write its rows into
these datasets, and then its row in the file's table. A new file can hold as many states as exist already,
within bounds, so that there are few files and little unused space. A state is announced, that is, listed in
states.xdmf, when it is complete on disk.

failure.xdmf, failure.h5 and failure.txt hold the state before a failed step, the failing iterate and the
cause.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.errors import OutputError
from lyra_petsc.output.file_operations import cannot_write, reason, replace_text, sync
from lyra_petsc.output.hdf5 import Attributes, Empty, create_file, put_rows, rows_writable, write_rows
from lyra_petsc.output.layout import (
    CELLS_FILE,
    FAILURE_DATA,
    FAILURE_TEXT,
    FAILURE_XDMF,
    VTKHDF_FILE,
    XDMF_FILE,
)
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.stored import TABLE, check_sums, state_files, states_in
from lyra_petsc.output.vtkhdf_file import write_cells, write_vtkhdf
from lyra_petsc.output.xdmf import (
    GrowingXdmf,
    StoredField,
    TimeSeries,
    WrittenState,
    group_name,
)
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.schema import FIELD_UNITS

MIN_STATES, MAX_STATES = 4, 512
"""Bounds of the number of states that a file can hold."""

MAX_BYTES = 1 << 26
"""Upper bound of the size of a file's states, unless it holds a single state [bytes]."""

MAX_LAG = 0.1
"""During a run, states missing in ``states.vtkhdf``, relative to the states in it."""

UNITS = {**FIELD_UNITS, "position": "m", "residual": "N"}
"""Units of the datasets of a state by name, stored as their attribute ``units``."""

Fields = Mapping[str, tuple[str, NDArray[Any]]]
"""Fields by name: what the rows belong to (``vertex`` or ``triangle``), and this rank's rows."""


class StateWriter:
    """Writes states in the order of the mesh file; a state is announced only when it is complete.

    Parameters
    ----------
    folder : path
        The run's folder; holds ``mesh.h5``.
    vertices : FileOrder
        File order of the vertices that each rank owns.
    triangles : FileOrder, optional
        File order of the triangles that each rank owns; needed for fields on triangles.
    n_triangles : int
        Number of triangles of the whole mesh.
    resume_after : int, optional
        Keep the states up to and including this step, remove later ones and continue with the
        next number. Otherwise the first state is number 0.
    vtkhdf : bool
        Announce the states in ``states.vtkhdf``, too.
    time_unit : str
        Unit of the states' times.

    Raises
    ------
    OutputError
        On every rank, if later states cannot be removed.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        vertices: FileOrder,
        triangles: FileOrder | None = None,
        *,
        n_triangles: int,
        resume_after: int | None = None,
        vtkhdf: bool = False,
        time_unit: str = "s",
    ) -> None:
        self.folder = Path(folder)
        self.vertices = vertices
        self._comm = vertices.comm
        self._orders = {"vertex": vertices} | ({} if triangles is None else {"triangle": triangles})
        self.n_triangles = n_triangles
        self._document = GrowingXdmf(self.folder / XDMF_FILE)  # of rank 0
        self._n_in_vtkhdf = 0  # of rank 0
        self._series = TimeSeries(vertices.n_global, n_triangles)
        self._next = 0
        # the newest file: its path, the numbers of its states, and their fields
        self._path, self._numbers = Path(), range(0)
        self._fields: tuple[StoredField, ...] = ()
        self._vtkhdf, self._time_unit = vtkhdf, time_unit
        if vtkhdf:
            on_root(self._comm, lambda: write_cells(self.folder))
        if resume_after is not None:
            self._next = on_root(self._comm, lambda: self._truncate(resume_after))

    def write(self, step: int, time: float, position: Array, fields: Fields) -> Callable[[], None]:
        """Write one state; collective.

        Parameters
        ----------
        step : int
            Accepted steps so far.
        time : float
            [s].
        position : (n_owned, 3) float64
            Current positions of this rank's vertices [m].
        fields : mapping of str to (str, (n_owned, ...) array)
            Further fields on this rank's vertices or triangles: floats or integers; names, types and
            trailing shapes are the same on every rank.

        Returns
        -------
        callable
            To be called on rank 0 before the next state is written, also in another thread: when the state is
            listed in its file and on disk, it is listed in states.xdmf and, unless too few are new, in
            states.vtkhdf.

        Raises
        ------
        OutputError
            On every rank, if a file cannot be written; states announced before are kept.
        """
        slabs = {"position": self.vertices.to_slab(np.asarray(position, dtype=np.float64))}
        slabs |= {name: self._orders[on].to_slab(rows) for name, (on, rows) in fields.items()}
        described = tuple(
            StoredField(name, on, (self._orders[on].n_global, *slabs[name].shape[1:]), slabs[name].dtype.name)
            for name, (on, _) in fields.items()
        )
        number = self._next
        if number not in self._numbers or described != self._fields:
            self._begin_file(described)
        state = WrittenState(number, int(step), float(time), self._path.name, described)
        sums = check_sums(slabs.values(), self._comm)
        rows = {f"{group_name(number)}/{name}": slab for name, slab in slabs.items()}
        write_rows(self._path, rows, self._comm)
        self._next += 1
        return lambda: self._announce(state, sums)

    def finish(self) -> None:
        """List all announced states in ``states.vtkhdf``; collective.

        Raises
        ------
        OutputError
            On every rank, if ``states.vtkhdf`` cannot be written.
        """

        def work() -> None:
            if self._n_in_vtkhdf < self._next:
                self._write_vtkhdf(states_in(self.folder, skip_damaged=True))

        if self._vtkhdf:
            on_root(self._comm, work)

    def _begin_file(self, fields: tuple[StoredField, ...]) -> None:
        """Create a file for the next states; collective."""
        first = self._next
        position = StoredField("position", "vertex", (self.vertices.n_global, 3), "float64")
        empty = {field.name: Empty(field.shape, np.dtype(field.dtype)) for field in (position, *fields)}
        size = sum(rows.dtype.itemsize * math.prod(rows.shape) for rows in empty.values())
        slots = max(1, min(max(first, MIN_STATES), MAX_STATES, MAX_BYTES // max(size, 1)))
        path = self.folder / f"states-{first:04d}.h5"

        def create() -> None:
            table = {
                f"{TABLE}/step": np.full(slots, -1, np.int64),
                f"{TABLE}/time": np.zeros(slots),
                f"{TABLE}/sums": np.zeros((slots, len(empty)), np.uint64),
            }
            planned = {
                f"{group_name(first + i)}/{name}": rows for i in range(slots) for name, rows in empty.items()
            }
            columns = json.dumps([(field.name, field.on) for field in (position, *fields)])
            attributes: Attributes = {
                TABLE: {"first": first, "columns": columns},
                f"{TABLE}/time": {"units": self._time_unit},
                **_units(planned),
            }
            create_file(path, {**table, **planned}, attributes)

        on_root(self._comm, create)
        self._path, self._numbers, self._fields = path, range(first, first + slots), fields

    def _announce(self, state: WrittenState, sums: NDArray[np.uint64]) -> None:
        row = state.number - self._numbers.start
        with rows_writable(self._path) as file:
            put_rows(file, f"{TABLE}/time", row, np.array([state.time]))
            put_rows(file, f"{TABLE}/sums", row, sums[None])
            file.flush()
            put_rows(file, f"{TABLE}/step", row, np.array([state.step]))  # which makes the row valid
        sync(self._path)
        grid = self._series.grid(state)
        try:
            if state.number == 0:
                self._document.replace([grid])
            else:
                self._document.append(grid)
        except FileNotFoundError:  # removed or changed by somebody: write it again from the states' files
            if not self.folder.is_dir():
                raise cannot_write(self._document.path, FileNotFoundError()) from None
            self._document.replace(map(self._series.grid, states_in(self.folder, skip_damaged=True)))
        # the file is always written as a whole, so it is written less often the more states there are
        if self._vtkhdf and state.number + 1 >= (1.0 + MAX_LAG) * self._n_in_vtkhdf:
            self._write_vtkhdf(states_in(self.folder, skip_damaged=True))

    def _write_vtkhdf(self, states: Sequence[WrittenState]) -> None:
        write_vtkhdf(self.folder, states, self.vertices.n_global, self.n_triangles)
        self._n_in_vtkhdf = len(states)

    def _truncate(self, last_step: int) -> int:
        """Announce the states up to ``last_step``, and only then remove the later ones (rank 0).

        Returns the number of the next state.
        """
        keep = [state for state in states_in(self.folder, skip_damaged=True) if state.step <= last_step]
        self._document.replace(map(self._series.grid, keep))
        if self._vtkhdf:
            self._write_vtkhdf(keep)
        unwanted = [] if self._vtkhdf else [self.folder / VTKHDF_FILE, self.folder / CELLS_FILE]
        kept = {state.file for state in keep}
        try:
            for path in state_files(self.folder):
                if path.name not in kept:
                    path.unlink()
                else:
                    with rows_writable(path) as file:
                        steps = file[TABLE]["step"]
                        steps[...] = np.where(steps[...] > last_step, -1, steps[...])
            for path in unwanted:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: a later state cannot be removed: {reason(error)}") from error
        return max((state.number for state in keep), default=-1) + 1


def _units(datasets: Iterable[str]) -> dict[str, dict[str, int | float | str]]:
    """Attributes of a file that give the units of datasets of states, by their paths."""
    names = {path: path.rpartition("/")[2] for path in datasets}
    return {path: {"units": UNITS[name]} for path, name in names.items() if name in UNITS}


@dataclass(frozen=True)
class FailureState:
    """Positions and fields of the state before a failed step, or of the failing iterate.

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
    states: tuple[FailureState, FailureState],
    text: str,
) -> None:
    """Write the state before a failed step and the failing iterate; collective.

    Parameters
    ----------
    folder : path
        The run's folder; holds ``mesh.h5``.
    vertices : FileOrder
        File order of the vertices that each rank owns.
    n_triangles : int
        Number of triangles of the whole mesh.
    step : int
        Number of accepted steps.
    states : pair of FailureState
        The state before the step and the failing iterate.
    text : str
        Content of ``failure.txt``.

    Raises
    ------
    OutputError
        On every rank, if a file cannot be written.
    """
    folder = Path(folder)
    on_root(vertices.comm, lambda: replace_text(folder / FAILURE_TEXT, text))
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
        written.append(WrittenState(number, step + number, state.time, FAILURE_DATA, fields))
    attributes |= _units(datasets)
    write_rows(folder / FAILURE_DATA, datasets, vertices.comm, create=attributes)
    document = TimeSeries(vertices.n_global, n_triangles).text(written)
    on_root(vertices.comm, lambda: replace_text(folder / FAILURE_XDMF, document))


def remove_failure(folder: str | os.PathLike[str]) -> None:
    """Remove the failure files of an earlier run. Call on one rank.

    Raises
    ------
    OutputError
        If a file cannot be removed.
    """
    try:
        for name in (FAILURE_XDMF, FAILURE_DATA, FAILURE_TEXT):
            (Path(folder) / name).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: {name} cannot be removed: {reason(error)}") from error
