"""States of a run: files states-NNNN.h5, each for several states from number NNNN on, and states.xdmf.

A file is created with preallocated datasets for several states. To write a state is to write its rows into
these datasets, and then its row in the file's table. HDF5's metadata do not change, so the file can be read
at any time. A new file can hold as many states as exist already, within bounds, so that there are few files
and little unused space. A state is announced, that is, listed in states.xdmf, when it is complete on disk.

failure.xdmf, failure.h5 and failure.txt hold the state before a failed step, the failing iterate and the
cause.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output.file_operations import (
    HDF5_ERRORS,
    cannot_write,
    open_output,
    reason,
    replace_text,
    writing,
)
from lyra_petsc.output.hdf5 import Background, NewFile, preallocate, write_collective
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.stored import TABLE, OutsideFolderError, check_sums, open_stored, text_attribute
from lyra_petsc.output.tensors import TENSORS
from lyra_petsc.output.vtkhdf_file import CELLS_FILE, VTKHDF_FILE, write_cells, write_vtkhdf
from lyra_petsc.output.xdmf import (
    XDMF_FILE,
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

STATE_FILE = re.compile(r"states-(\d{4,})\.h5")

Fields = Mapping[str, tuple[str, NDArray[Any]]]
"""Fields by name: what the rows belong to (``vertex`` or ``triangle``), and this rank's rows."""


