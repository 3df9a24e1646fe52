"""Reading a run's folder in one process, during the run or afterwards."""

from __future__ import annotations

import csv
import importlib.util
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, overload

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, suggest
from lyra_petsc.extras import require_packages
from lyra_petsc.output.file_operations import possible_path, reason
from lyra_petsc.output.history import HISTORY_COLUMNS
from lyra_petsc.output.layout import (
    ATTACHMENTS,
    HISTORY,
    LOCK_FILE,
    MESH_FILE,
    OBSTACLES,
    PROBES,
    REACTIONS,
    SCENE_FILE,
    SEAMS,
    SUMMARY_FILE,
    VOLUMES,
)
from lyra_petsc.output.run_folder import is_locked
from lyra_petsc.output.stored import StoredMesh, check_file, check_folder, read_stored, states_in
from lyra_petsc.output.summary import read_summary
from lyra_petsc.output.tensors import COMPONENTS, is_tensor
from lyra_petsc.output.xdmf import WrittenState, group_name
from lyra_petsc.terms import energies

if TYPE_CHECKING:
    from lyra_petsc.scene.schema import Scene

Columns: TypeAlias = dict[str, NDArray[Any]]

ENERGIES = ("kinetic_energy", *energies.ENERGIES)
ITERATIONS = ("newton_iterations", "linear_iterations", "rejected")
INTEGER_COLUMNS = frozenset({"step", *ITERATIONS})
TEXT_COLUMNS = frozenset({"obstacle", "name"})


