"""The arrays in which a PETSc matrix keeps its entries, so that new values reach them in one pass.

petsc4py has no calls for them, the C library has. ``MatSetValues`` looks for every entry's place each time.
"""

from __future__ import annotations

import ctypes
import itertools
import mmap
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.assembly.pattern import BlockPattern, begins, index_type
from lyra_petsc.block_rows.vectors import put_plain, put_transposed
from lyra_petsc.kernel_cache import cached
from lyra_petsc.partition.points import Points

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

KINDS = {"aij": "AIJ", "baij": "BAIJ", "sbaij": "SBAIJ"}
"""Matrix types whose storage is known here, as the C library spells them."""

PORTIONS = 16
"""In which transposed blocks go through ``MatSetValues``: it is given a copy of them."""


@cached(inline="always")
def _put(block, out, at, across, along):  # type: ignore[no-untyped-def]
    """Rows of a block as it is stored ``across`` apart, columns ``along``."""
    for i in range(3):
        for j in range(3):
            out[at + across * i + along * j] = block[i, j]


@cached()
def _to_baij(indptr, columns, begin, below, values, inside, outside):  # type: ignore[no-untyped-def]
    """Blocks column by column; those of owned columns apart from those of ghosts."""
    n, p, q = len(indptr) - 1, 0, 0
    blocks, inner, outer = values.reshape(-1, 9), inside.reshape(-1, 9), outside.reshape(-1, 9)
    for row in range(n):
        for t in range(begin[row], begin[row + 1]):
            put_transposed(blocks, below[t], inner, p)
            p += 1
        for k in range(indptr[row], indptr[row + 1]):
            if columns[k] < n:
                put_plain(blocks, k, inner, p)
                p += 1
            else:
                put_plain(blocks, k, outer, q)
                q += 1


@cached()
def _to_aij(indptr, columns, begin, below, values, inside, outside):  # type: ignore[no-untyped-def]
    """Three scalar rows for each row of blocks; owned columns apart from ghosts."""
    n, p, q = len(indptr) - 1, 0, 0
    for row in range(n):
        width, beyond = 3 * (begin[row + 1] - begin[row]), 0
        for k in range(indptr[row], indptr[row + 1]):
            if columns[k] < n:
                width += 3
            else:
                beyond += 3
        at = p
        for t in range(begin[row], begin[row + 1]):
            _put(values[below[t]], inside, at, width, 1)
            at += 3
        for k in range(indptr[row], indptr[row + 1]):
            if columns[k] < n:
                _put(values[k], inside, at, 1, width)
                at += 3
        at = q
        for k in range(indptr[row], indptr[row + 1]):
            if columns[k] >= n:
                _put(values[k], outside, at, 1, beyond)
                at += 3
        p += 3 * width
        q += 3 * beyond


@cached()
def _to_sbaij(indptr, columns, begin, below, values, inside, outside):  # type: ignore[no-untyped-def]
    """Blocks of owned columns as they are; those of ghosts are another's business."""
    n, p = len(indptr) - 1, 0
    blocks, inner = values.reshape(-1, 9), inside.reshape(-1, 9)
    for row in range(n):
        for k in range(indptr[row], indptr[row + 1]):
            if columns[k] >= n:
                break
            put_plain(blocks, k, inner, p)
            p += 1


@cached()
def _transposes(indptr, columns, place, below):  # type: ignore[no-untyped-def]
    """Blocks of the upper triangle by columns; ``place`` (n_owned,) is where those of each begin."""
    n = len(indptr) - 1
    for row in range(n):
        for k in range(indptr[row] + 1, indptr[row + 1]):
            c = columns[k]
            if c < n:
                below[place[c]] = k
                place[c] += 1


