"""Safe reading of a run's folder: links out of the folder and damaged files raise InputError.

A folder must hold all of its results. Otherwise a folder from somebody else could make a program show or
change the user's own files: HDF5 follows links to other files and takes data from any file, and a symbolic
link may lead anywhere. For damaged bytes, h5py raises nearly any exception, or none if numbers have changed.
Datasets therefore have check sums, in an attribute or in the table of the states' file.
"""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.mesh.mesh import FrameSums, Group, TriangleSurface
from lyra_petsc.output.file_operations import reason
from lyra_petsc.output.layout import MESH_FILE, RESULT, STATE_FILE
from lyra_petsc.output.xdmf import StoredField, WrittenState, group_name

if TYPE_CHECKING:
    from mpi4py import MPI


def import_h5py() -> Any:
    """The module h5py, with HDF5's file locks disabled, as they fail on some cluster file systems.

    Locks are not needed: incomplete files have names that no other process opens. If the user has set
    ``HDF5_USE_FILE_LOCKING``, the value is kept.
    """
    os.environ.setdefault("HDF5_USE_FILE_LOCKING", "FALSE")
    import h5py

    return h5py


_REMEDY = "a run's folder must hold all of its results"


class OutsideFolderError(InputError):
    """A file that lies outside of its folder, or takes data from another file."""


def check_folder(folder: Path) -> None:
    """Check that all results are regular files in the run's folder.

    Raises
    ------
    InputError
        For the first file that is not.
    """
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if RESULT.fullmatch(entry.name))
    except OSError:  # reported where it is read
        return
    for name in names:
        check_file(folder / name)


def check_file(path: Path) -> None:
    """Check that a path is a regular file or folder and no link out of its folder; it may be missing.

    Raises
    ------
    InputError
    """
    try:
        target, kind = path.resolve(), path.stat().st_mode
        inside = target.is_relative_to(path.parent.resolve())
    except (OSError, ValueError, RuntimeError):  # missing, or circular links
        if path.is_symlink():
            raise OutsideFolderError(f"is a link that leads nowhere; {_REMEDY}", file=path) from None
        return
    if not inside:
        raise OutsideFolderError(f"is a link out of the folder; {_REMEDY}", file=path)
    if not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
        raise InputError("is no plain file", file=path)


_checked_files: dict[Path, tuple[int, ...]] = {}


def _check_content(file: Any, path: Path) -> None:
    """Check all links and datasets of a file; an unchanged file is checked once only."""
    status = path.stat()
    stamp = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
    if _checked_files.get(path) == stamp:
        return
    h5py = import_h5py()
    root = h5py.h5g.open(file, b"/")
    groups, seen = [("", root)], {h5py.h5o.get_info(root).addr}
    while groups:
        above, group = groups.pop()
        for name in group:
            where = f"{above}/{name.decode(errors='replace')}"[-80:]
            if group.links.get_info(name).type != h5py.h5l.TYPE_HARD:
                raise OutsideFolderError(f"{where!r} is a link to elsewhere; {_REMEDY}", file=path)
            member = h5py.h5o.open(group, name)
            if isinstance(member, h5py.h5g.GroupID):
                # hard links may form cycles, and make few groups look like very many
                address = h5py.h5o.get_info(member).addr
                if address in seen:
                    raise InputError(f"{where!r}: a group in several places; is no file of a run", file=path)
                seen.add(address)
                groups.append((where, member))
            elif isinstance(member, h5py.h5d.DatasetID):
                plan = member.get_create_plist()
                if plan.get_layout() == h5py.h5d.VIRTUAL or plan.get_external_count() > 0:
                    raise OutsideFolderError(
                        f"{where!r} takes its data from other files; {_REMEDY}", file=path
                    )
    _checked_files[path] = stamp


SUM = "sum"
"""Attribute of a dataset with its check sum."""

TABLE = "written"
"""Group of a states file: a table with one row for each state that the file can hold.

Datasets ``step`` (−1: not written), ``time`` and ``sums``; the attribute ``columns`` names the columns of
``sums``, and the attribute ``first`` is the number of the state in row 0."""


def check_sum(array: NDArray[Any]) -> int:
    """Sum modulo 2⁶⁴ of all 64-bit words, or of all bytes for smaller types; sums of parts are additive."""
    words = np.ascontiguousarray(array).reshape(-1).view(np.uint64 if array.dtype.itemsize == 8 else np.uint8)
    return int(words.sum(dtype=np.uint64))


