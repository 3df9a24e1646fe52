"""VTKHDF: all states in one file of VTK's own HDF5 layout, for ParaView and programs that use VTK."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.export.frames import Frames
from lyra_petsc.output.agreement import HDF5_ERRORS, reason
from lyra_petsc.output.h5py_loader import import_h5py
from lyra_petsc.output.vtkhdf import GROUPS, add_offsets, cells, describe

OVERHEAD = 1 << 17
"""Bytes that the file needs beyond its data."""


def write(frames: Frames, folder: Path, name: str) -> None:
    """Write ``<name>.vtkhdf``: times, positions, rest shape and all fields, in double precision.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    run, n = frames.run, len(frames)
    path = folder / f"{name}.vtkhdf"
    samples = {field: run.field(field)[frames.chosen[0]] for field in run.fields}
    size = sum(array.nbytes for array in (run.positions[frames.chosen[0]], *samples.values())) * n
    try:
        _reserve(path, size + 2 * run.rest.nbytes + 2 * run.triangles.nbytes + 64 * n + OVERHEAD)
        with import_h5py().File(path, "w") as file:
            root = describe(file, frames.times.tolist(), len(run.rest), len(run.triangles))
            for key, array in cells(run.triangles).items():
                root[key] = array
            root["PointData/rest"] = run.rest
            add_offsets(root, "vertex", "rest", n, 0)
            moving = {"Points": frames.positions}
            _lay_out(root, "Points", (n * len(run.rest), 3), np.dtype(np.float64))
            for field, first in samples.items():
                on = run.field_on(field)
                place = f"{GROUPS[on]}/{field}"
                _lay_out(root, place, (n * len(first), *first.shape[1:]), first.dtype)
                add_offsets(root, on, field, n, len(first))
                moving[place] = frames.field(field)
        _reserve(path, path.stat().st_size)
        with import_h5py().File(path, "r+") as file:
            for place, arrays in moving.items():
                stored = file[f"VTKHDF/{place}"]
                for i, array in enumerate(arrays):
                    stored[i * len(array) : (i + 1) * len(array)] = array
    except InputError:
        raise
    except HDF5_ERRORS as error:
        raise OutputError(f"{path.name}: cannot be written: {reason(error)}") from error


def _reserve(path: Path, size: int) -> None:
    """Take the room on disk: an HDF5 file that cannot grow while it is closed takes the process down."""
    with open(path, "r+b" if path.exists() else "wb") as raw:
        os.posix_fallocate(raw.fileno(), 0, size)


def _lay_out(root: Any, name: str, shape: tuple[int, ...], kind: np.dtype[Any]) -> None:
    """A dataset with its place in the file, and nothing in it yet."""
    h5py = import_h5py()
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_layout(h5py.h5d.CONTIGUOUS)
    plan.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    plan.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    space, stored = h5py.h5s.create_simple(shape), h5py.h5t.py_create(kind, logical=True)
    h5py.h5d.create(root.id, name.encode(), stored, space, plan)
