"""A run's folder, read by one process while the run goes on or afterwards."""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.nearest import nearest
from lyra_petsc.output.agreement import HDF5_ERRORS, reason
from lyra_petsc.output.h5py_loader import import_h5py
from lyra_petsc.results.announced import MESH_FILE, XDMF_FILE, State, announced_states
from lyra_petsc.results.sequence import StateArrays, read_array
from lyra_petsc.results.tables import as_frame, read_table

if TYPE_CHECKING:
    from lyra_petsc.scene.schema import Scene

Array = NDArray[np.float64]

ENERGIES = ("kinetic_energy", "membrane_energy", "bending_energy", "potential_energy")
ITERATIONS = ("newton_iterations", "linear_iterations", "rejected")


class Run:
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
        self._states: list[State] = announced_states(self.folder)
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
        for name in ("_history", "_reactions", "_probes", "summary", "scene"):
            self.__dict__.pop(name, None)
        states, mesh = _stamp(self.folder / XDMF_FILE), _stamp(self.folder / MESH_FILE)
        if mesh != self._stamp[1]:  # replaced by another run
            for name in ("_mesh", "triangles", "rest"):
                self.__dict__.pop(name, None)
        if (states, mesh) == self._stamp:
            return False
        self._look()
        return True

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
    def _mesh(self) -> dict[str, NDArray[Any]]:
        """Texture coordinates, by the names they have in the file."""
        path = self.folder / MESH_FILE
        try:
            with import_h5py().File(path, "r") as file:
                mesh = file["mesh"]
                given = bool(mesh.attrs.get("vt", 0))
                return {name: mesh[name][()] for name in ("uv", "corner_uv") if given and name in mesh}
        except HDF5_ERRORS as error:
            raise InputError(f"cannot be read: {reason(error)}", file=path) from None

    @cached_property
    def triangles(self) -> NDArray[np.int64]:
        """(F, 3) vertices of each triangle, both in the order of the mesh file."""
        return read_array(self.folder, (MESH_FILE, "mesh/triangles"))

    @cached_property
    def rest(self) -> Array:
        """(V, 3) rest shape [m]."""
        return read_array(self.folder, (MESH_FILE, "mesh/rest"))

    @property
    def uv(self) -> Array | None:
        """(V, 2) texture coordinates (``vt``) [m]; None if the mesh has none, or has seams."""
        return self._mesh.get("uv")

    @property
    def corner_uv(self) -> Array | None:
        """(F, 3, 2) texture coordinates (``vt``) [m] of the triangles' corners; None without ``vt``."""
        uv = self.uv
        return self._mesh.get("corner_uv") if uv is None else uv[self.triangles]

    # -- states --------------------------------------------------------------------------------------

    @property
    def positions(self) -> StateArrays:
        """(V, 3) [m] for each state."""
        return StateArrays(self.folder, "positions", [state.position for state in self._states])

    @property
    def velocities(self) -> StateArrays:
        """(V, 3) [m/s] for each state, if the scene's ``output.fields`` names ``velocity``."""
        return self.field("velocity")

    def field(self, name: str) -> StateArrays:
        """What the states hold under a name: (V,), (V, 3), (F,) or (F, 3) for each.

        Raises
        ------
        InputError
            If they do not hold it.
        """
        if name not in self.fields:
            what = nearest(name, self.fields) if self.fields else "the states hold positions alone"
            raise InputError(
                f"no field {name!r}, {what}; a scene's output.fields names them", file=self.folder
            )
        return StateArrays(self.folder, name, [state.fields[name] for state in self._states])

    def field_units(self, name: str) -> str:
        """Unit of a field, as in ``N/m``; ``1`` for plain numbers."""
        from lyra_petsc.scene.control import FIELD_UNITS

        return "m" if name == "position" else FIELD_UNITS[name]

    def field_on(self, name: str) -> str:
        """``vertex`` or ``triangle``: what the rows of a field belong to, in the order of the mesh file."""
        return self._states[0].on[name]

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
        from lyra_petsc.results.dataset import dataset

        return dataset(self, range(0, len(self), every))

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
        return as_frame(self._reactions)

    @property
    def probes(self) -> Any:
        """probes.csv [m]; empty if the scene has none."""
        return as_frame(self._probes)

    @cached_property
    def _history(self) -> dict[str, NDArray[Any]]:
        return read_table(self.folder / "history.csv")

    @cached_property
    def _reactions(self) -> dict[str, NDArray[Any]]:
        path = self.folder / "reactions.csv"
        return read_table(path) if path.exists() else {}

    @cached_property
    def _probes(self) -> dict[str, NDArray[Any]]:
        path = self.folder / "probes.csv"
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
        try:
            content = json.loads((self.folder / "summary.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}

    @property
    def finished(self) -> bool:
        """Whether the run came to its end."""
        return bool(self.summary.get("outcome") == "done")


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """What changes when a file is replaced."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino
