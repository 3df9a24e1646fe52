"""Direct access to the arrays of a PETSc matrix, so that new values are written in one pass.

``MatSetValues`` would search for the position of each entry every time. The arrays are obtained by calls of
the C library, which petsc4py does not offer.
"""

from __future__ import annotations

import ctypes
import itertools

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import cached
from lyra_petsc.kernels.vectors import store_block
from lyra_petsc.linear.pattern import BlockPattern, index_type, row_pointers
from lyra_petsc.mesh.points import Points

KINDS = {"aij": "AIJ", "baij": "BAIJ"}
"""Matrix types whose arrays can be written, with their names in the C library."""

PORTIONS = 16
"""Number of portions in which transposed blocks are copied for ``MatSetValues``, to limit the memory."""


@cached(inline="always")
def _put(blocks, k, out, at, row_stride, column_stride):  # type: ignore[no-untyped-def]
    """Copy block k to ``out`` from index ``at`` on, with these strides of its rows and columns."""
    for i in range(3):
        for j in range(3):
            out[at + row_stride * i + column_stride * j] = blocks[k, 3 * i + j]


@cached()
def _to_baij(indptr, columns, begin, lower, blocks, inside, outside):  # type: ignore[no-untyped-def]
    """Fill the arrays (n, 9) of a BAIJ matrix, blocks column by column; ghost columns are separate."""
    n, p, q = len(indptr) - 1, 0, 0
    for row in range(n):
        for t in range(begin[row], begin[row + 1]):
            store_block(blocks, lower[t], inside, 2 * p + 1)
            p += 1
        for k in range(indptr[row], indptr[row + 1]):
            if columns[k] < n:
                store_block(blocks, k, inside, 2 * p)
                p += 1
            else:
                store_block(blocks, k, outside, 2 * q)
                q += 1


@cached()
def _to_aij(indptr, columns, begin, lower, blocks, inside, outside):  # type: ignore[no-untyped-def]
    """Fill the arrays of an AIJ matrix, three scalar rows a block row; ghost columns are separate."""
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
            _put(blocks, lower[t], inside, at, width, 1)
            at += 3
        for k in range(indptr[row], indptr[row + 1]):
            if columns[k] < n:
                _put(blocks, k, inside, at, 1, width)
                at += 3
        at = q
        for k in range(indptr[row], indptr[row + 1]):
            if columns[k] >= n:
                _put(blocks, k, outside, at, 1, beyond)
                at += 3
        p += 3 * width
        q += 3 * beyond


@cached()
def _transposes(indptr, columns, place, lower):  # type: ignore[no-untyped-def]
    """lower = blocks of the upper triangle ordered by columns; ``place`` (n_owned,) is where each begins."""
    n = len(indptr) - 1
    for row in range(n):
        for k in range(indptr[row] + 1, indptr[row + 1]):
            c = columns[k]
            if c < n:
                lower[place[c]] = k
                place[c] += 1


class StoredRows:
    """The rows that a PETSc matrix of a pattern stores: full rows, or with ``sbaij`` the upper triangle.

    Parameters
    ----------
    points : Points
    pattern : BlockPattern
    kind : str

    Attributes
    ----------
    inside, outside : (n_owned,) int
        Blocks of each row in owned columns, and in columns of ghosts.
    begin, lower : (n_owned + 1,) int64, (n_lower,) int
        Compressed rows of the lower triangle: blocks of the pattern that must be transposed.
    """

    def __init__(self, points: Points, pattern: BlockPattern, kind: str) -> None:
        self._points, self._pattern = points, pattern
        n, indptr, columns = points.n_owned, pattern.indptr, pattern.columns
        own = columns < n
        self._kept = np.ones(len(columns), dtype=bool)
        if kind == "sbaij":
            self.begin, self.lower = np.zeros(n + 1, dtype=np.int64), np.empty(0, dtype=np.int32)
            self._kept[~own] = points.ghosts[columns[~own] - n] > points.start
        else:
            self.begin = row_pointers(np.bincount(columns[own], minlength=n) - 1)
            self.lower = np.empty(self.begin[-1], dtype=index_type(len(columns)))
            _transposes(indptr, columns, self.begin[:-1].copy(), self.lower)
        self.inside = (np.diff(self.begin) + _per_row(own, indptr)).astype(PETSc.IntType)
        self.outside = _per_row(self._kept & ~own, indptr).astype(PETSc.IntType)

    def insert(self, values: Array, mat: PETSc.Mat) -> None:
        """Set all entries by ``MatSetValues``; collective."""
        indptr, columns, kept = self._pattern.indptr, self._pattern.columns, self._kept
        numbers = self._points.global_number
        if not kept.all():
            columns, values, indptr = columns[kept], values[kept], row_pointers(_per_row(kept, indptr))
        _set(mat, indptr, numbers[columns], values)
        edges = np.linspace(0, len(self.lower), PORTIONS + 1).astype(np.int64)
        for lo, hi in itertools.pairwise(edges):
            part = self.lower[lo:hi]
            rows = np.searchsorted(self._pattern.indptr, part, side="right") - 1
            # petsc4py requires all rows, most of which are empty here
            _set(mat, np.clip(self.begin, lo, hi) - lo, numbers[rows], values[part].transpose(0, 2, 1))
        mat.assemble()


