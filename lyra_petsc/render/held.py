"""Which vertices and edges the handles hold at a time, for the pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.handles.motion import Window
from lyra_petsc.meshing.mesh import Group, Mesh
from lyra_petsc.meshing.select import select_vertices
from lyra_petsc.output.agreement import HDF5_ERRORS, reason
from lyra_petsc.output.h5py_loader import import_h5py
from lyra_petsc.results.announced import MESH_FILE
from lyra_petsc.results.run import Run

Indices = NDArray[np.int64]


class HeldVertices:
    """The handles of a run's scene.

    Raises
    ------
    InputError
        If the run's mesh.h5 does not hold what a handle names.
    """

    def __init__(self, run: Run) -> None:
        mesh = _stored_mesh(run)
        self._n_vertices = mesh.n_vertices
        self._handles = [
            (
                Window.of(handle),
                select_vertices(mesh, handle, key=f"handles[{i}]", file=run.folder / MESH_FILE),
            )
            for i, handle in enumerate(run.scene.handles)
        ]
        corners = mesh.triangles
        pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
        self._edges: Indices = np.unique(np.sort(pairs, axis=1), axis=0)

    def at(self, time: float) -> tuple[Indices, Indices]:
        """Vertices (n,) held at a time [s], and the edges (k, 2) between them."""
        held = np.zeros(self._n_vertices, dtype=bool)
        for window, vertices in self._handles:
            if window.holds(time, time):
                held[vertices] = True
        return np.flatnonzero(held), self._edges[held[self._edges].all(axis=1)]


def _stored_mesh(run: Run) -> Mesh:
    """What handles are selected from: start positions and groups."""
    path = run.folder / MESH_FILE
    groups: dict[str, Group] = {}
    none = np.empty(0, dtype=np.int64)
    try:
        with import_h5py().File(path, "r") as file:
            start = file["start"][()]
            for stored in file["groups"].values() if "groups" in file else ():
                vertices = stored["vertices"][()] if "vertices" in stored else none
                groups[str(stored.attrs["name"])] = Group(0, vertices, none, none.reshape(0, 2))
    except HDF5_ERRORS as error:
        raise InputError(f"cannot be read: {reason(error)}", file=path) from None
    return Mesh(
        positions=start,
        rest=start,
        triangles=run.triangles,
        triangle_uv=np.empty((0, 3, 2)),
        flat_rest=np.empty(0, dtype=bool),
        groups=groups,
    )
