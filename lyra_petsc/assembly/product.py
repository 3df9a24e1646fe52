"""Products of block rows with vectors as the ``MatMult`` of a PETSc matrix.

PETSc's own for ``sbaij`` fetches each block past the caches, in which it takes two to three times as long;
that for ``baij`` works number by number, and takes twice as long in the caches.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.assembly.pattern import BlockPattern
from lyra_petsc.block_rows.product import half_stored, whole
from lyra_petsc.partition.points import Points

Array = NDArray[np.float64]

MATOP_MULT = 3
"""Number of the operation in PETSc's ``petscmat.h``."""

ERR_LIB = 76
"""PETSc's error code for what a library of the user's does wrong."""

MOST_VECTORS = 64
"""Vectors whose arrays are remembered."""

MOST_KEPT = 20_000
"""Rows up to which scratch is kept; more of it is got quickly enough, and assembly needs the room."""

_Operation = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


Multiply = Callable[[Array, Array], None]
"""Puts into its second argument (n_owned, 3) the product with its first (n_local, 3)."""


class HalfStored:
    """Products with block rows of which one half is stored.

    Parameters
    ----------
    pattern : BlockPattern
    values : (n_blocks, 3, 3)
    """

    def __init__(self, pattern: BlockPattern, values: Array) -> None:
        self._rows = pattern.indptr, pattern.ends, pattern.columns, values.reshape(-1, 9)
        self._shape = pattern.n_owned, 4
        self._kept = np.empty(self._shape) if pattern.n_owned <= MOST_KEPT else None

    def __call__(self, x: Array, out: Array) -> None:
        sums = np.empty(self._shape) if self._kept is None else self._kept
        half_stored(*self._rows, x, sums, out)


class Whole:
    """Products with all blocks of the rows of a matrix of one rank.

    Parameters
    ----------
    mat : PETSc.Mat
        Of type ``seqbaij``.
    values : (n_blocks, 3, 3)
        Its array.
    """

    def __init__(self, mat: PETSc.Mat, values: Array) -> None:
        indptr, columns = mat.getRowIJ(compressed=True)
        self._rows = indptr.astype(np.int64), columns.astype(np.int32), values.reshape(-1, 9)

    def __call__(self, x: Array, out: Array) -> None:
        whole(*self._rows, x, out)


class MatMult:
    """Lets a matrix multiply by ours; kept as long as the matrix.

    Parameters
    ----------
    mat : PETSc.Mat
    multiply : Multiply
        By the values of this matrix.
    couplings : int
        Blocks that are multiplied, for PETSc's count of operations.
    points : Points or None
        Whose ghosts a product takes; None: it takes none.

    Raises
    ------
    AttributeError, OSError
        If the C library does not offer the calls.
    """

    def __init__(
        self, mat: PETSc.Mat, multiply: Multiply, couplings: int, points: Points | None = None
    ) -> None:
        library = ctypes.CDLL(PETSc.__file__)
        self._read, self._read_ended = library.VecGetArrayRead, library.VecRestoreArrayRead
        self._write, self._write_ended = library.VecGetArray, library.VecRestoreArray
        for call in (self._read, self._read_ended, self._write, self._write_ended):
            call.argtypes = ctypes.c_void_p, ctypes.c_void_p
        self._begin, self._end = ctypes.c_void_p(), ctypes.c_void_p()
        self._at_begin, self._at_end = ctypes.addressof(self._begin), ctypes.addressof(self._end)
        self._multiply = multiply
        self._size = ctypes.c_double * mat.getLocalSize()[0]
        self._seen: dict[int | None, Array] = {None: np.empty((0, 3))}  # of no rows
        self._points = points
        n_local = points.n_local if points is not None else 0
        self._local = np.empty((n_local, 3)) if n_local <= MOST_KEPT else None
        self._operations = 2.0 * 9.0 * couplings
        self._callback = _Operation(self._mult)
        self._handle, usual = int(mat.handle), ctypes.c_void_p()
        library.MatGetOperation(ctypes.c_void_p(mat.handle), MATOP_MULT, ctypes.byref(usual))
        self._usual = ctypes.cast(usual, _Operation)
        library.MatSetOperation(ctypes.c_void_p(mat.handle), MATOP_MULT, self._callback)

    def _mult(self, mat: int, x: int, y: int) -> int:
        """y = A x; collective where there are ghosts. Its result is PETSc's error code."""
        if mat != self._handle:  # a copy, which has taken this operation along but has its own values
            return int(self._usual(mat, x, y))
        try:
            self._read(x, self._at_begin)
            self._write(y, self._at_end)
            self._multiply(self._with_ghosts(self._array(self._begin.value)), self._array(self._end.value))
            self._write_ended(y, self._at_end)
            self._read_ended(x, self._at_begin)
            PETSc.Log.logFlops(self._operations)
        except Exception as error:  # it cannot pass through C
            sys.stderr.write(f"product of the matrix with a vector: {error!r}\n")
            return ERR_LIB
        return 0

    def _array(self, address: int | None) -> Array:
        """The array (n_owned, 3) that stands there; a solver has few, which are made once."""
        found = self._seen.get(address)
        if found is None:
            if len(self._seen) > MOST_VECTORS:
                self._seen = {None: self._seen[None]}
            assert address is not None
            found = np.ctypeslib.as_array(self._size.from_address(address)).reshape(-1, 3)
            self._seen[address] = found
        return found

    def _with_ghosts(self, x: Array) -> Array:
        if self._points is None:
            return x
        local = np.empty((self._points.n_local, 3)) if self._local is None else self._local
        local[: len(x)] = x
        self._points.update_ghosts(local)
        return local