def check_sums(slabs: Iterable[NDArray[Any]], comm: MPI.Comm) -> NDArray[np.uint64]:
    """Check sums of distributed arrays, the same on any number of ranks; collective."""
    mine = np.array([check_sum(slab) for slab in slabs], dtype=np.uint64)
    total = np.empty_like(mine)
    comm.Allreduce(mine, total)
    return total


@contextmanager
def open_stored(path: Path) -> Iterator[Any]:
    """A context with an HDF5 file open for reading that contains all of its data.

    Yields
    ------
    h5py.File

    Raises
    ------
    InputError
        If the file has links to other files or data in them, or for any failure to read it, also within the
        context.
    """
    check_file(path)
    try:
        with import_h5py().File(path, "r") as file:
            _check_content(file.id, path)
            yield file
    except LyraError:
        raise
    except Exception as error:
        why = reason(error) if path.exists() else "no such file"
        raise InputError(f"cannot be read, or is damaged: {why}", file=path) from error


def read_stored(
    path: Path, dataset: str, shape: tuple[int | None, ...] | None = None, kinds: str = "fiu"
) -> NDArray[Any]:
    """Read a dataset and check it.

    Parameters
    ----------
    path : Path
    dataset : str
    shape : tuple of int or None
        Required shape; ``None`` stands for any length.
    kinds : str
        Allowed values of numpy's ``dtype.kind``.

    Raises
    ------
    InputError
        If the dataset is missing, has another shape or kind, differs from its check sum, or holds
        numbers that are not finite.
    """
    with open_stored(path) as file:
        stored = file[dataset]
        if stored.dtype.kind not in kinds or not _shape_matches(stored.shape, shape):
            required = " × ".join("any" if n is None else str(n) for n in shape or ())
            raise InputError(
                f"is damaged: {dataset} holds {stored.dtype} of shape {stored.shape}"
                + (f", not numbers of shape {required}" if required else ""),
                file=path,
            )
        array: NDArray[Any] = stored[()]
        expected = _expected_check_sum(file, stored, dataset)
    if check_sum(array) != expected:
        raise InputError(f"is damaged: the check sum of {dataset} does not fit", file=path)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise InputError(f"is damaged: {dataset} holds numbers that are not finite", file=path)
    return array


def _shape_matches(stored: tuple[int, ...], shape: tuple[int | None, ...] | None) -> bool:
    if shape is None:
        return True
    return len(stored) == len(shape) and all(n in (None, m) for n, m in zip(shape, stored, strict=True))


def _expected_check_sum(file: Any, stored: Any, dataset: str) -> int:
    """The stored check sum of a dataset: its attribute or, of a state's array, in the table."""
    if SUM in stored.attrs:
        return int(stored.attrs[SUM])
    _, number, name = dataset.split("/")
    table = file[TABLE]
    columns = [column for column, _ in json.loads(table.attrs["columns"].decode())]
    return int(table["sums"][int(number) - int(table.attrs["first"]), columns.index(name)])


def state_files(folder: Path) -> list[Path]:
    """The states files of a run's folder, ordered by number."""
    numbered = [(STATE_FILE.fullmatch(path.name), path) for path in folder.iterdir()]
    return [path for _, path in sorted((int(match[1]), path) for match, path in numbered if match)]


def states_in(folder: Path, *, skip_damaged: bool = False) -> list[WrittenState]:
    """The states in a run's folder, ordered by number.

    Raises
    ------
    InputError
        For a damaged file, unless it is skipped, and for links out of the folder.
    """
    states: list[WrittenState] = []
    for path in state_files(folder):
        try:
            states += _states_of(path)
        except InputError as error:
            if isinstance(error, OutsideFolderError) or not skip_damaged:
                raise
    return states


def _states_of(path: Path) -> list[WrittenState]:
    with open_stored(path) as file:
        table = file[TABLE]
        first, columns = int(table.attrs["first"]), json.loads(table.attrs["columns"].decode())
        group = file[group_name(first)]
        fields = tuple(
            StoredField(name, on, group[name].shape, group[name].dtype.name)
            for name, on in columns
            if name != "position"
        )
        rows = zip(table["step"][()].tolist(), table["time"][()].tolist(), strict=True)
        states = [
            WrittenState(first + i, step, time, path.name, fields)
            for i, (step, time) in enumerate(rows)
            if step >= 0
        ]
        if not all(math.isfinite(state.time) for state in states):
            raise ValueError("a time is not finite")
        return states


