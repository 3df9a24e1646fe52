"""Reading a run's folder: files that lead out of it are refused, and damaged ones are one line of words.

A folder holds all of its results. Otherwise one from somebody else could make a program show or change the
user's own files: HDF5 follows links to other files and takes data from any file, and a symbolic link may lead
anywhere. h5py and the library below it raise nearly anything for a file with changed bytes, and numbers that
were changed raise nothing at all: datasets have check sums, beside them or in the table of the states' file.
"""

from __future__ import annotations

import json
import os
import re
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.mesh.mesh import Group, TriangleSurface
from lyra_petsc.output.agreement import reason
from lyra_petsc.output.xdmf import MESH_FILE

if TYPE_CHECKING:
    from mpi4py import MPI


def import_h5py() -> Any:
    """h5py, with HDF5's file locks off: they fail on some cluster file systems.

    Nothing is lost with them: files are written under a name that no other process opens, and have
    their final name only when complete. ``HDF5_USE_FILE_LOCKING`` set by the user stands.
    """
    os.environ.setdefault("HDF5_USE_FILE_LOCKING", "FALSE")
    import h5py

    return h5py


def import_ahead() -> None:
    """Import h5py in a thread, while this one waits for gmsh's process."""

    def work() -> None:
        with suppress(ImportError):  # told where it is needed
            import_h5py()

    Thread(target=work, name="lyra-petsc h5py").start()


ENDINGS = (".h5", ".xdmf", ".vtkhdf", ".csv", ".yaml", ".json", ".txt", ".part")
"""Of what a run writes and its readers read."""

_REMEDY = "a run's folder must hold all of its results"


class OutsideFolderError(InputError):
    """A file that is no part of its folder, or takes data from elsewhere."""


def check_folder(folder: Path) -> None:
    """Refuse results outside of the run's folder.

    Raises
    ------
    InputError
        Naming the first one.
    """
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if entry.name.endswith(ENDINGS))
    except OSError:  # reported where it is read
        return
    for name in names:
        check_file(folder / name)


def check_file(path: Path) -> None:
    """Refuse a file that stands outside the folder where it seems to be, or is no file.

    Raises
    ------
    InputError
    """
    try:
        target, kind = path.resolve(), path.stat().st_mode
        inside = target.is_relative_to(path.parent.resolve())
    except (OSError, ValueError, RuntimeError):  # missing, or a circle of links
        if path.is_symlink():
            raise OutsideFolderError(f"is a link that leads nowhere; {_REMEDY}", file=path) from None
        return
    if not inside:
        raise OutsideFolderError(f"is a link out of the folder; {_REMEDY}", file=path)
    if not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
        raise InputError("is no plain file", file=path)


def check_name(name: str, file: Path) -> None:
    """Refuse a name in ``file`` that is not that of another file in its folder.

    Raises
    ------
    InputError
    """
    if name in ("", ".", "..") or "\\" in name or os.path.basename(name) != name or not name.isprintable():
        raise OutsideFolderError(f"names {name[:80]!r}, which is no file in its folder; {_REMEDY}", file=file)


@contextmanager
def open_own(path: str | os.PathLike[str]) -> Iterator[Any]:
    """An HDF5 file of a run's folder, to read, whose data are all its own.

    Yields
    ------
    h5py.File

    Raises
    ------
    InputError
        For data of other files, and links to them.
    OSError and what else h5py raises
        If it cannot be read.
    """
    path = Path(path)
    check_file(path)
    with import_h5py().File(path, "r") as file:
        _check_content(file.id, path)
        yield file


_known: dict[Path, tuple[int, ...]] = {}


def _check_content(file: Any, path: Path) -> None:
    """Look at all links and datasets of a file, once as long as it does not change."""
    status = path.stat()
    stamp = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
    if _known.get(path) == stamp:
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
                # hard links may make circles, and few groups look like very many
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
    _known[path] = stamp


SUM = "sum"
"""Attribute of a dataset: its check sum, as text."""

TABLE = "written"
"""Group of a file of states with a row for each that it has room for: ``step`` (−1: not written), ``time``
and ``sums``, whose columns are named by the attribute ``columns``; row 0 is of the state ``first``."""

STATE = re.compile(r"/?states/(\d+)/[^/]+")


def check_sum(array: NDArray[Any]) -> int:
    """Sum modulo 2⁶⁴ of all 64-bit words (of bytes, where elements are shorter); sums of parts add up."""
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
    """A file, open for reading.

    Raises
    ------
    InputError
        For whatever goes wrong with it, also within the context.
    """
    try:
        with open_own(path) as file:
            yield file
    except LyraError:
        raise
    except Exception as error:
        why = reason(error) if path.exists() else "no such file"
        raise InputError(f"cannot be read, or is damaged: {why}", file=path) from error


