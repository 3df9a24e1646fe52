"""checkpoint.h5: everything that a run needs to resume, on any number of ranks."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.output.file_operations import writing
from lyra_petsc.output.hdf5 import NewFile, read_slab
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.run_folder import CHECKPOINT, NEXT, PREVIOUS, checkpoint_files
from lyra_petsc.output.stored import check_sums, open_stored, text_attribute
from lyra_petsc.parallel import on_root

FORMAT = 2

FIRST_FORMAT = 1
"""Format of older versions, in which only the arrays have check sums."""

Scalars = dict[str, Any]


@dataclass(frozen=True)
class Checkpoint:
    """The content of a checkpoint.

    Attributes
    ----------
    arrays : dict of str to (n_owned, ...) array
        Vertex arrays by name, in this rank's numbering.
    scalars : dict
        As given to `checkpoint_file`.
    file : Path
        The file that was read: the newest undamaged checkpoint.
    note : str or None
        For the user: why this is not the newest checkpoint.
    edges : dict of str to (n_edges,) array
        Unknowns of edges by name, in this rank's numbering.
    elements : dict of str to (n, m) array
        Rows of changing elements by name, divided evenly among the ranks.
    """

    arrays: dict[str, NDArray[Any]]
    scalars: Scalars
    file: Path
    note: str | None = None
    edges: dict[str, NDArray[Any]] = field(default_factory=dict)
    elements: dict[str, NDArray[Any]] = field(default_factory=dict)


def checkpoint_file(
    folder: str | os.PathLike[str],
    order: FileOrder,
    arrays: Mapping[str, NDArray[Any]],
    scalars: Mapping[str, Any],
    edge_order: FileOrder | None = None,
    edge_arrays: Mapping[str, NDArray[Any]] = MappingProxyType({}),
    elements: Mapping[str, NDArray[Any]] = MappingProxyType({}),
) -> NewFile:
    """A new checkpoint, to be passed to `write_collective`; the old file is kept as the previous checkpoint.

    Parameters
    ----------
    folder : path
        The run's folder.
    order : FileOrder
        File order of the vertices that each rank owns; collective over its ranks.
    arrays : mapping of str to (n_owned, ...) array of float64 or int64
        Vertex arrays: ``position`` [m], ``velocity`` [m/s], and arrays of the integrator's history.
    edge_order : FileOrder or None
        File order of the edges with an unknown that each rank owns; None without such edges.
    edge_arrays : mapping of str to (n_edges,) array of float64
        Arrays of the unknowns of edges.
    elements : mapping of str to (n, m) array of float64
        Rows of this rank's changing elements, in any order.
    scalars : mapping
        Values that JSON can hold (numbers, text, lists, mappings): ``step``, ``time``, ``dt``, cumulative
        works, …; the same on every rank.
    """
    folder = Path(folder)
    slabs = {f"vertices/{name}": order.to_slab(np.asarray(rows)) for name, rows in arrays.items()}
    if edge_order is not None:
        slabs |= {f"edges/{name}": edge_order.to_slab(np.asarray(v)) for name, v in edge_arrays.items()}
    slabs |= {f"elements/{name}": rows for name, rows in elements.items()}
    sums = dict(zip(slabs, check_sums(slabs.values(), order.comm).tolist(), strict=True))
    text = json.dumps(dict(scalars))
    facts = {name: (slab.dtype.str, slab.shape[1:], sums[name]) for name, slab in slabs.items()}
    attributes: dict[str, dict[str, int | float | str]] = {
        "/": {
            "format": FORMAT,
            "n_vertices": order.n_global,
            "scalars": text,
            "digest": _digest(FORMAT, order.n_global, text, facts),
        },
        **{name: {"sum": str(value)} for name, value in sums.items()},
    }
    return NewFile(folder / NEXT, slabs, attributes, publish=lambda: _rotate(folder))


def _rotate(folder: Path) -> None:
    with writing(folder / CHECKPOINT):
        if (folder / CHECKPOINT).exists():
            os.replace(folder / CHECKPOINT, folder / PREVIOUS)
        os.replace(folder / NEXT, folder / CHECKPOINT)


def read_checkpoint(
    folder: str | os.PathLike[str], order: FileOrder, edge_order: FileOrder | None = None
) -> Checkpoint:
    """The newest undamaged checkpoint of a run, which any number of ranks may have written.

    Parameters
    ----------
    folder : path
        The run's folder.
    order : FileOrder
        File order of the vertices that each rank owns now; collective over its ranks.

    Raises
    ------
    InputError
        On every rank, if there is no checkpoint, all are damaged, or the mesh is a different one.
    """
    newest: InputError | None = None
    for file in on_root(order.comm, lambda: checkpoint_files(folder)):
        try:
            scalars, sums, counts = on_root(order.comm, lambda f=file: _read_metadata(f, order))  # type: ignore[misc]
            arrays, edges = (
                {
                    name.split("/", 1)[1]: _read_rows(file, name, sums[name], by)
                    for name in sorted(sums)
                    if name.startswith(kind) and by is not None
                }
                for kind, by in (("vertices/", order), ("edges/", edge_order))
            )
            elements = {
                name.split("/", 1)[1]: _read_rows(file, name, sums[name], _equal_slabs(order.comm, count))
                for name, count in sorted(counts.items())
            }
        except InputError as error:
            newest = newest or error
            continue
        note = f"{newest}; going on from the one before" if newest else None
        return Checkpoint(arrays, scalars, file, note, edges, elements)
    if newest is None:
        raise InputError("holds no checkpoint to resume from; run without --resume", file=folder)
    raise InputError(
        f"{newest.message}, and no earlier checkpoint can be used: run without --resume, into a new folder",
        file=newest.file,
    )


def _read_metadata(file: Path, order: FileOrder) -> tuple[Scalars, dict[str, int], dict[str, int]]:
    with open_stored(file) as content:
        version, n_vertices = int(content.attrs["format"]), int(content.attrs["n_vertices"])
        if version not in (FIRST_FORMAT, FORMAT):
            raise InputError(
                f"checkpoint has format {version}, this version reads {FIRST_FORMAT} and {FORMAT}", file=file
            )
        text = text_attribute(content, "scalars")
        scalars = json.loads(text)
        found = {
            f"{kind}/{name}": (data.dtype.str, data.shape[1:], int(text_attribute(data, "sum")))
            for kind in ("vertices", "edges", "elements")
            for name, data in content.get(kind, {}).items()
        }
        counts = {f"elements/{name}": len(data) for name, data in content.get("elements", {}).items()}
        stored_digest = text_attribute(content, "digest") if version != FIRST_FORMAT else None
    if stored_digest is not None and stored_digest != _digest(version, n_vertices, text, found):
        raise InputError("checkpoint is damaged: its check sum does not fit", file=file)
    if not _is_plausible(scalars) or any(np.dtype(kind).itemsize != 8 for kind, _, _ in found.values()):
        raise InputError("checkpoint is damaged: it holds what no run writes", file=file)
    if n_vertices != order.n_global:
        raise InputError(
            f"checkpoint has {n_vertices} vertices, the scene's mesh {order.n_global}: "
            "resume with the scene it was written by",
            file=file,
        )
    return scalars, {name: total for name, (_, _, total) in found.items()}, counts


def _equal_slabs(comm: MPI.Comm, count: int) -> FileOrder:
    """A file order in which each rank owns the rows of its slab."""
    starts = np.arange(comm.size + 1, dtype=np.int64) * count // comm.size
    return FileOrder(comm, np.arange(starts[comm.rank], starts[comm.rank + 1]), count)


def _is_plausible(scalars: Any) -> bool:
    """Whether a run can have written these scalars; in the first format they have no check sum."""
    if not isinstance(scalars, dict):
        return False
    step, time = scalars.get("step"), scalars.get("time")
    return isinstance(step, int) and step >= 0 and isinstance(time, float | int) and 0.0 <= time < math.inf


def _digest(version: int, n_vertices: int, scalars: str, arrays: Mapping[str, tuple[Any, ...]]) -> str:
    """SHA-256 of a checkpoint's content: the scalars' text, and type, shape and check sum of each array."""
    content = [
        version,
        n_vertices,
        scalars,
        sorted((name, *map(str, facts)) for name, facts in arrays.items()),
    ]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _read_rows(file: Path, name: str, expected: int, order: FileOrder) -> NDArray[Any]:
    slab = read_slab(file, name, order)
    if int(check_sums([slab], order.comm)[0]) != expected:
        raise InputError(
            f"checkpoint is damaged: the check sum of {name.split('/', 1)[1]} does not fit", file=file
        )
    return order.from_slab(slab)