class StoredRows:
    """The rows that a PETSc matrix of a pattern keeps: whole ones, or of ``sbaij`` the upper triangle.

    Parameters
    ----------
    points : Points
    pattern : BlockPattern
    kind : str

    Attributes
    ----------
    inside, outside : (n_owned,) int
        Blocks of each row in owned columns, and in columns of ghosts.
    begin, below : (n_owned + 1,) int64, (n_below,) int
        Compressed rows of what stands before the diagonal: blocks of the pattern, to be transposed.
    diagonal : (n_owned,) int
        Which of the blocks in owned columns are those of the diagonal.
    """

    def __init__(self, points: Points, pattern: BlockPattern, kind: str) -> None:
        self._points, self._pattern = points, pattern
        n, indptr, columns = points.n_owned, pattern.indptr, pattern.columns
        own = columns < n
        in_front = 0
        if kind == "sbaij":
            self.begin, self.below = np.zeros(n + 1, dtype=np.int64), np.empty(0, dtype=np.int32)
            in_front = int(np.searchsorted(points.ghosts, points.start))
        else:
            self.begin = begins(np.bincount(columns[own], minlength=n) - 1)
            self.below = np.empty(self.begin[-1], dtype=index_type(len(columns)))
            _transposes(indptr, columns, self.begin[:-1].copy(), self.below)
        self._kept = own | (columns >= n + in_front)
        self.inside = (np.diff(self.begin) + _per_row(own, indptr)).astype(PETSc.IntType)
        self.outside = _per_row(self._kept & ~own, indptr).astype(PETSc.IntType)
        self.diagonal = begins(self.inside)[:-1] + np.diff(self.begin)

    def insert(self, values: Array, mat: PETSc.Mat) -> None:
        """Set all entries by ``MatSetValues``; collective."""
        indptr, columns, kept = self._pattern.indptr, self._pattern.columns, self._kept
        numbers = self._points.global_number
        if not kept.all():
            columns, values, indptr = columns[kept], values[kept], begins(_per_row(kept, indptr))
        _set(mat, indptr, numbers[columns], values)
        edges = np.linspace(0, len(self.below), PORTIONS + 1).astype(np.int64)
        for lo, hi in itertools.pairwise(edges):
            part = self.below[lo:hi]
            rows = np.searchsorted(self._pattern.indptr, part, side="right") - 1
            # all rows, most of them empty: petsc4py takes no others
            _set(mat, np.clip(self.begin, lo, hi) - lo, numbers[rows], values[part].transpose(0, 2, 1))
        mat.assemble()

    def insert_outside(self, values: Array, mat: PETSc.Mat) -> None:
        """Set the entries in columns of ghosts by ``MatSetValues``; not assembled after it."""
        beyond, owned, indptr, columns = self._beyond
        mat.setValuesBlockedIJV(indptr, columns, values[beyond], PETSc.InsertMode.INSERT, rowmap=owned)

    @cached_property
    def _beyond(self) -> tuple[Ints, Ints, Ints, Ints]:
        """Blocks kept in columns of ghosts; their rows, where these begin, and columns, as PETSc wants it."""
        rows = np.flatnonzero(self.outside)
        blocks = np.flatnonzero(self._kept & (self._pattern.columns >= self._points.n_owned))
        columns = self._points.global_number[self._pattern.columns[blocks]]
        indices = self._points.start + rows, begins(self.outside[rows]), columns
        owned, indptr, numbers = (each.astype(PETSc.IntType) for each in indices)
        return blocks, owned, indptr, numbers


def _set(mat: PETSc.Mat, indptr: Ints, columns: Ints, blocks: Array) -> None:
    indices = indptr.astype(PETSc.IntType), columns.astype(PETSc.IntType)
    mat.setValuesBlockedCSR(*indices, np.ascontiguousarray(blocks), PETSc.InsertMode.INSERT)


def _per_row(flags: NDArray[np.bool_], indptr: Ints) -> Ints:
    """How many blocks (n_blocks,) of each row are flagged."""
    counts: Ints = np.diff(begins(flags)[indptr])
    return counts