class StoredMesh:
    """The mesh of a run's folder; an array is read and checked when it is first used.

    Parameters
    ----------
    folder : path
        The run's folder.

    Raises
    ------
    InputError
        When an attribute is read, if ``mesh.h5`` is missing or damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / MESH_FILE

    @cached_property
    def rest(self) -> Array:
        """(V, 3) rest shape [m]."""
        return read_stored(self.path, "mesh/rest", (None, 3), "f")

    @cached_property
    def triangles(self) -> Ints:
        """(F, 3) vertices of each triangle."""
        return self._indices("mesh/triangles", (None, 3), len(self.rest))

    @cached_property
    def start(self) -> Array:
        """(V, 3) start positions [m]."""
        return read_stored(self.path, "start", (len(self.rest), 3), "f")

    @cached_property
    def uv(self) -> Array | None:
        """(V, 2) material coordinates [m]; None if a vertex has several."""
        with open_stored(self.path) as file:
            exists = "uv" in file["mesh"]
        return read_stored(self.path, "mesh/uv", (len(self.rest), 2), "f") if exists else None

    @cached_property
    def corner_uv(self) -> Array:
        """(F, 3, 2) material coordinates [m] of the triangles' corners."""
        if self.uv is not None:
            return np.asarray(self.uv[self.triangles])
        return read_stored(self.path, "mesh/corner_uv", (len(self.triangles), 3, 2), "f")

    @cached_property
    def textured(self) -> bool:
        """Whether the material coordinates are texture coordinates from the mesh file."""
        with open_stored(self.path) as file:
            return bool(file["mesh"].attrs.get("vt", 0))

    @property
    def groups(self) -> dict[str, Group]:
        """The groups by name; their dimension is not stored."""
        with open_stored(self.path) as file:
            stored = file.get("groups", {})
            names = {number: group.attrs["name"].decode() for number, group in stored.items()}
            datasets = {f"groups/{number}/{array}" for number, group in stored.items() for array in group}

        def indices(dataset: str, width: tuple[int, ...], end: int) -> Ints:
            if dataset not in datasets:
                return np.empty((0, *width), np.int64)
            return self._indices(dataset, (None, *width), end)

        n = len(self.rest)
        return {
            name: Group(
                0,
                indices(f"groups/{number}/vertices", (), n),
                indices(f"groups/{number}/triangles", (), len(self.triangles)),
                indices(f"groups/{number}/edges", (2,), n),
            )
            for number, name in names.items()
        }

    @property
    def obstacles(self) -> dict[str, TriangleSurface]:
        """The surfaces at t = 0 of the obstacles that are meshes, by name."""
        with open_stored(self.path) as file:
            stored = file.get("obstacles", {})
            names = {number: group.attrs["name"].decode() for number, group in stored.items()}
        surfaces = {}
        for number, name in names.items():
            points = read_stored(self.path, f"obstacles/{number}/points", (None, 3), "f")
            triangles = self._indices(f"obstacles/{number}/triangles", (None, 3), len(points))
            surfaces[name] = TriangleSurface(points, triangles)
        return surfaces

    @property
    def frames(self) -> dict[str, FrameSums]:
        """What frames of obstacles and handles were when the run was begun, by their keys."""
        with open_stored(self.path) as file:
            keys = {number: group.attrs["key"].decode() for number, group in file.get("frames", {}).items()}
        sums = {}
        for number, key in keys.items():
            time = read_stored(self.path, f"frames/{number}/time", (None,), "f")
            sums[key] = FrameSums(time, read_stored(self.path, f"frames/{number}/sums", (len(time),), "i"))
        return sums

    def _indices(self, dataset: str, shape: tuple[int | None, ...], end: int) -> Ints:
        """A dataset of indices from 0 to ``end`` − 1."""
        indices = read_stored(self.path, dataset, shape, "iu")
        if indices.size and (indices.min() < 0 or indices.max() >= end):
            raise InputError(f"is damaged: {dataset} holds numbers beyond 0 … {end - 1}", file=self.path)
        return indices
