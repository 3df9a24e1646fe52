"""A run's folder, read by one process while the run goes on or afterwards."""

from __future__ import annotations

import csv
import importlib.util
import math
import time as wall
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, overload
from xml.etree.ElementTree import Element, ParseError, parse

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, suggest
from lyra_petsc.extras import require_packages
from lyra_petsc.output.agreement import reason
from lyra_petsc.output.history import HISTORY_COLUMNS
from lyra_petsc.output.stored import StoredMesh, check_file, check_folder, check_name, read_stored
from lyra_petsc.output.summary import read_summary
from lyra_petsc.output.tensors import COMPONENTS, TENSORS
from lyra_petsc.output.xdmf import MESH_FILE, XDMF_FILE

if TYPE_CHECKING:
    from lyra_petsc.scene.schema import Scene

Columns: TypeAlias = dict[str, NDArray[Any]]

Place: TypeAlias = tuple[str, str]
"""File, relative to the run's folder, and name of a dataset in it."""


ENERGIES = ("kinetic_energy", "membrane_energy", "bending_energy", "potential_energy")
ITERATIONS = ("newton_iterations", "linear_iterations", "rejected")
COUNTS = frozenset({"step", "newton_iterations", "linear_iterations", "rejected"})
NAMES = frozenset({"obstacle"})
"""Columns of whole numbers."""

RECENT = 0.05
"""Seconds; clocks of file systems are coarser than those of processors."""

COLUMNS: dict[str, tuple[int, ...]] = {"velocity": (3,), "displacement": (3,)}
"""Shape of a row of the fields that are vectors."""