class StateWriter:
    """Writes states in the order of the mesh file; a state is announced only when it is complete on disk.

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
    background : Background, optional
        Completes and announces states while the run continues.

    Attributes
    ----------
    in_plane : frozenset of str
        Tensor fields that existing states hold with three components, as older versions wrote them; new
        states must do so, too.

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
        background: Background | None = None,
    ) -> None:
        self.folder = Path(folder)
        self.vertices = vertices
        self._orders = {"vertex": vertices} | ({} if triangles is None else {"triangle": triangles})
        self.n_triangles = n_triangles
        self._file: _PreallocatedFile | None = None
        self._document = GrowingXdmf(self.folder / XDMF_FILE)  # of rank 0
        self._states: list[WrittenState] = []  # of rank 0, for states.vtkhdf
        self._n_in_vtkhdf = 0
        self._series = TimeSeries(vertices.n_global, n_triangles)
        self._next = 0
        self._vtkhdf, self._time_unit, self._background = vtkhdf, time_unit, background
        if vtkhdf:
            on_root(self._comm, lambda: write_cells(self.folder))
        self.in_plane: frozenset[str] = frozenset()
        if resume_after is not None:
            self._next, self.in_plane = on_root(self._comm, lambda: self._truncate(resume_after))

    @property
    def _comm(self) -> MPI.Comm:
        return self.vertices.comm

    def write(
        self,
        step: int,
        time: float,
        position: Array,
        fields: Fields,
        other_files: Sequence[NewFile] = (),
    ) -> int:
        """Write and announce one state; collective. Returns its number.

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
        other_files : sequence of NewFile
            Files that are completed before the state is announced.

        Raises
        ------
        OutputError
            On every rank, if a file cannot be written; states announced before are kept. With a background,
            the error may be that of the previous state.
        """
        slabs = {"position": self.vertices.to_slab(np.asarray(position, dtype=np.float64))}
        slabs |= {name: self._orders[on].to_slab(rows) for name, (on, rows) in fields.items()}
        described = tuple(
            StoredField(name, on, (self._orders[on].n_global, *slabs[name].shape[1:]), slabs[name].dtype.name)
            for name, (on, _) in fields.items()
        )
        number = self._next
        file = self._file
        if file is None or file.fields != described or number >= file.first + len(file.offsets):
            file = self._file = self._preallocate(slabs, described)
        state = WrittenState(number, int(step), float(time), file.path.name, described)
        record = partial(file.record_written, state, check_sums(slabs.values(), self._comm))
        datasets = {f"{group_name(number)}/{key}": slab for key, slab in slabs.items()}
        offsets = file.offsets[number - file.first].tolist()
        new = NewFile(file.path, datasets, {}, lambda: self._announce(state), offsets, record)
        write_collective([new, *other_files], self._comm, self._background)
        self._next += 1
        return number

    def finish(self) -> None:
        """List all announced states in ``states.vtkhdf``; collective, when the background is idle.

        Raises
        ------
        OutputError
            On every rank, if ``states.vtkhdf`` cannot be written.
        """
        if self._vtkhdf:
            on_root(self._comm, lambda: self._write_vtkhdf(complete=True))

    def _preallocate(
        self, slabs: Mapping[str, NDArray[Any]], fields: tuple[StoredField, ...]
    ) -> _PreallocatedFile:
        """Create a file for the next states; collective."""
        first, names = self._next, list(slabs)
        rows = [self.vertices.n_global, *(field.shape[0] for field in fields)]
        widths = [slab.itemsize * int(np.prod(slab.shape[1:], dtype=int)) for slab in slabs.values()]
        size = sum(n * width for n, width in zip(rows, widths, strict=True))
        slots = max(1, min(max(first, MIN_STATES), MAX_STATES, MAX_BYTES // max(size, 1)))
        path = self.folder / f"states-{first:04d}.h5"
        table: dict[str, NDArray[Any]] = {
            f"{TABLE}/step": np.empty(0, np.int64),
            f"{TABLE}/time": np.empty(0, np.float64),
            f"{TABLE}/sums": np.empty((0, len(names)), np.uint64),
        }
        planned = {f"{group_name(first + i)}/{name}": slabs[name] for i in range(slots) for name in names}
        columns = json.dumps([["position", "vertex"], *([field.name, field.on] for field in fields)])
        attributes: dict[str, dict[str, int | float | str]] = {
            TABLE: {"first": first, "columns": columns},
            f"{TABLE}/time": {"units": self._time_unit},
            **_units(planned),
        }

        def work() -> list[int]:
            part = path.with_name(path.name + ".part")
            try:
                offsets = preallocate(part, table | planned, [slots] * len(table) + rows * slots, attributes)
                with open_output(part, "r+b", buffering=0) as file:
                    os.pwrite(file.fileno(), np.full(slots, -1, np.int64).tobytes(), offsets[0])
                    os.fsync(file.fileno())
                os.replace(part, path)
            except HDF5_ERRORS as error:
                part.unlink(missing_ok=True)
                raise cannot_write(path, error) from error
            return offsets

        offsets = np.array(on_root(self._comm, work), dtype=np.int64)
        return _PreallocatedFile(path, first, fields, offsets[:3], offsets[3:].reshape(slots, len(names)))

    def _announce(self, state: WrittenState) -> None:
        """List a state in states.xdmf and, unless too few are new, states.vtkhdf (rank 0)."""
        grid = self._series.grid(state)
        try:
            if state.number == 0:
                self._document.replace([grid])
            else:
                self._document.append(grid)
        except FileNotFoundError:  # removed or changed by somebody: write it again from the states' files
            if not self.folder.is_dir():
                raise cannot_write(self._document.path, FileNotFoundError()) from None
            self._document.replace(map(self._series.grid, stored_states(self.folder)))
        if self._vtkhdf:
            self._states.append(state)
            self._write_vtkhdf()

    def _write_vtkhdf(self, *, complete: bool = False) -> None:
        """Write ``states.vtkhdf`` if it must be ``complete`` or lacks more states than `MAX_LAG` allows.

        The file is always written as a whole, so it is written less often the more states there are.
        """
        new = len(self._states) - self._n_in_vtkhdf
        if new == 0 or not (complete or new >= MAX_LAG * self._n_in_vtkhdf):
            return
        write_vtkhdf(self.folder, self._states, self.vertices.n_global, self.n_triangles)
        self._n_in_vtkhdf = len(self._states)

    def _truncate(self, last_step: int) -> tuple[int, frozenset[str]]:
        """Announce the states up to ``last_step``, and only then remove the later ones.

        Returns the number of the next state, and the tensor fields that have three components.
        """
        found = stored_states(self.folder)
        keep = [state for state in found if state.step <= last_step]
        self._document.replace(map(self._series.grid, keep))
        if self._vtkhdf:
            self._states = keep
            self._write_vtkhdf(complete=True)
        stale = [] if self._vtkhdf else [self.folder / VTKHDF_FILE, self.folder / CELLS_FILE]
        kept = {state.file for state in keep}
        try:
            for path in state_files(self.folder):
                if path.name not in kept:
                    path.unlink()
                else:
                    _discard_states_after(path, last_step)
            for path in stale:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: a later state cannot be removed: {reason(error)}") from error
        fields = [field for state in keep for field in state.fields]
        older = frozenset(field.name for field in fields if field.name in TENSORS and field.shape[1:] == (3,))
        return max((state.number for state in keep), default=-1) + 1, older


@dataclass(frozen=True)
class _PreallocatedFile:
    """A file with preallocated datasets for several states.

    Attributes
    ----------
    path : Path
    first : int
        Number of the first state in the file.
    fields : tuple of StoredField
        Fields of each state.
    table : (3,) int64
        Offsets in the file of the table's columns [bytes].
    offsets : (slots, datasets) int64
        Offsets in the file of each state's datasets [bytes].
    """

    path: Path
    first: int
    fields: tuple[StoredField, ...]
    table: Ints
    offsets: Ints

    def record_written(self, state: WrittenState, sums: NDArray[np.uint64]) -> None:
        """Write a state's row of the table (rank 0)."""
        entries, index = (np.int64(state.step), np.float64(state.time), sums), state.number - self.first
        with writing(self.path), open_output(self.path, "r+b", buffering=0) as file:
            for offset, entry in zip(self.table.tolist(), entries, strict=True):
                os.pwrite(file.fileno(), entry.tobytes(), offset + index * entry.nbytes)


