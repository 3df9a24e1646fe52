"""The arrays in which a PETSc matrix keeps its entries, so that new values reach them in one pass.

petsc4py has no calls for them, the C library has. ``MatSetValues`` looks for every entry's place each time.
"""

from __future__ import annotations

import ctypes
import itertools

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.assembly.pattern import BlockPattern
from lyra_petsc.kernel_cache import cached
from lyra_petsc.partition.points import Points

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

KINDS = {"aij": "AIJ", "baij": "BAIJ", "sbaij": "SBAIJ"}
"""Matrix types whose storage is known here, as the C library spells them."""

PORTIONS = 16
"""In which entries go through ``MatSetValues``, for a copy of each is made."""


@cached()
def _to_sbaij(indptr, columns, values, inside):  # type: ignore[no-untyped-def]
    """Blocks of owned columns, column by column."""
    n, at = len(indptr) - 1, 0
    for row in range(n):
        for k in range(indptr[row], indptr[row + 1]):
            if columns[k] >= n:
                break
            v = values[k]
            for j in range(3):
                for i in range(3):
                    inside[at + 3 * j + i] = v[i, j]
            at += 9


@cached()
def _to_baij(indptr, columns, place, values, inside, outside):  # type: ignore[no-untyped-def]
    """Blocks column by column; those of owned columns apart from those of ghosts.

    ``place`` (n_owned,) is where each whole row begins; when a row's turn comes, all before its diagonal is
    there, put by the rows of those columns.
    """
    n, q = len(indptr) - 1, 0
    for row in range(n):
        at = 9 * place[row]
        for k in range(indptr[row], indptr[row + 1]):
            c, v = columns[k], values[k]
            if c >= n:
                for j in range(3):
                    for i in range(3):
                        outside[q + 3 * j + i] = v[i, j]
                q += 9
                continue
            for j in range(3):
                for i in range(3):
                    inside[at + 3 * j + i] = v[i, j]
            at += 9
            if c > row:
                other = 9 * place[c]
                for i in range(3):
                    for j in range(3):
                        inside[other + 3 * i + j] = v[i, j]
                place[c] += 1


@cached()
def _to_aij(indptr, columns, place, begin, values, inside, outside):  # type: ignore[no-untyped-def]
    """Three scalar rows for each row of blocks, otherwise as ``_to_baij``; ``begin`` (n_owned + 1,)."""
    n, q = len(indptr) - 1, 0
    for row in range(n):
        first, end = indptr[row], indptr[row + 1]
        ghosts = end - first
        for k in range(first, end):
            if columns[k] < n:
                ghosts -= 1
        at, beyond = 6 * begin[row] + 3 * place[row], 9 * q
        width = 3 * (begin[row + 1] - begin[row])
        for k in range(first, end):
            c, v = columns[k], values[k]
            if c >= n:
                for i in range(3):
                    for j in range(3):
                        outside[beyond + 3 * i * ghosts + j] = v[i, j]
                beyond += 3
                continue
            for i in range(3):
                for j in range(3):
                    inside[at + i * width + j] = v[i, j]
            at += 3
            if c > row:
                other = 6 * begin[c] + 3 * place[c]
                stride = 3 * (begin[c + 1] - begin[c])
                for j in range(3):
                    for i in range(3):
                        inside[other + j * stride + i] = v[i, j]
                place[c] += 1
        q += ghosts


@cached()
def _count(indptr, columns, whole, first, inside, outside):  # type: ignore[no-untyped-def]
    """Blocks of each row, whole or of the upper triangle; of the ghosts, those from number ``first`` on."""
    n = len(indptr) - 1
    for row in range(n):
        for k in range(indptr[row], indptr[row + 1]):
            c = columns[k]
            if c < n:
                inside[row] += 1
                if whole and c > row:
                    inside[c] += 1
            elif c >= first:
                outside[row] += 1


@cached()
def _index(indptr, columns, whole, first, place, column, block):  # type: ignore[no-untyped-def]
    """Column and block of all that ``_count`` counts; ``place`` (n_owned,) is where each row begins."""
    n = len(indptr) - 1
    for row in range(n):
        for k in range(indptr[row], indptr[row + 1]):
            c = columns[k]
            if c < n or c >= first:
                column[place[row]], block[place[row]] = c, k
                place[row] += 1
                if whole and row < c < n:
                    column[place[c]], block[place[c]] = row, ~k
                    place[c] += 1


