"""states-NNNN.h5, one file for each written state, and the XDMF file that announces them."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import OutputError
from lyra_petsc.output.agreement import HDF5_ERRORS, reason
from lyra_petsc.output.atomic import replace_text
from lyra_petsc.output.background import Background
from lyra_petsc.output.hdf5 import NewFile, write_collective
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.self_contained import open_own
from lyra_petsc.output.stored import text_of
from lyra_petsc.output.vtkhdf_file import CELLS_FILE, VTKHDF_FILE, write_cells, write_vtkhdf
from lyra_petsc.output.xdmf import MESH_FILE, XDMF_FILE, StoredField, TimeSeries, WrittenState, group_name
from lyra_petsc.parallel import on_root

STATE_FILE = re.compile(r"states-(\d{4,})\.h5")

Fields = Mapping[str, NDArray[Any]]


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
        self.triangles = triangles
        self.n_triangles = n_triangles
        self._states: list[WrittenState] = []  # kept on rank 0
        self._series = TimeSeries(vertices.n_global, n_triangles, MESH_FILE)
        self._next = 0
        self._vtkhdf, self._background = vtkhdf, background
        if vtkhdf:
            on_root(self._comm, lambda: write_cells(self.folder))
        if resume_after is not None:
            self._next = on_root(self._comm, lambda: self._truncate(resume_after)) or 0

    @property
    def _comm(self) -> MPI.Comm:
        return self.vertices.comm

    @property
    def count(self) -> int:
        """Number of the next state."""
        return self._next

    def write(
        self,
        step: int,
        time: float,
        position: NDArray[np.float64],
        vertex_fields: Fields | None = None,
        triangle_fields: Fields | None = None,
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
        vertex_fields, triangle_fields : mapping of str to (n_owned, ...) array
            Further fields on this rank's vertices and triangles: floats or integers, the same
            names, types and trailing shapes on every rank.
        beside : sequence of NewFile
            Files that are there, too, when the state is announced.

        Raises
        ------
        OutputError
            On every rank; the states announced before stand. With a background, of the state before.
        """
        number, group = self._next, group_name(self._next)
        slabs = {"position": self.vertices.to_slab(np.asarray(position, dtype=np.float64))}
        slabs |= {name: self.vertices.to_slab(rows) for name, rows in (vertex_fields or {}).items()}
        fields = self._describe(slabs, "vertex", self.vertices)
        if triangle_fields:
            if self.triangles is None:
                raise ValueError("fields on triangles need the order of the triangles")
            on_triangles = {name: self.triangles.to_slab(rows) for name, rows in triangle_fields.items()}
            fields += self._describe(on_triangles, "triangle", self.triangles)
            slabs |= on_triangles

        stamp: dict[str, int | float | str] = {"time": float(time), "step": int(step)}
        attributes = {group: stamp, f"{group}/position": {**stamp, "on": "vertex"}}
        attributes |= {f"{group}/{field.name}": {"on": field.on} for field in fields}
        name = f"states-{number:04d}.h5"
        state = WrittenState(number, int(step), float(time), name, fields)
        datasets = {f"{group}/{key}": slab for key, slab in slabs.items()}
        file = NewFile(self.folder / name, datasets, attributes, publish=lambda: self._announce(state))
        write_collective([file, *beside], self._comm, self._background)
        self._next += 1
        return number

    @staticmethod
    def _describe(slabs: Fields, on: str, order: FileOrder) -> tuple[StoredField, ...]:
        return tuple(
            StoredField(name, on, (order.n_global, *slab.shape[1:]), slab.dtype.name)
            for name, slab in slabs.items()
            if name != "position"
        )

    def _announce(self, state: WrittenState | None) -> None:
        states = self._states if state is None else [*self._states, state]
        replace_text(self.folder / XDMF_FILE, self._series.text(states))
        if self._vtkhdf:
            write_vtkhdf(self.folder, states, self.vertices.n_global, self.n_triangles, MESH_FILE)
        self._states = states

    def _truncate(self, last_step: int) -> int:
        """Announce the states up to ``last_step``, only then remove the others."""
        found = {path: read_state(path) for path in state_files(self.folder)}
        keep = {path: state for path, state in found.items() if state is not None and state.step <= last_step}
        self._states = list(keep.values())
        self._announce(None)
        stale = [] if self._vtkhdf else [self.folder / VTKHDF_FILE, self.folder / CELLS_FILE]
        try:
            for path in [*(found.keys() - keep.keys()), *stale]:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: a later state cannot be removed: {reason(error)}") from error
        return max((state.number for state in self._states), default=-1) + 1


def state_files(folder: str | os.PathLike[str]) -> list[Path]:
    """The state files of a run's folder, by number."""
    numbered = [(STATE_FILE.fullmatch(path.name), path) for path in Path(folder).iterdir()]
    return [path for _, path in sorted((int(match[1]), path) for match, path in numbered if match)]


def read_state(path: Path) -> WrittenState | None:
    """What a state file holds, or ``None`` if it cannot be read."""
    match = STATE_FILE.fullmatch(path.name)
    try:
        with open_own(path) as file:
            number = int(match[1]) if match else 0
            group = file[group_name(number)]
            fields = tuple(
                StoredField(name, text_of(data, "on"), data.shape, data.dtype.name)
                for name, data in group.items()
                if name != "position"
            )
            return WrittenState(
                number, int(group.attrs["step"]), float(group.attrs["time"]), path.name, fields
            )
    except HDF5_ERRORS:
        return None