class Storage:
    """Writes block rows into the arrays of an assembled matrix.

    Parameters
    ----------
    mat : PETSc.Mat
        With the entries of the pattern and no others; assembled.
    kind : str
        A key of ``KINDS``.
    pattern : BlockPattern
    stored : StoredRows

    Attributes
    ----------
    shared : (n_blocks, 3, 3) or None
        PETSc's array, where that is block rows as the pattern has them; as long as the matrix lives.
    whole : (blocks, 3, 3) or None
        PETSc's array of all blocks in owned columns, of ``baij``; as long as the matrix lives.

    Raises
    ------
    AttributeError, OSError
        If the C library does not offer the calls.
    """

    def __init__(self, mat: PETSc.Mat, kind: str, pattern: BlockPattern, stored: StoredRows) -> None:
        library, name = ctypes.CDLL(PETSc.__file__), KINDS[kind]
        self._get = getattr(library, f"MatSeq{name}GetArray")
        self._give_back = getattr(library, f"MatSeq{name}RestoreArray")
        self._mat, self._stored = mat, stored
        self._rows = pattern.indptr, pattern.columns, stored.begin, stored.below
        self._sizes = 9 * int(stored.inside.sum()), 9 * int(stored.outside.sum())
        self._half, self._several = kind == "sbaij", mat.getComm().size > 1
        split = self._several and not self._half
        self._split = getattr(library, f"MatMPI{name}GetSeq{name}") if split else None
        self._fill = {"aij": _to_aij, "baij": _to_baij, "sbaij": _to_sbaij}[kind]
        self.shared: Array | None = None
        self.whole: Array | None = None
        if kind == "baij" or (self._half and not self._several):
            part = self._parts()[0]
            array = self._array(part, self._sizes[0]).reshape(-1, 3, 3)
            self._give_back(part, ctypes.byref(ctypes.c_void_p()))
            self.shared, self.whole = (array, None) if self._half else (None, array)

    def _array(self, part: ctypes.c_void_p, size: int) -> Array:
        pointer = ctypes.POINTER(ctypes.c_double)()
        self._get(part, ctypes.byref(pointer))
        return np.ctypeslib.as_array(pointer, (size,)) if size else np.empty(0)

    def write(self, values: Array) -> None:
        """Replace all entries by block rows (n_blocks, 3, 3), by ``shared`` where that is; collective."""
        if self.shared is None:
            self._copy(values)
        self._mat.assemble()

    def forget(self) -> None:
        """Let go of the memory of entries in owned columns, also of ``shared``; Linux only.

        They are 0 afterwards, and writing them takes memory again.
        """
        madvise = ctypes.CDLL(None).madvise
        madvise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
        diagonal = self._mat.getDiagonalBlock()
        part = ctypes.c_void_p(diagonal.handle)
        array = self._array(part, self._sizes[0])
        first = -(-array.ctypes.data // mmap.PAGESIZE) * mmap.PAGESIZE
        pages = (array.ctypes.data + array.nbytes - first) // mmap.PAGESIZE
        if pages > 0:
            madvise(first, pages * mmap.PAGESIZE, mmap.MADV_DONTNEED)
        self._give_back(part, ctypes.byref(ctypes.c_void_p()))

    def _parts(self) -> list[ctypes.c_void_p]:
        """This rank's matrices of entries in owned columns and in ghosts'; none where PETSc tells none."""
        whole = ctypes.c_void_p(self._mat.handle)
        if not self._several:
            return [whole]
        if self._split is None:
            return []
        inside, outside, columns = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_void_p()
        self._split(whole, ctypes.byref(inside), ctypes.byref(outside), ctypes.byref(columns))
        return [inside, outside]

    def _copy(self, values: Array) -> None:
        parts, diagonal = self._parts(), None
        if not parts:
            diagonal = self._mat.getDiagonalBlock()
            parts = [ctypes.c_void_p(diagonal.handle)]
        arrays = [self._array(part, size) for part, size in zip(parts, self._sizes, strict=False)]
        self._fill(*self._rows, values, *arrays, *[np.empty(0)] * (2 - len(arrays)))
        for part in parts:
            self._give_back(part, ctypes.byref(ctypes.c_void_p()))
        if diagonal is not None:
            self._stored.insert_outside(values, self._mat)
            diagonal.destroy()