class StoredRows:
    """Which blocks a PETSc matrix of a pattern keeps: the whole rows, or of ``sbaij`` the upper triangle.

    Parameters
    ----------
    points : Points
    pattern : BlockPattern
    kind : str

    Attributes
    ----------
    inside, outside : (n_owned,) int
        Blocks of each row in owned columns, and in columns of ghosts.
    """

    def __init__(self, points: Points, pattern: BlockPattern, kind: str) -> None:
        self._points, self._pattern, self._whole = points, pattern, kind != "sbaij"
        below = 0 if self._whole else int(np.searchsorted(points.ghosts, points.start))
        self._first = points.n_owned + below
        self.inside, self.outside = np.zeros((2, points.n_owned), dtype=PETSc.IntType)
        _count(pattern.indptr, pattern.columns, self._whole, self._first, self.inside, self.outside)

    def index(self) -> tuple[Ints, Ints, Ints]:
        """Compressed rows: indptr (n_owned + 1,), local columns (n,), blocks of the pattern (n,).

        ~k instead of k stands for the transpose of a block.
        """
        indptr = begins(self.inside + self.outside)
        column, block = np.empty((2, indptr[-1]), dtype=np.int64)
        indices = self._pattern.indptr, self._pattern.columns
        _index(*indices, self._whole, self._first, indptr[:-1].copy(), column, block)
        return indptr, column, block

    def insert(self, values: Array, mat: PETSc.Mat) -> None:
        """Set all entries by ``MatSetValues``; collective."""
        indptr, column, block = self.index()
        numbers = self._points.global_number
        edges = indptr[np.linspace(0, len(indptr) - 1, PORTIONS + 1).astype(np.int64)]
        for lo, hi in itertools.pairwise(edges):
            turned = block[lo:hi] < 0
            blocks = values[np.where(turned, ~block[lo:hi], block[lo:hi])]
            blocks[turned] = blocks[turned].transpose(0, 2, 1)
            # all rows, most of them empty: petsc4py takes no others
            begin = (np.clip(indptr, lo, hi) - lo).astype(PETSc.IntType)
            columns = numbers[column[lo:hi]].astype(PETSc.IntType)
            mat.setValuesBlockedCSR(begin, columns, blocks, PETSc.InsertMode.INSERT)
        mat.assemble()


def begins(counts: NDArray[np.int32]) -> Ints:
    """Where each row begins and the last ends, (n + 1,), of rows with ``counts`` (n,) blocks."""
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])


class Storage:
    """Writes block rows into the arrays of an assembled matrix.

    Parameters
    ----------
    mat : PETSc.Mat
        With the entries of the pattern and no others; assembled when it is written to.
    kind : str
        A key of ``KINDS``; on several ranks not ``sbaij``, which hides its second array.
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
        self._give_back = getattr(library, f"MatSeq{name}RestoreArray")
        self._several = mat.getComm().size > 1
        self._split = getattr(library, f"MatMPI{name}GetSeq{name}") if self._several else None
        self._mat, self._pattern, self._kind = mat, pattern, kind
        self._begin = begins(stored.inside)
        self._sizes = 9 * int(self._begin[-1]), 9 * int(stored.outside.sum())

    def write(self, values: Array) -> None:
        """Replace all entries by block rows ``values`` (n_blocks, 3, 3); collective."""
        whole = ctypes.c_void_p(self._mat.handle)
        parts = [whole]
        if self._split is not None:
            inside, outside, columns = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_void_p()
            self._split(whole, ctypes.byref(inside), ctypes.byref(outside), ctypes.byref(columns))
            parts = [inside, outside]
        pointers = [ctypes.POINTER(ctypes.c_double)() for _ in parts]
        arrays = [np.empty(0), np.empty(0)]  # on one rank there is no outside
        for number, (part, pointer) in enumerate(zip(parts, pointers, strict=True)):
            self._get(part, ctypes.byref(pointer))
            if self._sizes[number]:
                arrays[number] = np.ctypeslib.as_array(pointer, (self._sizes[number],))
        indices, begin = (self._pattern.indptr, self._pattern.columns), self._begin
        if self._kind == "sbaij":
            _to_sbaij(*indices, values, arrays[0])
        elif self._kind == "baij":
            _to_baij(*indices, begin[:-1].copy(), values, *arrays)
        else:
            _to_aij(*indices, begin[:-1].copy(), begin, values, *arrays)
        for part, pointer in zip(parts, pointers, strict=True):
            self._give_back(part, ctypes.byref(pointer))
        self._mat.assemble()
