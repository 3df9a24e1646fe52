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
    mesh has them ``uv`` (V, 2) or ``corner_uv`` (F, 3, 2), of each obstacle ``obstacle_<name>`` (T, n, 3) and
    ``triangles_of_<name>`` (m, 3), and ``names`` and ``units`` (n,) of all of these.
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
    for label, obstacle in states.obstacles.items():
        moving[f"obstacle_{label}"] = states.places(obstacle)
        fixed[f"triangles_of_{label}"] = obstacle.triangles
        units |= {f"obstacle_{label}": "m", f"triangles_of_{label}": "1"}
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

    Obstacles have files of their own, ``<name>-<obstacle>.vtkhdf``.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    run = states.run
    fields = {field: (states.field_on(field), states.field(field)) for field in states.fields}
    moving = {"Points": ("vertex", states.positions), **fields}
    _write_moving(folder / f"{name}.vtkhdf", states.times, run.triangles, {"rest": run.rest}, moving)
    for label, obstacle in states.obstacles.items():
        path, places = folder / f"{name}-{label}.vtkhdf", states.places(obstacle)
        _write_moving(path, states.times, obstacle.triangles, {}, {"Points": ("vertex", places)})


def _write_moving(
    path: Path,
    times: NDArray[np.float64],
    triangles: NDArray[np.int64],
    fixed: dict[str, NDArray[np.float64]],
    moving: dict[str, tuple[str, Iterator[NDArray[Any]]]],
) -> None:
    """Write a file of triangles.

    Parameters
    ----------
    path : Path
    times : (T,)
        Of the states [s].
    triangles : (F, 3)
    fixed : dict of arrays
        On vertices, the same in all states.
    moving : dict of (str, iterator)
        For each state an array on the vertices or triangles; ``Points`` are the positions [m].
    """
    n, arrays, samples = len(times), {}, {}
    for field, (_, each) in moving.items():
        samples[field] = next(each)
        arrays[field] = chain([samples[field]], each)
    size = n * sum(array.nbytes for array in samples.values()) + 2 * triangles.nbytes + 64 * n + OVERHEAD
    try:
        _reserve(path, size + 2 * sum(array.nbytes for array in fixed.values()))
        places = {}
        with import_h5py().File(path, "w") as file:
            root = describe(file, times.tolist(), len(samples["Points"]), len(triangles))
            for key, array in cells(triangles).items():
                root[key] = array
            for key, array in fixed.items():
                root[f"PointData/{key}"] = array
                add_offsets(root, "vertex", key, n, 0)
            for field, first in samples.items():
                on = moving[field][0]
                places[field] = field if field == "Points" else f"{GROUPS[on]}/{field}"
                _allocate(root, places[field], (n * len(first), *first.shape[1:]), first.dtype)
                if field != "Points":
                    add_offsets(root, on, field, n, len(first))
        _reserve(path, path.stat().st_size)
        with import_h5py().File(path, "r+") as file:
            for field, each in arrays.items():
                stored = file[f"VTKHDF/{places[field]}"]
                for i, array in enumerate(each):
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
