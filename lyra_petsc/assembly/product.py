"""Products of half-stored symmetric block rows with vectors, also as the ``MatMult`` of a PETSc matrix.

PETSc's own for ``sbaij`` fetches each block past the caches, in which it takes two to three times as long.
"""

from __future__ import annotations

import ctypes
import sys

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.assembly.pattern import BlockPattern
from lyra_petsc.kernel_cache import cached
from lyra_petsc.partition.points import Points

Array = NDArray[np.float64]

MATOP_MULT = 3
"""Number of the operation in PETSc's ``petscmat.h``."""

ERR_LIB = 76
"""PETSc's error code for what a library of the user's does wrong."""

_Operation = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


@cached()
def product(indptr, columns, values, x, out):  # type: ignore[no-untyped-def]
    """out (n_owned, 3) = whole rows · x (n_local, 3); ``out`` is 0 before."""
    n = len(indptr) - 1
    for row in range(n):
        first = indptr[row]
        d, y0, y1, y2 = values[first], x[row, 0], x[row, 1], x[row, 2]
        s0 = d[0, 0] * y0 + d[1, 0] * y1 + d[2, 0] * y2
        s1 = d[0, 1] * y0 + d[1, 1] * y1 + d[2, 1] * y2
        s2 = d[0, 2] * y0 + d[1, 2] * y1 + d[2, 2] * y2
        for k in range(first + 1, indptr[row + 1]):
            c, v = columns[k], values[k]
            x0, x1, x2 = x[c, 0], x[c, 1], x[c, 2]
            v00, v01, v02 = v[0, 0], v[0, 1], v[0, 2]
            v10, v11, v12 = v[1, 0], v[1, 1], v[1, 2]
            v20, v21, v22 = v[2, 0], v[2, 1], v[2, 2]
            s0 += v00 * x0 + v10 * x1 + v20 * x2
            s1 += v01 * x0 + v11 * x1 + v21 * x2
            s2 += v02 * x0 + v12 * x1 + v22 * x2
            if c < n:
                out[c, 0] += v00 * y0 + v01 * y1 + v02 * y2
                out[c, 1] += v10 * y0 + v11 * y1 + v12 * y2
                out[c, 2] += v20 * y0 + v21 * y1 + v22 * y2
        out[row, 0] += s0
        out[row, 1] += s1
        out[row, 2] += s2


class MatMult:
    """Lets a matrix multiply by ``values``, which must be its own; kept as long as the matrix.

    Parameters
    ----------
    mat : PETSc.Mat
    points : Points
    pattern : BlockPattern
    values : (n_blocks, 3, 3)

    Raises
    ------
    AttributeError, OSError
        If the C library does not offer the calls.
    """

    def __init__(self, mat: PETSc.Mat, points: Points, pattern: BlockPattern, values: Array) -> None:
        library = ctypes.CDLL(PETSc.__file__)
        self._read, self._read_ended = library.VecGetArrayRead, library.VecRestoreArrayRead
        self._write, self._write_ended = library.VecGetArray, library.VecRestoreArray
        self._points, self._rows, self._values = points, (pattern.indptr, pattern.columns), values
        self._size = ctypes.c_double * (3 * points.n_owned)
        self._local = np.zeros((points.n_local, 3)) if points.comm.size > 1 else None
        self._operations = 2.0 * 9.0 * pattern.n_couplings
        self._callback = _Operation(self._mult)
        self._handle, usual = int(mat.handle), ctypes.c_void_p()
        library.MatGetOperation(ctypes.c_void_p(mat.handle), MATOP_MULT, ctypes.byref(usual))
        self._usual = ctypes.cast(usual, _Operation)
        library.MatSetOperation(ctypes.c_void_p(mat.handle), MATOP_MULT, self._callback)

    def _mult(self, mat: int, x: int, y: int) -> int:
        """y = A x; collective. Its result is PETSc's error code."""
        if mat != self._handle:  # a copy, which has taken this operation along but has its own values
            return int(self._usual(mat, x, y))
        source, target = ctypes.c_void_p(x), ctypes.c_void_p(y)
        begin, end = ctypes.c_void_p(), ctypes.c_void_p()
        try:
            self._read(source, ctypes.byref(begin))
            self._write(target, ctypes.byref(end))
            self._product(self._array(begin), self._array(end))
            self._write_ended(target, ctypes.byref(end))
            self._read_ended(source, ctypes.byref(begin))
            PETSc.Log.logFlops(self._operations)
        except Exception as error:  # it cannot pass through C
            sys.stderr.write(f"product of the matrix with a vector: {error!r}\n")
            return ERR_LIB
        return 0

    def _array(self, pointer: ctypes.c_void_p) -> Array:
        if pointer.value is None:  # of no rows
            return np.empty((0, 3))
        return np.ctypeslib.as_array(self._size.from_address(pointer.value)).reshape(-1, 3)

    def _product(self, x: Array, y: Array) -> None:
        if self._local is not None:
            self._local[: len(x)] = x
            self._points.update_ghosts(self._local)
            x = self._local
        y[:] = 0.0
        product(*self._rows, self._values, x, y)
