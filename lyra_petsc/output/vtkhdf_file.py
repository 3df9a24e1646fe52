"""states.vtkhdf: the states as one time series in VTK's HDF5 format, read by ParaView and VTK.

The file holds no states. Its datasets are *virtual datasets* that refer to ``states-NNNN.h5``, so that the
file is small and can be replaced atomically, as ``states.xdmf``. The triangles, which VTK needs in another
form than that of ``mesh.h5``, are in ``cells.h5``.

Format: VTK's documentation, "VTKHDF file format", version 2.0, a transient UnstructuredGrid of one part. All
steps share the triangles, so their offsets are 0 at every step.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Ints
from lyra_petsc.output.file_operations import HDF5_ERRORS, replace_bytes, writing
from lyra_petsc.output.stored import StoredMesh, import_h5py
from lyra_petsc.output.tensors import VTK_COLUMNS, is_tensor
from lyra_petsc.output.xdmf import MESH_FILE, WrittenState, group_name

VTKHDF_FILE = "states.vtkhdf"
CELLS_FILE = "cells.h5"

TRIANGLE = 5
"""VTK's cell type of a triangle."""

GROUPS = {"vertex": "PointData", "triangle": "CellData"}


def cells(triangles: Ints) -> dict[str, NDArray[Any]]:
    """VTK's arrays ``Connectivity`` (3 F,), ``Offsets`` (F + 1,) and ``Types`` (F,) of triangles (F, 3)."""
    n = len(triangles)
    return {
        "Connectivity": np.ascontiguousarray(triangles, dtype=np.int64).ravel(),
        "Offsets": 3 * np.arange(n + 1, dtype=np.int64),
        "Types": np.full(n, TRIANGLE, dtype=np.uint8),
    }


def write_cells(folder: Path) -> None:
    """Write ``cells.h5`` from the mesh of the folder. Call on one rank.

    Raises
    ------
    InputError
        If the mesh cannot be read.
    OutputError
    """
    path, triangles = folder / CELLS_FILE, StoredMesh(folder).triangles
    with _atomic_hdf5_file(path) as file:
        for name, array in cells(triangles).items():
            file[name] = array


def write_vtkhdf(folder: Path, states: Sequence[WrittenState], n_vertices: int, n_triangles: int) -> None:
    """Write ``states.vtkhdf`` for these states. Call on one rank.

    Where a state lacks a field, its values are NaN (0 for integers).

    Parameters
    ----------
    folder : Path
        The run's folder, with ``cells.h5`` and the states files.
    states : sequence of WrittenState
    n_vertices, n_triangles : int

    Raises
    ------
    OutputError
        If the file cannot be written; then the old file is kept.
    """
    path = folder / VTKHDF_FILE
    rows = {"vertex": n_vertices, "triangle": n_triangles}
    with _atomic_hdf5_file(path) as file:
        root = create_metadata(file, [state.time for state in states], n_vertices, n_triangles)
        lengths = {"Connectivity": 3 * n_triangles, "Offsets": n_triangles + 1, "Types": n_triangles}
        for name, length in lengths.items():
            kind = np.dtype(np.uint8 if name == "Types" else np.int64)
            _add_virtual_dataset(root, name, (length,), kind, {0: (CELLS_FILE, name)}, length)
        real = np.dtype(np.float64)
        positions = {i: (s.file, f"{group_name(s.number)}/position") for i, s in enumerate(states)}
        _add_virtual_dataset(root, "Points", (len(states) * n_vertices, 3), real, positions, n_vertices)
        rest = {0: (MESH_FILE, "mesh/rest")}
        _add_virtual_dataset(root, "PointData/rest", (n_vertices, 3), real, rest, n_vertices)
        add_offsets(root, "vertex", "rest", len(states), 0)
        # each name once, with the shape and type of the newest state
        for field in {field.name: field for state in states for field in state.fields}.values():
            sources = {
                i: (state.file, f"{group_name(state.number)}/{field.name}")
                for i, state in enumerate(states)
                if field in state.fields
            }
            n = rows[field.on]
            name = f"{GROUPS[field.on]}/{field.name}"
            shape = (len(states) * n, *field.shape[1:])
            _add_virtual_dataset(root, name, shape, np.dtype(field.dtype), sources, n)
            add_offsets(root, field.on, field.name, len(states), n)


def create_metadata(file: Any, times: Sequence[float], n_vertices: int, n_triangles: int) -> Any:
    """Create and return the group ``/VTKHDF`` with all metadata but without the data of the states.

    Parameters
    ----------
    file : h5py.File
    times : sequence of float
        Times of the states [s].
    """
    h5py = import_h5py()
    n = len(times)
    root = file.create_group("VTKHDF", track_order=True)
    root.attrs["Version"] = np.array([2, 0])
    kind = b"UnstructuredGrid"
    root.attrs.create("Type", kind, dtype=h5py.string_dtype("ascii", len(kind)))
    for name, count in (
        ("NumberOfPoints", n_vertices),
        ("NumberOfCells", n_triangles),
        ("NumberOfConnectivityIds", 3 * n_triangles),
    ):
        root[name] = np.full(n, count, dtype=np.int64)
    for name in GROUPS.values():
        root.create_group(name)
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = n
    steps["Values"] = np.asarray(times, dtype=np.float64)
    steps["NumberOfParts"] = np.ones(n, dtype=np.int64)
    steps["PartOffsets"] = np.zeros(n, dtype=np.int64)
    steps["PointOffsets"] = n_vertices * np.arange(n, dtype=np.int64)
    steps["CellOffsets"] = np.zeros((n, 1), dtype=np.int64)
    steps["ConnectivityIdOffsets"] = np.zeros((n, 1), dtype=np.int64)
    for name in GROUPS.values():
        steps.create_group(f"{name}Offsets")
    return root


def add_offsets(root: Any, on: str, name: str, n_states: int, rows: int) -> None:
    """Write each step's first row in a field that has ``rows`` rows per state; 0: all states share rows."""
    root[f"Steps/{GROUPS[on]}Offsets/{name}"] = rows * np.arange(n_states, dtype=np.int64)


def _add_virtual_dataset(
    root: Any,
    name: str,
    shape: tuple[int, ...],
    kind: np.dtype[Any],
    sources: Mapping[int, tuple[str, str]],
    rows: int,
) -> None:
    """Add a virtual dataset whose i-th block of ``rows`` rows is the dataset ``sources[i]`` of another file.

    Tensors of six components are mapped to VTK's order.
    """
    h5py = import_h5py()
    layout = h5py.VirtualLayout(shape, kind)
    for i, (file, dataset) in sources.items():
        source = h5py.VirtualSource(file, dataset, (rows, *shape[1:]))
        block = slice(i * rows, (i + 1) * rows)
        if not is_tensor(shape):
            layout[block] = source
        for vtk, xdmf in VTK_COLUMNS if is_tensor(shape) else ():
            layout[block, vtk] = source[:, xdmf]
    root.create_virtual_dataset(name, layout, np.nan if kind.kind == "f" else None)


@contextmanager
def _atomic_hdf5_file(path: Path) -> Iterator[Any]:
    """A context with an HDF5 file in memory that replaces the file ``path`` atomically at its end.

    HDF5 would crash the process if a file on disk could not grow while it is closed.
    """
    in_memory = {"driver": "core", "backing_store": False}
    with writing(path, HDF5_ERRORS), import_h5py().File("unnamed", "w", **in_memory) as file:
        yield file
        file.flush()
        content = bytes(file.id.get_file_image())
    replace_bytes(path, content)
