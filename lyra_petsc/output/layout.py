"""HDF5 files with room for datasets that are yet to be written, each at a known place.

By the library's own calls: h5py's objects over them take twice as long, which small states feel. So does a
file that HDF5 opens beside one that is made in memory. Half of the rest is saved as files of a run are alike:
a small one is the last of its kind, still in memory, with other values of its attributes.
"""

from __future__ import annotations

import math
import os
import posixpath
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.output.h5py_loader import import_h5py

Value = int | float | str
Attributes = Mapping[str, Mapping[str, Value]]
Shapes = Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]]

# bytes that a file with a few dozen datasets needs beyond their data and attributes
LARGEST_OVERHEAD = 1 << 16

# bytes of data up to which a file is laid out in memory, a copy of the data's places included
MOST_IN_MEMORY = 1 << 22

# and up to which it is kept there, and how many are
MOST_KEPT, KEPT = 1 << 19, 4

# bytes by which it may grow, as the room of texts that were replaced is lost
MOST_LOST = 1 << 13


def lay_out(
    part: Path, slabs: Mapping[str, NDArray[Any]], rows: Sequence[int], attributes: Attributes
) -> list[int]:
    """Create a file, its whole size reserved on disk; where each dataset is to be written [bytes].

    Parameters
    ----------
    part : Path
    slabs : mapping of str to array
        Name, type and trailing shape of each dataset.
    rows : sequence of int
        Rows of each dataset.
    attributes : mapping of str to mapping
        Attributes of groups and datasets, by their path in the file.

    Raises
    ------
    OSError and what else h5py raises
        If it cannot be created.
    """
    shapes = {
        name: ((count, *slab.shape[1:]), slab.dtype)
        for (name, slab), count in zip(slabs.items(), rows, strict=True)
    }
    data = sum(kind.itemsize * math.prod(shape) for shape, kind in shapes.values())
    if data > MOST_IN_MEMORY:
        texts = sum(len(str(value)) for values in attributes.values() for value in values.values())
        with open(part, "wb") as raw:
            os.posix_fallocate(raw.fileno(), 0, data + texts + LARGEST_OVERHEAD)
        on_disk = _Content(os.fsencode(part), False, shapes, attributes)
        on_disk.close()
        with open(part, "r+b") as raw:
            os.posix_fallocate(raw.fileno(), 0, part.stat().st_size)
        return on_disk.places
    places, image = _in_memory(shapes, attributes, keep=data <= MOST_KEPT)
    with open(part, "wb") as raw:
        os.posix_fallocate(raw.fileno(), 0, len(image))
        raw.write(image)
    return places


class _Content:
    """An open HDF5 file with these datasets and attributes."""

    def __init__(self, name: bytes, in_memory: bool, shapes: Shapes, attributes: Attributes) -> None:
        h5py = import_h5py()
        early, links = _of_datasets()
        self.file = h5py.h5f.create(name, h5py.h5f.ACC_TRUNC, fapl=_of_files(in_memory))
        self._values: dict[tuple[str, str], Any] = {}
        try:
            owners = {"/": self.file}
            for path, (shape, kind) in shapes.items():
                space, stored = h5py.h5s.create_simple(shape), h5py.h5t.py_create(kind, logical=True)
                owners[path] = h5py.h5d.create(self.file, path.encode(), stored, space, early, links)
            # a dataset without rows has no place
            self.places: list[int] = [owners[path].get_offset() or 0 for path in shapes]
            for path, values in attributes.items():
                if path not in owners:
                    made = path in self.file
                    owners[path] = (h5py.h5g.open if made else h5py.h5g.create)(self.file, path.encode())
                for key, value in values.items():
                    stored = _kinds(type(value).__name__).stored
                    attribute = h5py.h5a.create(owners[path], key.encode(), stored, _scalar())
                    self._values[path, key] = attribute
            self.set(attributes)
        except BaseException:
            self.file.close()
            raise

    def set(self, attributes: Attributes) -> None:
        """Give all attributes, in their order, these values."""
        values = (value for of_path in attributes.values() for value in of_path.values())
        for attribute, value in zip(self._values.values(), values, strict=True):
            kinds = _kinds(type(value).__name__)
            attribute.write(np.array(value, dtype=kinds.array), kinds.memory)

    def image(self) -> bytes:
        """The file's bytes."""
        import_h5py().h5f.flush(self.file)
        return bytes(self.file.get_file_image())

    def close(self) -> None:
        self.file.close()


@dataclass
class _Kept:
    """A file in memory that others are made of."""

    group: str
    content: _Content
    size: int


_kept: dict[Any, _Kept] = {}
_numbers = count()


def _in_memory(shapes: Shapes, attributes: Attributes, *, keep: bool) -> tuple[list[int], bytes]:
    """Places and bytes of a file."""
    group = _common_group(shapes, attributes)
    kind = (
        posixpath.dirname(group),  # where it stays when it gets another name
        tuple((name.removeprefix(group), *shape) for name, shape in shapes.items()),
        tuple(
            (path.removeprefix(group), key, type(value))
            for path, of_path in attributes.items()
            for key, value in of_path.items()
        ),
    )
    like = _kept.pop(kind, None)
    if like is not None:
        content = like.content
        if group != like.group:
            content.file.links.move(like.group.encode(), content.file, group.encode())
            like.group = group
        content.set(attributes)
        image = content.image()
        if len(image) <= like.size + MOST_LOST:
            _kept[kind] = like
            return content.places, image
        content.close()
    # HDF5 refuses the name of a file that is open
    content = _Content(b"in memory %d" % next(_numbers), True, shapes, attributes)
    image = content.image()
    if keep:
        _kept[kind] = _Kept(group, content, len(image))
        if len(_kept) > KEPT:
            _kept.pop(next(iter(_kept))).content.close()
    else:
        content.close()
    return content.places, image


def _common_group(shapes: Shapes, attributes: Attributes) -> str:
    """The innermost group that all that has a name is in, or nothing."""
    return posixpath.commonpath([path for path in (*shapes, *attributes) if path != "/"] or [""])


@cache
def _of_datasets() -> tuple[Any, Any]:
    """How datasets, and the groups they are in, are made."""
    h5py = import_h5py()
    early = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    early.set_layout(h5py.h5d.CONTIGUOUS)
    early.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    early.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    links = h5py.h5p.create(h5py.h5p.LINK_CREATE)
    links.set_create_intermediate_group(True)
    return early, links


@cache
def _of_files(in_memory: bool) -> Any:
    """How files are made."""
    h5py = import_h5py()
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_fclose_degree(h5py.h5f.CLOSE_STRONG)
    if in_memory:
        access.set_fapl_core(LARGEST_OVERHEAD, False)
    return access


@cache
def _scalar() -> Any:
    h5py = import_h5py()
    return h5py.h5s.create(h5py.h5s.SCALAR)


class _Kinds(NamedTuple):
    """Types of an attribute: NumPy's, and HDF5's of such an array and in a file."""

    array: np.dtype[Any]
    memory: Any
    stored: Any


@cache
def _kinds(of: str) -> _Kinds:
    h5py = import_h5py()
    array = np.dtype(h5py.string_dtype() if of == "str" else of)
    return _Kinds(array, h5py.h5t.py_create(array), h5py.h5t.py_create(array, logical=True))