class StoredRun:
    """The results of one run. Data are read when they are first used, and no file stays open.

    Parameters
    ----------
    folder : path
        The run's folder, such as ``runs/flag``.

    Attributes
    ----------
    folder : Path
    times : (n_states,) float64
        Times of the states [s]; load factors in a static analysis.
    fields : tuple of str
        Names of the states' fields besides the positions.

    Raises
    ------
    InputError
        If the folder is not one of a run, or no state is written yet.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = possible_path(folder)
        self._mesh_file = _identity(self.folder / MESH_FILE)
        self._load()

    def _load(self) -> None:
        self._states = stored_states(self.folder)
        self.times: Array = np.array([state.time for state in self._states])
        # a run that was resumed with other fields has them in some states only
        of_states = [{field.name: field for field in state.fields} for state in self._states]
        self._fields = {
            n: field for n, field in of_states[0].items() if all(n in state for state in of_states)
        }
        self.fields = tuple(self._fields)

    def refresh(self) -> bool:
        """Read the states again that a running simulation may have added.

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
        before, mesh = self._states, self._mesh_file
        self._mesh_file = _identity(self.folder / MESH_FILE)
        if self._mesh_file != mesh:  # replaced by another run
            self.__dict__.pop("mesh", None)
        self._load()
        return self._mesh_file != mesh or self._states != before

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
        """The content of ``mesh.h5``."""
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
        """(V, 2) texture coordinates (``vt``) [m]; None without them or with texture seams."""
        return self.mesh.uv if self.mesh.textured else None

    @property
    def corner_uv(self) -> Array | None:
        """(F, 3, 2) texture coordinates (``vt``) [m] of the triangles' corners; None without ``vt``."""
        return self.mesh.corner_uv if self.mesh.textured else None

    # -- states --------------------------------------------------------------------------------------

    @property
    def positions(self) -> StateArrays:
        """(V, 3) [m] for each state."""
        return self._arrays("position", (len(self.rest), 3))

    @property
    def velocities(self) -> StateArrays:
        """(V, 3) [m/s] for each state, if the scene's ``output.fields`` names ``velocity``."""
        return self.field("velocity")

    def field(self, name: str) -> StateArrays:
        """A field of the states by its name; (V,), (V, 3), (F,) or (F, 6) for each state.

        ``stress`` and ``green_strain`` are (F, 6), uu, uv, uw, vv, vw, ww in material axes (u along the warp,
        w normal to the sheet).

        Raises
        ------
        InputError
            If the states do not hold the field.
        """
        if name not in self.fields:
            hint = suggest(name, self.fields) if self.fields else "the states hold positions alone"
            raise InputError(
                f"no field {name!r}, {hint}; a scene's output.fields names them", file=self.folder
            )
        rows = self.rest if self._fields[name].on == "vertex" else self.triangles
        return self._arrays(name, (len(rows), *self._fields[name].shape[1:]))

    def _arrays(self, name: str, shape: tuple[int, ...]) -> StateArrays:
        datasets = [(state.file, f"{group_name(state.number)}/{name}") for state in self._states]
        return StateArrays(self.folder, name, datasets, shape)

    def field_units(self, name: str) -> str:
        """Unit of a field, as in ``N/m``; ``1`` for dimensionless fields."""
        from lyra_petsc.scene.schema import FIELD_UNITS

        if name not in {"position", *FIELD_UNITS}:
            raise InputError(f"is damaged: no run writes a field {name!r}", file=self.folder)
        return "m" if name == "position" else FIELD_UNITS[name]

    def field_on(self, name: str) -> str:
        """``vertex`` or ``triangle``: what the rows of a field belong to, in the order of the mesh file."""
        return self._fields[name].on

    def at(self, time: float) -> int:
        """Index of the state nearest to a time [s]."""
        return int(np.abs(self.times - time).argmin())

    def dataset(self, every: int = 1) -> Any:
        """The states as an ``xarray.Dataset``, in memory; the extra ``export`` brings xarray.

        Parameters
        ----------
        every : int
            Take every n-th state.
        """
        require_packages("dataset", ("xarray",), "export")
        import xarray

        def variable(name: str, last: tuple[str, ...], arrays: StateArrays) -> tuple[Any, ...]:
            on = "vertex" if name == "position" else self.field_on(name)
            return ("state", on, *last), np.asarray(arrays[::every]), {"units": self.field_units(name)}

        content = {"position": variable("position", ("axis",), self.positions)}
        for name in self.fields:
            shape = self._fields[name].shape
            last = ("component",) if is_tensor(shape) else ("axis",) if len(shape) == 2 else ()
            content[name] = variable(name, last, self.field(name))
        content["rest"] = (("vertex", "axis"), self.rest, {"units": "m"})
        content["triangles"] = (("triangle", "corner"), self.triangles, {})
        axes = {"axis": list("xyz")}
        if any(is_tensor(field.shape) for field in self._fields.values()):
            axes["component"] = list(COMPONENTS)
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
        return as_frame(self._table(REACTIONS))

    @property
    def probes(self) -> Any:
        """probes.csv [m]; empty if the scene has no probes."""
        return as_frame(self._table(PROBES))

    @property
    def obstacles(self) -> Any:
        """obstacles.csv, a row for each obstacle and step [N], [N·m]; empty if the scene has no obstacles."""
        return as_frame(self._table(OBSTACLES))

    @property
    def volumes(self) -> Any:
        """volumes.csv, a row for each closed volume and step [m³], [Pa]; empty if the scene has none."""
        return as_frame(self._table(VOLUMES))

    @property
    def attachments(self) -> Any:
        """attachments.csv, a row for each attachment and step [N], [m]; empty if the scene has none."""
        return as_frame(self._table(ATTACHMENTS))

    @property
    def seams(self) -> Any:
        """seams.csv, a row for each seam that is not joined and step [m], [N]; empty if there is none."""
        return as_frame(self._table(SEAMS))

    @cached_property
    def _history(self) -> Columns:
        return read_history(self.folder)

    def _table(self, name: str) -> Columns:
        path = self.folder / name
        return read_table(path) if path.exists() else {}

    # -- the run itself ------------------------------------------------------------------------------

    @cached_property
    def scene(self) -> Scene:
        """The scene from scene.yaml; its mesh files are not needed."""
        from lyra_petsc.scene.load import load_scene

        return load_scene(self.folder / SCENE_FILE, meshes_needed=False)

    @cached_property
    def summary(self) -> dict[str, Any]:
        """summary.json; empty if the file is missing."""
        return read_summary(self.folder / SUMMARY_FILE)

    @property
    def outcome(self) -> str:
        """``done``, ``running``, ``killed``, ``unknown``, or the message with which the run stopped."""
        outcome = str(self.summary.get("outcome", "unknown"))
        return "killed" if outcome == "running" and not is_locked(self.folder) else outcome

    @property
    def finished(self) -> bool:
        """Whether the run was completed."""
        return self.outcome == "done"


