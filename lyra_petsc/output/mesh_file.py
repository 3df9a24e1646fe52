"""mesh.h5: what all states of a run share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.meshing.mesh import Mesh
from lyra_petsc.output.hdf5 import write_collective
from lyra_petsc.parallel import on_root

MESH_FILE = "mesh.h5"


def write_mesh(folder: str | os.PathLike[str], mesh: Mesh | None, comm: MPI.Comm) -> None:
    """Write ``mesh.h5`` from the mesh as it exists on rank 0. Collective.

    ``/mesh/triangles`` (F, 3) int64, ``/mesh/rest`` (V, 3) [m] and the material coordinates
    [m]: ``/mesh/uv`` (V, 2) where each vertex has one, else ``/mesh/corner_uv`` (F, 3, 2).

    Parameters
    ----------
    folder : path
        The run's folder.
    mesh : Mesh or None
        Needed on rank 0 only.
    comm : MPI.Comm
        All ranks.

    Raises
    ------
    OutputError
        On every rank, if it could not be written.
    """

    def work() -> None:
        if mesh is None:
            raise ValueError("rank 0 needs the mesh")
        datasets: dict[str, NDArray[Any]] = {"mesh/triangles": mesh.triangles, "mesh/rest": mesh.rest}
        uv = vertex_uv(mesh)
        datasets["mesh/corner_uv" if uv is None else "mesh/uv"] = mesh.triangle_uv if uv is None else uv
        write_collective(Path(folder) / MESH_FILE, datasets, {}, MPI.COMM_SELF)

    on_root(comm, work)


def vertex_uv(mesh: Mesh) -> NDArray[np.float64] | None:
    """(V, 2) material coordinates [m], or ``None`` where a vertex has more than one."""
    uv = np.zeros((mesh.n_vertices, 2))
    uv[mesh.triangles] = mesh.triangle_uv
    return uv if np.array_equal(uv[mesh.triangles], mesh.triangle_uv) else None
