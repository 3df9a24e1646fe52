"""Formats with all states as arrays in one file: NumPy's .npz and VTK's .vtkhdf."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output.agreement import HDF5_ERRORS, reason
from lyra_petsc.output.h5py_loader import import_h5py
from lyra_petsc.output.hdf5 import properties
from lyra_petsc.output.tensors import in_vtk_order
from lyra_petsc.output.vtkhdf_file import GROUPS, add_offsets, cells, describe
from lyra_petsc.show.export.exported_states import ExportedStates

OVERHEAD = 1 << 17
"""Bytes that an HDF5 file needs beyond its data."""


def write_npz(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>.npz``, one state in memory at a time.

    ``time`` (T,), ``position`` (T, V, 3), each field (T, …), ``triangles`` (F, 3), ``rest`` (V, 3), where the
    mesh has them ``uv`` (V, 2) or ``corner_uv`` (F, 3, 2), and ``names`` and ``units`` (n,) of all of these.
    """
    run = states.run
    fixed = {"time": states.times, "triangles": run.triangles, "rest": run.rest}
    if run.uv is not None:
        fixed["uv"] = run.uv
    elif run.corner_uv is not None:
        fixed["corner_uv"] = run.corner_uv
    units = {"time": "s", "triangles": "1", "rest": "m", "uv": "m", "corner_uv": "m", "position": "m"}
    units |= {field: run.field_units(field) for field in states.fields}
    moving = {"position": states.positions} | {field: states.field(field) for field in states.fields}
    names = [*fixed, *moving]
    fixed |= {"names": np.array(names), "units": np.array([units[one] for one in names])}
    with zipfile.ZipFile(folder / f"{name}.npz", "w", zipfile.ZIP_STORED) as archive:
        for one, array in fixed.items():
            _write_array(archive, one, iter([array]), array.shape)
        for one, arrays in moving.items():
            first = next(arrays)
            _write_array(archive, one, chain([first], arrays), (len(states), *first.shape))


def _write_array(
    archive: zipfile.ZipFile, name: str, arrays: Iterator[NDArray[Any]], shape: tuple[int, ...]
) -> None:
    """Write an array (as .npy) from pieces along its first axis."""
    first = np.ascontiguousarray(next(arrays))
    header = {"shape": shape, "fortran_order": False, "descr": first.dtype.str}
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        npy.write_array_header_2_0(file, header)  # type: ignore[no-untyped-call]
        file.write(first.data.cast("B") if first.size else b"")
        for array in arrays:
            file.write(np.ascontiguousarray(array, dtype=first.dtype).data.cast("B"))


def write_vtkhdf(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>.vtkhdf``: times, positions, rest shape and all fields, in double precision.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    run, n = states.run, len(states)
    path = folder / f"{name}.vtkhdf"
    samples = {field: next(states.field(field)) for field in states.fields}
    size = sum(array.nbytes for array in (run.positions[states.chosen[0]], *samples.values())) * n
    try:
        _reserve(path, size + 2 * run.rest.nbytes + 2 * run.triangles.nbytes + 64 * n + OVERHEAD)
        with import_h5py().File(path, "w") as file:
            root = describe(file, states.times.tolist(), len(run.rest), len(run.triangles))
            for key, array in cells(run.triangles).items():
                root[key] = array
            root["PointData/rest"] = run.rest
            add_offsets(root, "vertex", "rest", n, 0)
            moving = {"Points": states.positions}
            _allocate(root, "Points", (n * len(run.rest), 3), np.dtype(np.float64))
            for field, first in samples.items():
                on = states.field_on(field)
                place = f"{GROUPS[on]}/{field}"
                _allocate(root, place, (n * len(first), *first.shape[1:]), first.dtype)
                add_offsets(root, on, field, n, len(first))
                moving[place] = states.field(field)
        _reserve(path, path.stat().st_size)
        with import_h5py().File(path, "r+") as file:
            for place, arrays in moving.items():
                stored = file[f"VTKHDF/{place}"]
                for i, array in enumerate(arrays):
                    stored[i * len(array) : (i + 1) * len(array)] = in_vtk_order(array)
    except InputError:
        raise
    except HDF5_ERRORS as error:
        raise OutputError(f"{path.name}: cannot be written: {reason(error)}") from error


def _reserve(path: Path, size: int) -> None:
    """Allocate a file's bytes first: HDF5 crashes if the disk is full when a file is closed."""
    with open(path, "r+b" if path.exists() else "wb") as raw:
        os.posix_fallocate(raw.fileno(), 0, size)


def _allocate(root: Any, name: str, shape: tuple[int, ...], kind: np.dtype[Any]) -> None:
    """Create a dataset whose place in the file is allocated at once; its values are written later."""
    h5py = import_h5py()
    space, stored = h5py.h5s.create_simple(shape), h5py.h5t.py_create(kind, logical=True)
    h5py.h5d.create(root.id, name.encode(), stored, space, properties()[0])
