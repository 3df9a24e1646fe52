"""states.vtkhdf: the states as one time series in VTK's HDF5 format, read by ParaView and VTK.

The file holds no states. Its datasets are *virtual datasets* that refer to ``states-NNNN.h5``, so that the
file is small and can be replaced atomically, as ``states.xdmf``. The triangles, which VTK needs in another
form than that of ``mesh.h5``, are in ``cells.h5``.

Format: VTK's documentation, "VTKHDF file format", version 2.0, a transient UnstructuredGrid of one part. All
steps share the triangles, so their offsets are 0 at every step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lyra_petsc.output.file_operations import HDF5_ERRORS, replace_bytes, writing
from lyra_petsc.output.hdf5 import create_file
from lyra_petsc.output.layout import CELLS_FILE, MESH_FILE, VTKHDF_FILE
from lyra_petsc.output.stored import StoredMesh, import_h5py
from lyra_petsc.output.tensors import VTK_COLUMNS, is_tensor
from lyra_petsc.output.xdmf import WrittenState, group_name

GROUPS = {"vertex": "PointData", "triangle": "CellData"}


def write_cells(folder: Path) -> None:
    """Write ``cells.h5`` from the mesh of the folder. Call on one rank.

    Raises
    ------
    InputError
        If the mesh cannot be read.
    OutputError
    """
    triangles = StoredMesh(folder).triangles
    n = len(triangles)
    arrays = {"Connectivity": triangles.ravel(), "Offsets": 3 * np.arange(n + 1, dtype=np.int64)}
    triangle = 5  # VTK's number of this type of cells
    create_file(folder / CELLS_FILE, {**arrays, "Types": np.full(n, triangle, np.uint8)})


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
    # in memory: HDF5 would crash the process if a file on disk could not grow while it is closed
    in_memory = {"driver": "core", "backing_store": False}
    with writing(path, HDF5_ERRORS), import_h5py().File("unnamed", "w", **in_memory) as file:
        _fill(file, states, n_vertices, n_triangles)
        file.flush()
        content = bytes(file.id.get_file_image())
    replace_bytes(path, content)


def _fill(file: Any, states: Sequence[WrittenState], n_vertices: int, n_triangles: int) -> None:
    h5py, n = import_h5py(), len(states)
    root = file.create_group("VTKHDF", track_order=True)
    root.attrs["Version"] = np.array([2, 0])
    kind = b"UnstructuredGrid"
    root.attrs.create("Type", kind, dtype=h5py.string_dtype("ascii", len(kind)))
    lengths = {"Points": n_vertices, "Cells": n_triangles, "ConnectivityIds": 3 * n_triangles}
    for name, length in lengths.items():
        root[f"NumberOf{name}"] = np.full(n, length, dtype=np.int64)
    numbers, zeros = np.arange(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    root.create_group("Steps").attrs["NSteps"] = n
    root["Steps/Values"] = np.array([state.time for state in states], dtype=np.float64)
    root["Steps/NumberOfParts"], root["Steps/PartOffsets"] = zeros + 1, zeros
    root["Steps/PointOffsets"] = n_vertices * numbers
    root["Steps/CellOffsets"] = root["Steps/ConnectivityIdOffsets"] = zeros[:, None]
    for name in GROUPS.values():
        root.create_group(name)
        root.create_group(f"Steps/{name}Offsets")

    cells = {"Connectivity": (3 * n_triangles, "i8"), "Offsets": (n_triangles + 1, "i8")}
    for name, (length, dtype) in (cells | {"Types": (n_triangles, "u1")}).items():
        _add_virtual_dataset(root, name, (length,), dtype, {0: (CELLS_FILE, name)}, length)
    positions = {i: (s.file, f"{group_name(s.number)}/position") for i, s in enumerate(states)}
    _add_virtual_dataset(root, "Points", (n * n_vertices, 3), "f8", positions, n_vertices)
    _add_virtual_dataset(
        root, "PointData/rest", (n_vertices, 3), "f8", {0: (MESH_FILE, "mesh/rest")}, n_vertices
    )
    root["Steps/PointDataOffsets/rest"] = zeros
    # each name once, with the shape and type of the newest state
    for field in {field.name: field for state in states for field in state.fields}.values():
        sources = {
            i: (state.file, f"{group_name(state.number)}/{field.name}")
            for i, state in enumerate(states)
            if field in state.fields
        }
        group, rows = GROUPS[field.on], field.shape[0]
        shape = (n * rows, *field.shape[1:])
        _add_virtual_dataset(root, f"{group}/{field.name}", shape, field.dtype, sources, rows)
        root[f"Steps/{group}Offsets/{field.name}"] = rows * numbers


def _add_virtual_dataset(
    root: Any,
    name: str,
    shape: tuple[int, ...],
    dtype: str,
    sources: Mapping[int, tuple[str, str]],
    rows: int,
) -> None:
    """Add a virtual dataset whose i-th block of ``rows`` rows is the dataset ``sources[i]`` of another file.

    Tensors of six components are mapped to VTK's order.
    """
    h5py = import_h5py()
    layout = h5py.VirtualLayout(shape, dtype)
    for i, (file, dataset) in sources.items():
        source = h5py.VirtualSource(file, dataset, (rows, *shape[1:]))
        block = slice(i * rows, (i + 1) * rows)
        if not is_tensor(shape):
            layout[block] = source
        for vtk, xdmf in VTK_COLUMNS if is_tensor(shape) else ():
            layout[block, vtk] = source[:, xdmf]
    root.create_virtual_dataset(name, layout, np.nan if np.dtype(dtype).kind == "f" else None)