class StoredRun:
    """The results of one run. Nothing is read before it is asked for, no file stays open.

    Parameters
    ----------
    folder : path
        As in ``runs/flag``.

    Attributes
    ----------
    folder : Path
    times : (n_states,) float64
        When the states were written [s]; load factors in a static analysis.
    fields : tuple of str
        What the states hold besides the positions.

    Raises
    ------
    InputError
        If it is not the folder of a run, or no state is written yet.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._look()

    def _look(self) -> None:
        self._stamp = _stamp(self.folder / XDMF_FILE), _stamp(self.folder / MESH_FILE)
        # else it may change again at the same time of the file system's clock
        written = self._stamp[0][0] * 1e-9 if self._stamp[0] else 0.0
        self._settled = abs(wall.time() - written) > RECENT
        self._states: list[AnnouncedState] = announced_states(self.folder)
        self.times: Array = np.array([state.time for state in self._states])
        first = self._states[0].fields
        # a run that was resumed with other fields has them in some states only
        self.fields = tuple(name for name in first if all(name in state.fields for state in self._states))

    def refresh(self) -> bool:
        """See what a run that goes on has written meanwhile.

        Returns
        -------
        bool
            Whether there are other states than before.

        Raises
        ------
        InputError
            If the results are gone.
        """
        for name in ("_history", "summary", "scene"):
            self.__dict__.pop(name, None)
        states, mesh = _stamp(self.folder / XDMF_FILE), _stamp(self.folder / MESH_FILE)
        if mesh != self._stamp[1]:  # replaced by another run
            self.__dict__.pop("mesh", None)
        if (states, mesh) == self._stamp and self._settled:
            return False
        before, same = self._states, mesh == self._stamp[1]
        self._look()
        return not same or self._states != before

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.absolute().name

    def __len__(self) -> int:
        return len(self._states)

    def __repr__(self) -> str:
        return f"<run {self.folder}: {len(self)} states, t = {self.times[0]:g} to {self.times[-1]:g} s>"

    # -- mesh ----------------------------------------------------------------------------------------

    @cached_property
    def mesh(self) -> StoredMesh:
        """What ``mesh.h5`` holds."""
        return StoredMesh(self.folder)

    @property
    def triangles(self) -> Ints:
        """(F, 3) vertices of each triangle, both in the order of the mesh file."""
        return self.mesh.triangles

    @property
    def rest(self) -> Array:
        """(V, 3) rest shape [m]."""
        return self.mesh.rest

    @property
    def uv(self) -> Array | None:
        """(V, 2) texture coordinates (``vt``) [m]; None if the mesh has none, or has seams."""
        return self.mesh.uv if self.mesh.textured else None

    @property
    def corner_uv(self) -> Array | None:
        """(F, 3, 2) texture coordinates (``vt``) [m] of the triangles' corners; None without ``vt``."""
        return self.mesh.corner_uv if self.mesh.textured else None

    # -- states --------------------------------------------------------------------------------------

    @property
    def positions(self) -> StateArrays:
        """(V, 3) [m] for each state."""
        places = [state.position for state in self._states]
        return StateArrays(self.folder, "positions", places, (len(self.rest), 3))

    @property
    def velocities(self) -> StateArrays:
        """(V, 3) [m/s] for each state, if the scene's ``output.fields`` names ``velocity``."""
        return self.field("velocity")

    def field(self, name: str) -> StateArrays:
        """What the states hold under a name: (V,), (V, 3), (F,) or (F, 6) for each.

        ``stress`` and ``green_strain`` are (F, 6), uu, uv, uw, vv, vw, ww in material axes (u along the warp,
        w normal to the sheet); in older folders (F, 3), uu, vv, uv.

        Raises
        ------
        InputError
            If they do not hold it.
        """
        if name not in self.fields:
            what = suggest(name, self.fields) if self.fields else "the states hold positions alone"
            raise InputError(
                f"no field {name!r}, {what}; a scene's output.fields names them", file=self.folder
            )
        first = self._states[0].fields[name]
        places = [state.fields[name].place for state in self._states]
        rows = self.rest if first.on == "vertex" else self.triangles
        return StateArrays(self.folder, name, places, (len(rows), *first.columns))

    def field_units(self, name: str) -> str:
        """Unit of a field, as in ``N/m``; ``1`` for plain numbers."""
        from lyra_petsc.scene.schema import FIELD_UNITS

        if name not in {"position", *FIELD_UNITS}:
            raise InputError(f"is damaged: no run writes a field {name!r}", file=self.folder / XDMF_FILE)
        return "m" if name == "position" else FIELD_UNITS[name]

    def field_on(self, name: str) -> str:
        """``vertex`` or ``triangle``: what the rows of a field belong to, in the order of the mesh file."""
        return self._states[0].fields[name].on

    def at(self, time: float) -> int:
        """Number of the state nearest to a time [s]."""
        return int(np.abs(self.times - time).argmin())

    def dataset(self, every: int = 1) -> Any:
        """The states as an ``xarray.Dataset``, in memory; the extra ``export`` brings xarray.

        Parameters
        ----------
        every : int
            Take every so manieth state.
        """
        require_packages("dataset", ("xarray",), "export")
        import xarray

        def variable(name: str, last: tuple[str, ...], arrays: StateArrays) -> tuple[Any, ...]:
            on = "vertex" if name == "position" else self.field_on(name)
            return ("state", on, *last), np.asarray(arrays[::every]), {"units": self.field_units(name)}

        content = {"position": variable("position", ("axis",), self.positions)}
        for name in self.fields:
            last = "axis" if name in COLUMNS else "component" if name in TENSORS else ""
            content[name] = variable(name, (last,) if last else (), self.field(name))
        content["rest"] = (("vertex", "axis"), self.rest, {"units": "m"})
        content["triangles"] = (("triangle", "corner"), self.triangles, {})
        axes = {"axis": list("xyz")}
        if tensors := [content[name][1] for name in self.fields if name in TENSORS]:
            axes["component"] = list(COMPONENTS[tensors[0].shape[-1]])
        time = ("state", self.times[::every], {"units": "s"})
        whole = xarray.Dataset(content, {"time": time, **axes}, {"title": self.scene.title})
        return whole.swap_dims(state="time")

    # -- tables --------------------------------------------------------------------------------------

    @property
    def history(self) -> Any:
        """history.csv, a row for each accepted step: a pandas frame, or columns where pandas is missing."""
        return as_frame(self._history)

    @property
    def energies(self) -> Any:
        """``time`` and the energies [J] of the history."""
        return as_frame({name: self._history[name] for name in ("time", *ENERGIES)})

    @property
    def iterations(self) -> Any:
        """``step``, ``time`` and the iterations of the history."""
        return as_frame({name: self._history[name] for name in ("step", "time", *ITERATIONS)})

    @property
    def reactions(self) -> Any:
        """reactions.csv [N]; empty if the scene does not ask for it."""
        return as_frame(self._table("reactions.csv"))

    @property
    def probes(self) -> Any:
        """probes.csv [m]; empty if the scene has none."""
        return as_frame(self._table("probes.csv"))

    @property
    def obstacles(self) -> Any:
        """obstacles.csv, a row for each obstacle and step [N], [N·m]; empty if the scene has none."""
        return as_frame(self._table("obstacles.csv"))

    @cached_property
    def _history(self) -> Columns:
        return read_history(self.folder)

    def _table(self, name: str) -> Columns:
        path = self.folder / name
        return read_table(path) if path.exists() else {}

    # -- the run itself ------------------------------------------------------------------------------

    @cached_property
    def scene(self) -> Scene:
        """The scene as understood; its mesh files need not be there any more."""
        from lyra_petsc.scene.load import load_scene

        return load_scene(self.folder / "scene.yaml", meshes_needed=False)

    @cached_property
    def summary(self) -> dict[str, Any]:
        """summary.json; empty if there is none."""
        return read_summary(self.folder / "summary.json")

    @property
    def finished(self) -> bool:
        """Whether the run came to its end."""
        return bool(self.summary.get("outcome") == "done")


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """A mark that changes when a file is replaced or changed."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


@dataclass(frozen=True)
class AnnouncedField:
    """Where an array of a state is, what its rows belong to (``vertex``, ``triangle``), and their shape."""

    place: Place
    on: str
    columns: tuple[int, ...]


@dataclass(frozen=True)
class AnnouncedState:
    """A written state.

    Attributes
    ----------
    time : float
        [s], or the load factor of a static analysis.
    position : tuple of str
        Where the positions are.
    fields : mapping of str to AnnouncedField
        What else the state holds.
    """

    time: float
    position: Place
    fields: Mapping[str, AnnouncedField]


def announced_states(folder: Path) -> list[AnnouncedState]:
    """The states of a run in the order of time.

    Raises
    ------
    InputError
        If the folder is none of a run, nothing is written yet, or the announcement is damaged.
    """
    path = folder / XDMF_FILE
    check_folder(folder)
    try:
        root = parse(path).getroot()
        states = [_state(grid) for grid in root.iterfind("./Domain/Grid/Grid")]
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(_absent(folder), file=folder) from None
    except OSError as error:
        raise InputError(f"cannot be read: {reason(error)}", file=path) from None
    except (ParseError, ValueError, LookupError, AttributeError, RecursionError):
        raise InputError("is damaged, or was not written by a run", file=path) from None
    if not states:
        raise InputError("no state is written yet", file=folder)
    for state in states:
        for name, _ in (state.position, *(field.place for field in state.fields.values())):
            check_name(name, path)
    return states


def _absent(folder: Path) -> str:
    if not folder.exists():
        return "no such folder; give the folder of a run, as in runs/flag"
    if not folder.is_dir():
        return "is a file; give the folder of a run, as in runs/flag"
    if (folder / "run.lock").exists():
        return f"no state is written yet (no {XDMF_FILE})"
    return f"is not the folder of a run (no {XDMF_FILE})"


def _state(grid: Element) -> AnnouncedState:
    time, geometry = grid.find("Time"), grid.find("Geometry")
    if time is None or geometry is None:
        raise ValueError
    seconds = float(time.attrib["Value"])
    if not math.isfinite(seconds):
        raise ValueError
    attributes = {each.attrib["Name"]: each for each in grid.iterfind("Attribute")}
    fields = {name: _field(name, each) for name, each in attributes.items() if name != "rest"}
    return AnnouncedState(seconds, _place(geometry), fields)


def _field(name: str, element: Element) -> AnnouncedField:
    columns = COLUMNS.get(name, ())
    if name in TENSORS:
        item = element.find("DataItem")
        columns = (int(item.attrib["Dimensions"].split()[-1]) if item is not None else 0,)
        if columns[0] not in COMPONENTS:
            raise ValueError
    return AnnouncedField(
        _place(element), "triangle" if element.get("Center") == "Cell" else "vertex", columns
    )


def _place(element: Element) -> Place:
    file, colon, dataset = (element.findtext("DataItem") or "").strip().rpartition(":")
    if not colon:
        raise ValueError
    return file, dataset


class StateArrays(Sequence[NDArray[Any]]):
    """One array of every state: ``[i]`` reads the array of one, ``[i:j]`` selects states, unread.

    ``numpy.asarray`` of it reads them all, stacked along a first axis.

    Parameters
    ----------
    folder : Path
        The run's folder.
    name : str
    places : sequence of (str, str)
        File and dataset of each state.
    shape : tuple of int
        Of the array of one state.
    """

    def __init__(self, folder: Path, name: str, places: Sequence[Place], shape: tuple[int, ...]) -> None:
        self._folder, self._name, self._places, self._shape = folder, name, places, shape

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, index: int) -> NDArray[Any]: ...

    @overload
    def __getitem__(self, index: slice) -> StateArrays: ...

    def __getitem__(self, index: int | slice) -> NDArray[Any] | StateArrays:
        """Read the array of a state, or choose states.

        Raises
        ------
        IndexError
            If there is no such state.
        InputError
            If its file is gone or damaged.
        """
        if isinstance(index, slice):
            return StateArrays(self._folder, self._name, self._places[index], self._shape)
        file, dataset = self._places[index]
        return read_stored(self._folder / file, dataset, self._shape)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        if not self._places:
            raise ValueError(f"no states of {self._name} to stack")
        return np.stack([np.asarray(array, dtype=dtype) for array in self])

    def __repr__(self) -> str:
        return f"<{self._name} of {len(self)} states in {self._folder}>"


def read_history(folder: Path) -> Columns:
    """The columns of history.csv; raises as `read_table`."""
    return read_table(folder / "history.csv", HISTORY_COLUMNS)


def read_table(path: Path, needed: Sequence[str] = ("step", "time")) -> Columns:
    """The columns of a table, without a last row that is not whole yet.

    Parameters
    ----------
    path : Path
    needed : sequence of str
        Columns that it must have.

    Raises
    ------
    InputError
        If it is missing or damaged, or has no row.
    """
    check_file(path)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot be read: {reason(error)}", file=path) from None
    except UnicodeDecodeError:
        raise InputError("is damaged: it is no text", file=path) from None
    try:
        header, *rows = list(csv.reader(text[: text.rfind("\n") + 1].splitlines())) or [[]]
        if not header or any(len(row) != len(header) for row in rows):
            raise ValueError("rows of different lengths")
        if lacking := [name for name in needed if name not in header]:
            raise ValueError(f"no column {lacking[0]}")
        columns = {
            name: np.array([row[i] for row in rows])
            if name in NAMES
            else np.array([row[i] for row in rows], dtype="U64").astype(np.int64 if name in COUNTS else float)
            for i, name in enumerate(header)
        }
    except (ValueError, OverflowError, csv.Error) as error:
        raise InputError(f"is damaged: {reason(error)}", file=path) from None
    if not rows:
        raise InputError("holds no row yet, or is damaged: only its header is there", file=path)
    bad = [name for name, values in columns.items() if name in needed and not np.isfinite(values).all()]
    if bad:
        raise InputError(f"is damaged: {bad[0]} holds numbers that are not finite", file=path)
    return columns


def as_frame(columns: Columns) -> Any:
    """A pandas frame where pandas is installed, else the columns as they are."""
    if importlib.util.find_spec("pandas") is None:
        return columns
    import pandas

    return pandas.DataFrame(columns)