def _identity(path: Path) -> tuple[int, int] | None:
    """Inode and time stamp of a file, which change when the file is replaced."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


def stored_states(folder: Path) -> list[WrittenState]:
    """The states of a run, ordered by number.

    Raises
    ------
    InputError
        If the folder is not one of a run, no state is written yet, or a states file is damaged.
    """
    check_folder(folder)
    if not folder.exists():
        raise InputError("no such folder; give the folder of a run, as in runs/flag", file=folder)
    if not folder.is_dir():
        raise InputError("is a file; give the folder of a run, as in runs/flag", file=folder)
    try:
        states = states_in(folder)
        begun = bool(states) or any((folder / name).exists() for name in (MESH_FILE, LOCK_FILE))
    except OSError as error:
        raise InputError(f"cannot be read: {reason(error)}", file=folder) from None
    if not begun:
        raise InputError(f"is not the folder of a run (no {MESH_FILE})", file=folder)
    if not states:
        raise InputError("no state is written yet", file=folder)
    return states


class StateArrays(Sequence[NDArray[Any]]):
    """One array of every state: ``[i]`` reads the array of state i, ``[i:j]`` selects states without reading.

    ``numpy.asarray`` reads all states, stacked along a first axis.

    Parameters
    ----------
    folder : Path
        The run's folder.
    name : str
    datasets : sequence of (str, str)
        File and dataset of each state.
    shape : tuple of int
        Shape of the array of one state.
    """

    def __init__(
        self, folder: Path, name: str, datasets: Sequence[tuple[str, str]], shape: tuple[int, ...]
    ) -> None:
        self._folder, self._name, self._datasets, self._shape = folder, name, datasets, shape

    def __len__(self) -> int:
        return len(self._datasets)

    @overload
    def __getitem__(self, index: int) -> NDArray[Any]: ...

    @overload
    def __getitem__(self, index: slice) -> StateArrays: ...

    def __getitem__(self, index: int | slice) -> NDArray[Any] | StateArrays:
        """Read the array of a state, or select states by a slice.

        Raises
        ------
        IndexError
            If the state does not exist.
        InputError
            If its file is missing or damaged.
        """
        if isinstance(index, slice):
            return StateArrays(self._folder, self._name, self._datasets[index], self._shape)
        file, dataset = self._datasets[index]
        return read_stored(self._folder / file, dataset, self._shape)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        if not self._datasets:
            raise ValueError(f"no states of {self._name} to stack")
        return np.stack([np.asarray(array, dtype=dtype) for array in self])

    def __repr__(self) -> str:
        return f"<{self._name} of {len(self)} states in {self._folder}>"


def read_history(folder: Path) -> Columns:
    """The columns of history.csv; raises as `read_table`."""
    return read_table(folder / HISTORY, HISTORY_COLUMNS)


def read_table(path: Path, needed: Sequence[str] = ("step", "time")) -> Columns:
    """The columns of a table, without a last row that is still incomplete.

    Parameters
    ----------
    path : Path
    needed : sequence of str
        Required columns.

    Raises
    ------
    InputError
        If the file is missing, damaged or without rows.
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
        if missing := [name for name in needed if name not in header]:
            raise ValueError(f"no column {missing[0]}")
        columns: Columns = {}
        for i, name in enumerate(header):
            column = np.array([row[i] for row in rows], dtype=None if name in TEXT_COLUMNS else "U64")
            number = np.int64 if name in INTEGER_COLUMNS else np.float64
            columns[name] = column if name in TEXT_COLUMNS else column.astype(number)
    except (ValueError, OverflowError, csv.Error) as error:
        raise InputError(f"is damaged: {reason(error)}", file=path) from None
    if not rows:
        raise InputError("holds no row yet, or is damaged: only its header is there", file=path)
    bad = [name for name, values in columns.items() if name in needed and not np.isfinite(values).all()]
    if bad:
        raise InputError(f"is damaged: {bad[0]} holds numbers that are not finite", file=path)
    return columns


def as_frame(columns: Columns) -> Any:
    """A pandas frame if pandas is installed, else the columns unchanged."""
    if importlib.util.find_spec("pandas") is None:
        return columns
    import pandas

    return pandas.DataFrame(columns)