def _set(mat: PETSc.Mat, indptr: Ints, columns: Ints, blocks: Array) -> None:
    indices = indptr.astype(PETSc.IntType), columns.astype(PETSc.IntType)
    mat.setValuesBlockedCSR(*indices, np.ascontiguousarray(blocks), PETSc.InsertMode.INSERT)


def _per_row(flags: NDArray[np.bool_], indptr: Ints) -> Ints:
    """Number of flagged blocks, flags (n_blocks,), in each row."""
    counts: Ints = np.diff(row_pointers(flags)[indptr])
    return counts


class Storage:
    """Writes block rows into the arrays of an assembled matrix.

    Parameters
    ----------
    mat : PETSc.Mat
        Assembled with exactly the entries of the pattern. Ghosts must ascend, as PETSc's columns do.
    kind : str
        A key of ``KINDS``.
    pattern : BlockPattern
    stored : StoredRows

    Raises
    ------
    AttributeError, OSError
        If the C library does not offer the calls.
    """

    def __init__(self, mat: PETSc.Mat, kind: str, pattern: BlockPattern, stored: StoredRows) -> None:
        library, name = ctypes.CDLL(PETSc.__file__), KINDS[kind]
        self._get = getattr(library, f"MatSeq{name}GetArray")
        self._restore = getattr(library, f"MatSeq{name}RestoreArray")
        self._mat = mat
        self._rows = pattern.indptr, pattern.columns, stored.begin, stored.lower
        self._sizes = 9 * int(stored.inside.sum()), 9 * int(stored.outside.sum())
        self._split = (
            getattr(library, f"MatMPI{name}GetSeq{name}") if mat.getType().startswith("mpi") else None
        )
        self._fill, self._shape = {"aij": (_to_aij, (-1,)), "baij": (_to_baij, (-1, 9))}[kind]

    def write(self, values: Array) -> None:
        """Replace all entries by block rows (n_blocks, 3, 3); collective."""
        parts = self._parts()
        arrays = [self._array(part, size) for part, size in zip(parts, self._sizes, strict=False)]
        arrays += [np.empty(0)] * (2 - len(arrays))
        self._fill(*self._rows, values.reshape(-1, 9), *(array.reshape(self._shape) for array in arrays))
        for part in parts:
            self._restore(part, ctypes.byref(ctypes.c_void_p()))
        self._mat.assemble()

    def _array(self, part: ctypes.c_void_p, size: int) -> Array:
        pointer = ctypes.POINTER(ctypes.c_double)()
        self._get(part, ctypes.byref(pointer))
        return np.ctypeslib.as_array(pointer, (size,)) if size else np.empty(0)

    def _parts(self) -> list[ctypes.c_void_p]:
        """This rank's sequential matrices of owned and of ghost columns."""
        whole = ctypes.c_void_p(self._mat.handle)
        if self._split is None:
            return [whole]
        inside, outside, columns = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_void_p()
        self._split(whole, ctypes.byref(inside), ctypes.byref(outside), ctypes.byref(columns))
        return [inside, outside]
