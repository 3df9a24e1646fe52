"""NumPy: one file with all arrays, their names and units."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from lyra_petsc.export.frames import Frames


def write(frames: Frames, folder: Path, name: str) -> None:
    """Write ``<name>.npz``, one state in memory at a time.

    ``time`` (T,), ``position`` (T, V, 3), each field (T, …), ``triangles`` (F, 3), ``rest`` (V, 3), where the
    mesh has them ``uv`` (V, 2) or ``corner_uv`` (F, 3, 2), and ``names`` and ``units`` (n,) of all of these.
    """
    run = frames.run
    fixed = {"time": frames.times, "triangles": run.triangles, "rest": run.rest}
    if run.uv is not None:
        fixed["uv"] = run.uv
    elif run.corner_uv is not None:
        fixed["corner_uv"] = run.corner_uv
    units = {"time": "s", "triangles": "1", "rest": "m", "uv": "m", "corner_uv": "m", "position": "m"}
    units |= {field: run.field_units(field) for field in run.fields}
    moving = {"position": frames.positions} | {field: frames.field(field) for field in run.fields}
    names = [*fixed, *moving]
    fixed |= {"names": np.array(names), "units": np.array([units[one] for one in names])}
    with zipfile.ZipFile(folder / f"{name}.npz", "w", zipfile.ZIP_STORED) as archive:
        for one, array in fixed.items():
            _write(archive, one, iter([array]), array.shape)
        for one, arrays in moving.items():
            first = next(arrays)
            _write(archive, one, _all(first, arrays), (len(frames), *first.shape))


def _all(first: NDArray[Any], others: Iterator[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    yield first
    yield from others


def _write(
    archive: zipfile.ZipFile, name: str, arrays: Iterator[NDArray[Any]], shape: tuple[int, ...]
) -> None:
    """An array from pieces along its first axis."""
    first = np.ascontiguousarray(next(arrays))
    header = {"shape": shape, "fortran_order": False, "descr": first.dtype.str}
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        npy.write_array_header_2_0(file, header)  # type: ignore[no-untyped-call]
        file.write(first.data.cast("B") if first.size else b"")
        for array in arrays:
            file.write(np.ascontiguousarray(array, dtype=first.dtype).data.cast("B"))