def _units(datasets: Iterable[str]) -> dict[str, dict[str, int | float | str]]:
    """Attributes of a file that give the units of datasets of states, by their paths."""
    names = {path: path.rpartition("/")[2] for path in datasets}
    return {path: {"units": UNITS[name]} for path, name in names.items() if name in UNITS}


def _discard_states_after(path: Path, last_step: int) -> None:
    """Mark the states after ``last_step`` in a file as not written."""
    with open_stored(path) as file:
        if TABLE not in file:
            return
        steps, offset = file[TABLE]["step"][()], file[TABLE]["step"].id.get_offset()
    steps[steps > last_step] = -1
    with open_output(path, "r+b", buffering=0) as raw:
        os.pwrite(raw.fileno(), steps.tobytes(), offset)


def state_files(folder: str | os.PathLike[str]) -> list[Path]:
    """The states files of a run's folder, ordered by number."""
    numbered = [(STATE_FILE.fullmatch(path.name), path) for path in Path(folder).iterdir()]
    return [path for _, path in sorted((int(match[1]), path) for match, path in numbered if match)]


def stored_states(folder: Path) -> list[WrittenState]:
    """The states in a run's folder, ordered by number; damaged files are skipped.

    Raises
    ------
    InputError
        For links out of the folder.
    """
    found: list[WrittenState] = []
    for path in state_files(folder):
        try:
            found += _states_of(path)
        except OutsideFolderError:
            raise
        except InputError:
            continue
    return sorted(found, key=lambda state: state.number)


def _states_of(path: Path) -> list[WrittenState]:
    """The states of a file; in older folders, a file holds one state.

    Raises
    ------
    InputError
        If the file is damaged.
    """
    with open_stored(path) as file:
        if TABLE not in file:
            (name,) = file["states"]
            group = file["states"][name]
            on = {key: text_attribute(data, "on") for key, data in group.items() if key != "position"}
            step, time = int(group.attrs["step"]), float(group.attrs["time"])
            return [WrittenState(int(name), step, time, path.name, _fields(group, on))]
        table = file[TABLE]
        first, on = int(table.attrs["first"]), dict(json.loads(text_attribute(table, "columns")))
        fields = _fields(file[group_name(first)], on)
        rows = zip(table["step"][()].tolist(), table["time"][()].tolist(), strict=True)
        return [
            WrittenState(first + i, step, time, path.name, fields)
            for i, (step, time) in enumerate(rows)
            if step >= 0
        ]


def _fields(group: Any, on: Mapping[str, str]) -> tuple[StoredField, ...]:
    return tuple(
        StoredField(name, kind, group[name].shape, group[name].dtype.name)
        for name, kind in on.items()
        if name != "position"
    )


FAILURE_DATA, FAILURE_XDMF, FAILURE_TEXT = "failure.h5", "failure.xdmf", "failure.txt"


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
    write_collective([NewFile(folder / FAILURE_DATA, datasets, attributes)], vertices.comm)
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
