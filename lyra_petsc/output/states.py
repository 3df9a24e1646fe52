"""states-NNNN.h5, files with room for states from number NNNN on, and the XDMF file that announces them.

A file is laid out with the places of all its states. To write one is to write its rows there, and then its
row in the file's table; nothing of HDF5 changes, so that the file can be read at any moment. The next file
has room for as many states as there are, within bounds: so there are few files, and little room is left over.

failure.xdmf, failure.h5 and failure.txt hold the states before and in a step that failed, and why.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output.agreement import HDF5_ERRORS, cannot_write, reason, replace_text, writing
from lyra_petsc.output.hdf5 import Attributes, Background, NewFile, lay_out, write_collective
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.stored import TABLE, OutsideFolderError, check_sums, open_stored, text_of
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

FEWEST, MOST = 4, 512
"""States that a file has room for,"""

LARGEST = 1 << 26
"""and their bytes, unless one alone has more."""

MORE = 0.1
"""States that ``states.vtkhdf`` may lack while a run goes on, over those it has."""

STATE_FILE = re.compile(r"states-(\d{4,})\.h5")

Fields = Mapping[str, tuple[str, NDArray[Any]]]
"""By their names: what their rows belong to (``vertex`` or ``triangle``), and this rank's rows."""


class StateWriter:
    """Writes states in the mesh's order; a state is announced only when its file is complete.

    Parameters
    ----------
    folder : path
        The run's folder; holds ``mesh.h5``.
    vertices : FileOrder
        Order of the vertices each rank owns.
    triangles : FileOrder, optional
        Order of the triangles each rank owns; needed for fields on triangles.
    n_triangles : int
        Triangles of the whole mesh.
    resume_after : int, optional
        Keep the states up to and including this step, remove later ones and go on with the
        next number. Otherwise the first state is number 0.
    vtkhdf : bool
        Announce the states in ``states.vtkhdf``, too.

    Attributes
    ----------
    in_plane : frozenset of str
        Tensors that the states before hold by three components, as older versions wrote them; they go on so.

    Raises
    ------
    OutputError
        On every rank, if the folder's states cannot be tidied up.
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
        background: Background | None = None,
    ) -> None:
        self.folder = Path(folder)
        self.vertices = vertices
        self._orders = {"vertex": vertices} | ({} if triangles is None else {"triangle": triangles})
        self.n_triangles = n_triangles
        self._room: _PreallocatedFile | None = None
        self._document = GrowingXdmf(self.folder / XDMF_FILE)  # of rank 0
        self._states: list[WrittenState] = []  # of rank 0, for states.vtkhdf
        self._in_vtk = 0
        self._series = TimeSeries(vertices.n_global, n_triangles)
        self._next = 0
        self._vtkhdf, self._background = vtkhdf, background
        if vtkhdf:
            on_root(self._comm, lambda: write_cells(self.folder))
        self.in_plane: frozenset[str] = frozenset()
        if resume_after is not None:
            found = on_root(self._comm, lambda: self._truncate(resume_after))
            self._next, self.in_plane = found

    @property
    def _comm(self) -> MPI.Comm:
        return self.vertices.comm

    def write(
        self,
        step: int,
        time: float,
        position: Array,
        fields: Fields,
        beside: Sequence[NewFile] = (),
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
            Further fields on ``vertex`` or ``triangle``, on this rank's: floats or integers, the same names,
            types and trailing shapes on every rank.
        beside : sequence of NewFile
            Files that are there, too, when the state is announced.

        Raises
        ------
        OutputError
            On every rank; the states announced before stand. With a background, of the state before.
        """
        slabs = {"position": self.vertices.to_slab(np.asarray(position, dtype=np.float64))}
        slabs |= {name: self._orders[on].to_slab(rows) for name, (on, rows) in fields.items()}
        described = tuple(
            StoredField(name, on, (self._orders[on].n_global, *slabs[name].shape[1:]), slabs[name].dtype.name)
            for name, (on, _) in fields.items()
        )
        number = self._next
        room = self._room
        if room is None or room.fields != described or number >= room.first + len(room.places):
            room = self._room = self._lay_out(slabs, described)
        state = WrittenState(number, int(step), float(time), room.path.name, described)
        written = partial(room.say_written, state, check_sums(slabs.values(), self._comm))
        datasets = {f"{group_name(number)}/{key}": slab for key, slab in slabs.items()}
        places = room.places[number - room.first].tolist()
        file = NewFile(room.path, datasets, {}, lambda: self._announce(state), places, written)
        write_collective([file, *beside], self._comm, self._background)
        self._next += 1
        return number

    def finish(self) -> None:
        """Announce also in ``states.vtkhdf`` what is announced already; collective, with nothing under way.

        Raises
        ------
        OutputError
            On every rank, if it could not be written.
        """
        if self._vtkhdf:
            on_root(self._comm, lambda: self._announce_to_vtk(late=True))

    def _lay_out(
        self, slabs: Mapping[str, NDArray[Any]], fields: tuple[StoredField, ...]
    ) -> _PreallocatedFile:
        """A file with room for the next states; collective."""
        first, names = self._next, list(slabs)
        rows = [self.vertices.n_global, *(field.shape[0] for field in fields)]
        widths = [slab.itemsize * int(np.prod(slab.shape[1:], dtype=int)) for slab in slabs.values()]
        size = sum(n * width for n, width in zip(rows, widths, strict=True))
        slots = max(1, min(max(first, FEWEST), MOST, LARGEST // max(size, 1)))
        path = self.folder / f"states-{first:04d}.h5"
        table: dict[str, NDArray[Any]] = {
            f"{TABLE}/step": np.empty(0, np.int64),
            f"{TABLE}/time": np.empty(0, np.float64),
            f"{TABLE}/sums": np.empty((0, len(names)), np.uint64),
        }
        planned = {f"{group_name(first + i)}/{name}": slabs[name] for i in range(slots) for name in names}
        told = json.dumps([["position", "vertex"], *([field.name, field.on] for field in fields)])
        attributes: Attributes = {TABLE: {"first": first, "columns": told}}

        def work() -> list[int]:
            part = path.with_name(path.name + ".part")
            try:
                places = lay_out(part, table | planned, [slots] * len(table) + rows * slots, attributes)
                with open(part, "r+b", buffering=0) as file:
                    os.pwrite(file.fileno(), np.full(slots, -1, np.int64).tobytes(), places[0])
                    os.fsync(file.fileno())
                os.replace(part, path)
            except HDF5_ERRORS as error:
                part.unlink(missing_ok=True)
                raise cannot_write(path, error) from error
            return places

        places = np.array(on_root(self._comm, work), dtype=np.int64)
        return _PreallocatedFile(path, first, fields, places[:3], places[3:].reshape(slots, len(names)))

    def _announce(self, state: WrittenState) -> None:
        """Announce a state (rank 0)."""
        grid = self._series.grid(state)
        try:
            if state.number == 0:
                self._document.replace([grid])
            else:
                self._document.append(grid)
        except FileNotFoundError:  # removed or changed: made anew from the files of the states
            if not self.folder.is_dir():
                raise cannot_write(self._document.path, FileNotFoundError()) from None
            self._document.replace(map(self._series.grid, stored_states(self.folder)))
        if self._vtkhdf:
            self._states.append(state)
            self._announce_to_vtk()

    def _announce_to_vtk(self, *, late: bool = False) -> None:
        """Write ``states.vtkhdf``, which is written as a whole: the more states the less often."""
        new = len(self._states) - self._in_vtk
        if new == 0 or not (late or new >= MORE * self._in_vtk):
            return
        write_vtkhdf(self.folder, self._states, self.vertices.n_global, self.n_triangles)
        self._in_vtk = len(self._states)

    def _truncate(self, last_step: int) -> tuple[int, frozenset[str]]:
        """Announce the states up to ``last_step``, only then remove the others.

        Returns the next number, and which tensors have three components.
        """
        found = stored_states(self.folder)
        keep = [state for state in found if state.step <= last_step]
        self._document.replace(map(self._series.grid, keep))
        if self._vtkhdf:
            self._states = keep
            self._announce_to_vtk(late=True)
        stale = [] if self._vtkhdf else [self.folder / VTKHDF_FILE, self.folder / CELLS_FILE]
        kept = {state.file for state in keep}
        try:
            for path in state_files(self.folder):
                if path.name not in kept:
                    path.unlink()
                else:
                    _forget(path, last_step)
            for path in stale:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: a later state cannot be removed: {reason(error)}") from error
        fields = [field for state in keep for field in state.fields]
        older = frozenset(field.name for field in fields if field.name in TENSORS and field.shape[1:] == (3,))
        return max((state.number for state in keep), default=-1) + 1, older


@dataclass(frozen=True)
class _PreallocatedFile:
    """A file with room for states: its first state, what each holds, and where [bytes] these stand.

    ``table`` has the places of the table's columns, ``places`` (slots, datasets) those of each state.
    """

    path: Path
    first: int
    fields: tuple[StoredField, ...]
    table: Ints
    places: Ints

    def say_written(self, state: WrittenState, sums: NDArray[np.uint64]) -> None:
        """Write a state's row of the table (rank 0)."""
        entries, index = (np.int64(state.step), np.float64(state.time), sums), state.number - self.first
        with writing(self.path), open(self.path, "r+b", buffering=0) as file:
            for place, entry in zip(self.table.tolist(), entries, strict=True):
                os.pwrite(file.fileno(), entry.tobytes(), place + index * entry.nbytes)


def _forget(path: Path, last_step: int) -> None:
    """Mark in a file that it holds no states after ``last_step``."""
    with open_stored(path) as file:
        if TABLE not in file:
            return
        steps, place = file[TABLE]["step"][()], file[TABLE]["step"].id.get_offset()
    steps[steps > last_step] = -1
    with open(path, "r+b", buffering=0) as raw:
        os.pwrite(raw.fileno(), steps.tobytes(), place)


def state_files(folder: str | os.PathLike[str]) -> list[Path]:
    """The files of states of a run's folder, by number."""
    numbered = [(STATE_FILE.fullmatch(path.name), path) for path in Path(folder).iterdir()]
    return [path for _, path in sorted((int(match[1]), path) for match, path in numbered if match)]


def stored_states(folder: Path) -> list[WrittenState]:
    """The states in a run's folder, by number; damaged files are passed over.

    Raises
    ------
    InputError
        For files that lead out of the folder.
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
    """The states of a file, which in older folders is one.

    Raises
    ------
    InputError
        If it is damaged.
    """
    with open_stored(path) as file:
        if TABLE not in file:
            (name,) = file["states"]
            group = file["states"][name]
            on = {key: text_of(data, "on") for key, data in group.items() if key != "position"}
            step, time = int(group.attrs["step"]), float(group.attrs["time"])
            return [WrittenState(int(name), step, time, path.name, _fields(group, on))]
        table = file[TABLE]
        first, on = int(table.attrs["first"]), dict(json.loads(text_of(table, "columns")))
        fields = _fields(file[group_name(first)], on)
        rows = zip(table["step"][()].tolist(), table["time"][()].tolist(), strict=True)
        return [
            WrittenState(first + i, step, time, path.name, fields)
            for i, (step, time) in enumerate(rows)
            if step >= 0
        ]


def _fields(group: Any, on: Mapping[str, str]) -> tuple[StoredField, ...]:
    return tuple(
        StoredField(name, place, group[name].shape, group[name].dtype.name)
        for name, place in on.items()
        if name != "position"
    )


FAILURE_DATA, FAILURE_XDMF, FAILURE_TEXT = "failure.h5", "failure.xdmf", "failure.txt"


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
    write_collective([NewFile(folder / FAILURE_DATA, datasets, attributes)], vertices.comm)
    document = TimeSeries(vertices.n_global, n_triangles).text(written)
    on_root(vertices.comm, lambda: replace_text(folder / FAILURE_XDMF, document))


def remove_failure(folder: str | os.PathLike[str]) -> None:
    """Remove what an earlier run wrote here. Call on one rank.

    Raises
    ------
    OutputError
        If it cannot be removed.
    """
    try:
        for name in (FAILURE_XDMF, FAILURE_DATA, FAILURE_TEXT):
            (Path(folder) / name).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: {name} cannot be removed: {reason(error)}") from error