def read_stored(
    path: Path, dataset: str, shape: tuple[int | None, ...] | None = None, kinds: str = "fiu"
) -> NDArray[Any]:
    """A whole dataset of a file.

    Parameters
    ----------
    path : Path
    dataset : str
    shape : tuple of int or None
        What it must have; ``None`` stands for any length.
    kinds : str
        numpy's letters of the kinds of numbers that it may hold.

    Raises
    ------
    InputError
        If it is missing, of another shape or kind, differs from its check sum, or is not finite.
    """
    with open_stored(path) as file:
        stored = file[dataset]
        if stored.dtype.kind not in kinds or not _fits(stored.shape, shape):
            words = " × ".join("any" if n is None else str(n) for n in shape or ())
            raise InputError(
                f"is damaged: {dataset.lstrip('/')} holds {stored.dtype} of shape {stored.shape}"
                + (f", not numbers of shape {words}" if words else ""),
                file=path,
            )
        array: NDArray[Any] = stored[()]
        expected = _expected(file, stored, dataset)
    if expected is not None and check_sum(array) != expected:
        raise InputError(f"is damaged: the check sum of {dataset.lstrip('/')} does not fit", file=path)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise InputError(f"is damaged: {dataset.lstrip('/')} holds numbers that are not finite", file=path)
    return array


def text_of(owner: Any, name: str) -> str:
    """An attribute that is text, of fixed or (in older files) variable length."""
    value = owner.attrs[name]
    return value.decode() if isinstance(value, bytes) else str(value)


def _fits(found: tuple[int, ...], shape: tuple[int | None, ...] | None) -> bool:
    if shape is None:
        return True
    return len(found) == len(shape) and all(n in (None, m) for n, m in zip(shape, found, strict=True))


def _expected(file: Any, stored: Any, dataset: str) -> int | None:
    """The check sum of a dataset; None where an older version wrote none."""
    if SUM in stored.attrs:
        return int(text_of(stored, SUM))
    state = STATE.fullmatch(dataset)
    if state is None or TABLE not in file:
        return None
    table = file[TABLE]
    row = int(state[1]) - int(table.attrs["first"])
    columns = [name for name, _ in json.loads(text_of(table, "columns"))]
    return int(table["sums"][row, columns.index(dataset.rpartition("/")[2])])


class StoredMesh:
    """The mesh of a run's folder; an array is read when it is first asked for, and checked.

    Parameters
    ----------
    folder : path
        The run's folder.

    Raises
    ------
    InputError
        By each attribute, if ``mesh.h5`` is missing or damaged.
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
        return self._numbers("mesh/triangles", (None, 3), len(self.rest))

    @cached_property
    def start(self) -> Array | None:
        """(V, 3) start positions [m]; None where an older version wrote none."""
        with open_stored(self.path) as file:
            if "start" not in file:
                return None
        return read_stored(self.path, "start", (len(self.rest), 3), "f")

    @cached_property
    def uv(self) -> Array | None:
        """(V, 2) material coordinates [m]; None where a vertex has more than one."""
        with open_stored(self.path) as file:
            there = "uv" in file["mesh"]
        return read_stored(self.path, "mesh/uv", (len(self.rest), 2), "f") if there else None

    @cached_property
    def corner_uv(self) -> Array:
        """(F, 3, 2) material coordinates [m] of the triangles' corners."""
        if self.uv is not None:
            return np.asarray(self.uv[self.triangles])
        return read_stored(self.path, "mesh/corner_uv", (len(self.triangles), 3, 2), "f")

    @cached_property
    def textured(self) -> bool:
        """Whether the material coordinates came with the mesh, as texture coordinates."""
        with open_stored(self.path) as file:
            return bool(file["mesh"].attrs.get("vt", 0))

    @property
    def groups(self) -> dict[str, Group]:
        """The groups by their names; their dimension is not stored."""
        with open_stored(self.path) as file:
            stored = file.get("groups", {})
            names = {number: text_of(group, "name") for number, group in stored.items()}
            filled = {f"groups/{number}/{part}" for number, group in stored.items() for part in group}

        def part(place: str, width: tuple[int, ...], end: int) -> Ints:
            if place not in filled:
                return np.empty((0, *width), np.int64)
            return self._numbers(place, (None, *width), end)

        n = len(self.rest)
        return {
            name: Group(
                0,
                part(f"groups/{number}/vertices", (), n),
                part(f"groups/{number}/triangles", (), len(self.triangles)),
                part(f"groups/{number}/edges", (2,), n),
            )
            for number, name in names.items()
        }

    @property
    def obstacles(self) -> dict[str, TriangleSurface]:
        """The obstacles that are meshes, at t = 0, by their names."""
        with open_stored(self.path) as file:
            names = {number: text_of(group, "name") for number, group in file.get("obstacles", {}).items()}
        found = {}
        for number, name in names.items():
            points = read_stored(self.path, f"obstacles/{number}/points", (None, 3), "f")
            triangles = self._numbers(f"obstacles/{number}/triangles", (None, 3), len(points))
            found[name] = TriangleSurface(points, triangles)
        return found

    def _numbers(self, dataset: str, shape: tuple[int | None, ...], end: int) -> Ints:
        """Whole numbers from 0 to before ``end``."""
        found = read_stored(self.path, dataset, shape, "iu")
        if found.size and (found.min() < 0 or found.max() >= end):
            raise InputError(f"is damaged: {dataset} holds numbers beyond 0 … {end - 1}", file=self.path)
        return found
