"""Geometry of the sheet in pictures: vertex normals, vertices split along texture seams, held vertices."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.mesh.topology import unique_edges
from lyra_petsc.output.layout import MESH_FILE
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.show.render.opengl import import_pyvista
from lyra_petsc.terms.handles.motion import Window


def split_at_seams(triangles: Ints, corner_uv: Array) -> tuple[Ints, Ints, Array]:
    """Split each vertex into one copy for each of its texture coordinates.

    Parameters
    ----------
    triangles : (F, 3) int64
    corner_uv : (F, 3, 2) float64
        Texture coordinates of the triangles' corners.

    Returns
    -------
    source : (n,) int64
        The vertex of the mesh that each copy belongs to.
    corners : (F, 3) int64
        The triangles in the numbering of the copies.
    uv : (n, 2) float64
        Texture coordinates of the copies.
    """
    rows = np.column_stack([triangles.ravel().astype(np.float64), corner_uv.reshape(-1, 2)])
    copies, corners = np.unique(rows, axis=0, return_inverse=True)
    return copies[:, 0].astype(np.int64), corners.reshape(triangles.shape).astype(np.int64), copies[:, 1:]


def sheet_numbers(run: StoredRun) -> Ints:
    """(F,) number of the sheet, a connected part of the mesh, of each triangle; in the order of the file."""
    surface = import_pyvista().PolyData.from_regular_faces(run.rest, run.triangles)
    regions = surface.connectivity("all").cell_data["RegionId"]
    _, first, sheet = np.unique(regions, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[sheet]


def vertex_normals(x: Array, triangles: Ints) -> Array:
    """(V, 3) unit normals at vertices ``x`` (V, 3): the area-weighted mean of the triangles' normals.

    Zero if a vertex's triangles have no area.
    """
    corners = x[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ends, repeated = triangles.ravel(), np.repeat(normals, 3, axis=0)
    summed = np.stack([np.bincount(ends, repeated[:, k], len(x)) for k in range(3)], axis=1)
    lengths = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.asarray(np.divide(summed, lengths, out=np.zeros_like(summed), where=lengths > 0.0))


class HeldVertices:
    """The vertices that the handles of a run's scene hold.

    Raises
    ------
    InputError
        If the run's mesh.h5 lacks a group that a handle names.
    """

    def __init__(self, run: StoredRun) -> None:
        mesh, path = _stored_mesh(run), run.folder / MESH_FILE
        self._n_vertices = mesh.n_vertices
        self._handles = [
            (Window.of(handle), select_vertices(mesh, handle, key=f"handles[{i}]", file=path))
            for i, handle in enumerate(run.scene.handles)
        ]
        self._edges = unique_edges(mesh.triangles)

    def at(self, time: float) -> tuple[Ints, Ints]:
        """Vertices (n,) held at a time [s], and the edges (k, 2) between them."""
        held = np.zeros(self._n_vertices, dtype=bool)
        for window, vertices in self._handles:
            if window.holds(time, time):
                held[vertices] = True
        return np.flatnonzero(held), self._edges[held[self._edges].all(axis=1)]


def _stored_mesh(run: StoredRun) -> Mesh:
    """The run's mesh with the start positions and groups by which handles select vertices."""
    start = run.rest if run.mesh.start is None else run.mesh.start
    no_uv, no_rest = np.empty((0, 3, 2)), np.empty(0, dtype=bool)
    return Mesh(start, start, run.triangles, triangle_uv=no_uv, flat_rest=no_rest, groups=run.mesh.groups)
