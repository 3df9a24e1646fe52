"""checkpoint.h5: everything that a run needs to resume, on any number of ranks."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.output.file_operations import sync, writing
from lyra_petsc.output.hdf5 import read_slab, write_rows
from lyra_petsc.output.layout import CHECKPOINT, PREVIOUS
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.run_folder import RUN
from lyra_petsc.output.stored import check_sums, open_stored
from lyra_petsc.parallel import on_root
from lyra_petsc.stepping.term_states import VERTICES

LARGEST = 1e50
"""Largest magnitude of a number [SI]; energies of larger positions overflow."""

ENTRIES = "entries"
"""Dataset of bytes: the SHA-256 of a JSON text, and the text with all numbers and check sums."""

Scalars = dict[str, Any]


@dataclass(frozen=True)
class Checkpoint:
    """The content of a checkpoint.

    Attributes
    ----------
    arrays : dict of str to array
        Vertex arrays (n_owned, 3) by name, in this rank's numbering.
    scalars : dict
        As passed to `write_checkpoint`.
    file : Path
        The file that was read: the newest undamaged checkpoint.
    note : str or None
        For the user: why this is not the newest checkpoint.
    edges : dict of str to (n_edges,) array
        Unknowns of edges by name, in this rank's numbering.
    elements : dict of str to (n, m) array
        Arrays of elements by name, divided evenly among the ranks.
    """

    arrays: dict[str, NDArray[Any]]
    scalars: Scalars
    file: Path
    note: str | None = None
    edges: dict[str, NDArray[Any]] = field(default_factory=dict)
    elements: dict[str, NDArray[Any]] = field(default_factory=dict)


def write_checkpoint(
    folder: Path,
    order: FileOrder,
    arrays: Mapping[str, NDArray[Any]],
    scalars: Mapping[str, Any],
    edge_order: FileOrder | None = None,
    edge_arrays: Mapping[str, NDArray[Any]] = MappingProxyType({}),
    elements: Mapping[str, NDArray[Any]] = MappingProxyType({}),
) -> Callable[[], None]:
    """Write a checkpoint beside those that exist; collective.

    Parameters
    ----------
    folder : Path
        The run's folder.
    order : FileOrder
        File order of the vertices that each rank owns.
    arrays : mapping of str to (n_owned, 3) array of float64
        Vertex arrays: ``position`` [m], ``velocity`` [m/s], and arrays of the integrator's history.
    scalars : mapping
        Numbers, texts, and lists and mappings of these; the same on every rank.
    edge_order : FileOrder or None
        File order of the edges with an unknown that each rank owns; None without such edges.
    edge_arrays : mapping of str to (n_edges,) array of float64
        Arrays of the unknowns of edges.
    elements : mapping of str to (n, m) array of float64
        Rows of this rank's changing elements, in any order.

    Returns
    -------
    callable
        To be called on rank 0, also in another thread: when the file is on disk, it becomes the newest
        checkpoint, and the newest one so far the previous one.

    Raises
    ------
    OutputError
        On every rank, if the file cannot be written; then the checkpoints are kept.
    """
    slabs = {f"vertices/{name}": order.to_slab(np.asarray(rows)) for name, rows in arrays.items()}
    if edge_order is not None:
        slabs |= {f"edges/{name}": edge_order.to_slab(np.asarray(v)) for name, v in edge_arrays.items()}
    slabs |= {f"elements/{name}": rows for name, rows in elements.items()}
    sums = dict(zip(slabs, check_sums(slabs.values(), order.comm).tolist(), strict=True))
    entries = _encoded({"n_vertices": order.n_global, "sums": sums, "scalars": dict(scalars)})
    slabs[ENTRIES] = np.frombuffer(entries if order.comm.rank == 0 else b"", np.uint8)
    newest, previous = folder / CHECKPOINT, folder / PREVIOUS
    part = newest.with_name(f"{CHECKPOINT}.part")
    write_rows(part, slabs, order.comm, create={})

    def publish() -> None:
        sync(part)
        with writing(newest):
            if newest.exists():
                os.replace(newest, previous)
            os.replace(part, newest)

    return publish


def _encoded(entries: Mapping[str, Any]) -> bytes:
    """A check sum and the entries as text."""
    text = json.dumps(entries).encode()
    return hashlib.sha256(text).hexdigest().encode() + text


class Stored(NamedTuple):
    """Type, shape and check sum of an array of the file."""

    dtype: str
    shape: tuple[int, ...]
    total: int


class TermArrays(NamedTuple):
    """The arrays of a scene's terms.

    Attributes
    ----------
    vertices : set of str
        Names of those on vertices; a term that the checkpoint does not know has none there.
    edges : set of str
        Names of those on edges.
    elements : mapping of str to int
        Number of columns of those of elements. The terms' `VERTICES` are numbers of vertices.
    """

    vertices: Set[str] = frozenset()
    edges: Set[str] = frozenset()
    elements: Mapping[str, int] = MappingProxyType({})


NO_TERMS = TermArrays()


def read_checkpoint(
    folder: str | os.PathLike[str],
    order: FileOrder,
    edge_order: FileOrder | None = None,
    terms: TermArrays = NO_TERMS,
) -> Checkpoint:
    """The newest undamaged checkpoint of a run, which any number of ranks may have written.

    Parameters
    ----------
    folder : path
        The run's folder.
    order : FileOrder
        File order of the vertices that each rank owns now; collective over its ranks.
    edge_order : FileOrder or None
        File order of the edges with an unknown; None without such edges.
    terms : TermArrays
        Arrays of the scene's terms; elements of other terms are not read.

    Raises
    ------
    InputError
        On every rank, if there is no checkpoint, none holds what a run writes, or the mesh is another one.
    """
    newest: InputError | None = None
    for file in on_root(order.comm, lambda: RUN.resumable(Path(folder))):
        try:
            scalars, stored = on_root(
                order.comm,
                lambda f=file: _read_metadata(f, order, edge_order, terms),  # type: ignore[misc]
            )
            arrays: dict[str, dict[str, NDArray[Any]]] = {"vertices": {}, "edges": {}, "elements": {}}
            for path, (_, shape, total) in stored.items():
                kind, name = path.split("/", 1)
                by = {"vertices": order, "edges": edge_order}.get(kind) or _equal_slabs(order.comm, shape[0])
                slab = read_slab(file, path, by)
                problem = _problem_of(
                    slab, total, order, numbers=kind == "elements" and name.endswith(f".{VERTICES}")
                )
                if problem:
                    raise InputError(f"checkpoint is damaged: {path} {problem}", file=file)
                arrays[kind][name] = by.from_slab(slab)
        except InputError as error:
            newest = newest or error
            continue
        note = f"{newest}; going on from the one before" if newest else None
        return Checkpoint(arrays["vertices"], scalars, file, note, arrays["edges"], arrays["elements"])
    if newest is None:
        raise InputError("holds no checkpoint to resume from; run without --resume", file=folder)
    raise InputError(
        f"{newest.message}, and no earlier checkpoint can be used: run without --resume, into a new folder",
        file=newest.file,
    )


def _read_metadata(
    file: Path, order: FileOrder, edge_order: FileOrder | None, terms: TermArrays
) -> tuple[Scalars, dict[str, Stored]]:
    """The checked entries, and the arrays that the scene needs by their paths (rank 0)."""
    with open_stored(file) as content:
        encoded = content[ENTRIES][()].tobytes()
        if hashlib.sha256(encoded[64:]).hexdigest().encode() != encoded[:64]:
            raise InputError("checkpoint is damaged: its check sum does not fit", file=file)
        entries = json.loads(encoded[64:])
        n_vertices, scalars = entries["n_vertices"], entries["scalars"]
        stored = {
            f"{kind}/{name}": Stored(data.dtype.str, data.shape, entries["sums"][f"{kind}/{name}"])
            for kind in ("vertices", "edges", "elements")
            for name, data in content.get(kind, {}).items()
        }
    if n_vertices != order.n_global:
        raise InputError(
            f"checkpoint has {n_vertices} vertices, the scene's mesh {order.n_global}: "
            "resume with the scene it was written by",
            file=file,
        )
    try:
        n_edges = 0 if edge_order is None else edge_order.n_global
        needed = _needed_arrays(stored, n_vertices, n_edges, terms)
        if 8 * max(math.prod(array.shape) for array in needed.values()) > file.stat().st_size:
            raise ValueError("an array is longer than the file")
    except ValueError as error:
        raise InputError(f"checkpoint is damaged: it holds what no run writes ({error})", file=file) from None
    return scalars, needed


def _needed_arrays(
    stored: Mapping[str, Stored], n_vertices: int, n_edges: int, terms: TermArrays
) -> dict[str, Stored]:
    """The arrays that the scene needs.

    Raises
    ------
    ValueError
        In one line, if an array is missing or has another type or shape than it must.
    """
    of_vertices = {path.split("/", 1)[1] for path in stored if path.startswith("vertices/")}
    own = {name for name in of_vertices if "." not in name}  # arrays of terms have a dot
    known = {name.split(".")[0] for name in of_vertices}
    of_vertices |= {name for name in terms.vertices if name.split(".")[0] in known}
    shapes: dict[str, tuple[int, ...]] = {f"vertices/{name}": (n_vertices, 3) for name in of_vertices}
    if n_edges:
        shapes |= {f"edges/{name}": (n_edges,) for name in own | terms.edges}
    for name, columns in terms.elements.items():
        vertices = f"elements/{name.split('.')[0]}.{VERTICES}"
        if vertices in stored:
            shapes[f"elements/{name}"] = (*stored[vertices].shape[:1], columns)
    for path, shape in shapes.items():
        if path not in stored:
            raise ValueError(f"{path} is missing")
        if stored[path][:2] != ("<f8", shape):
            raise ValueError(
                f"{path} is {stored[path].dtype} of shape {stored[path].shape}, not <f8 of {shape}"
            )
    return {path: stored[path] for path in sorted(shapes)}


def _problem_of(slab: NDArray[Any], total: int, order: FileOrder, *, numbers: bool) -> str:
    """What is wrong with an array of which this rank has a slab; empty if nothing is; collective.

    ``numbers``: it holds numbers of vertices.
    """
    if int(check_sums([slab], order.comm)[0]) != total:
        return "differs from its check sum"
    plausible = (np.abs(slab) <= LARGEST).all()  # not so for NaN
    if numbers:
        plausible &= ((slab >= 0) & (slab < order.n_global) & (slab == np.floor(slab))).all()
    return "" if order.comm.allreduce(bool(plausible), MPI.LAND) else "holds numbers that no run writes"


def _equal_slabs(comm: MPI.Comm, count: int) -> FileOrder:
    """A file order in which each rank owns the rows of its slab."""
    starts = np.arange(comm.size + 1, dtype=np.int64) * count // comm.size
    return FileOrder(comm, np.arange(starts[comm.rank], starts[comm.rank + 1]), count)
