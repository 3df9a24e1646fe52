"""The arrays in which a PETSc matrix keeps its entries, so that new values reach them in one pass.

petsc4py has no calls for them, the C library has. ``MatSetValues`` looks for every entry's place each time.
"""

from __future__ import annotations

import ctypes

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.assembly.pattern import BlockPattern
from lyra_petsc.kernel_cache import cached

Array = NDArray[np.float64]

KINDS = {"aij": "AIJ", "baij": "BAIJ"}
"""Matrix types whose storage is known here, as the C library spells them."""


@cached()
def _to_baij(indptr, columns, n_owned, values, inside, outside):  # type: ignore[no-untyped-def]
    """Blocks column by column; those of owned columns apart from those of ghosts."""
    p = q = 0
    for row in range(len(indptr) - 1):
        for k in range(indptr[row], indptr[row + 1]):
            own = columns[k] < n_owned
            out, at = (inside, 9 * p) if own else (outside, 9 * q)
            for i in range(3):
                for j in range(3):
                    out[at + 3 * j + i] = values[k, i, j]
            if own:
                p += 1
            else:
                q += 1


@cached()
def _to_aij(indptr, columns, n_owned, values, inside, outside):  # type: ignore[no-untyped-def]
    """Three scalar rows for each row of blocks; owned columns apart from ghosts."""
    p = q = 0
    for row in range(len(indptr) - 1):
        n_in = 0
        for k in range(indptr[row], indptr[row + 1]):
            n_in += columns[k] < n_owned
        n_out = indptr[row + 1] - indptr[row] - n_in
        a = b = 0
        for k in range(indptr[row], indptr[row + 1]):
            if columns[k] < n_owned:
                out, at, width = inside, 9 * p + 3 * a, n_in
                a += 1
            else:
                out, at, width = outside, 9 * q + 3 * b, n_out
                b += 1
            for i in range(3):
                for j in range(3):
                    out[at + 3 * i * width + j] = values[k, i, j]
        p += n_in
        q += n_out


class Storage:
    """Writes block rows into the arrays of an assembled matrix.

    Parameters
    ----------
    mat : PETSc.Mat
        With the entries of the pattern and no others; assembled when it is written to.
    kind : str
        A key of ``KINDS``.
    pattern : BlockPattern
    n_owned : int

    Raises
    ------
    AttributeError, OSError
        If the C library does not offer the calls.
    """

    def __init__(self, mat: PETSc.Mat, kind: str, pattern: BlockPattern, n_owned: int) -> None:
        library, name = ctypes.CDLL(PETSc.__file__), KINDS[kind]
        self._get = getattr(library, f"MatSeq{name}GetArray")
        self._give_back = getattr(library, f"MatSeq{name}RestoreArray")
        self._parts = getattr(library, f"MatMPI{name}GetSeq{name}")
        self._mat, self._pattern, self._n_owned = mat, pattern, n_owned
        self._fill = _to_aij if kind == "aij" else _to_baij
        own = int(np.count_nonzero(pattern.columns < n_owned))
        self._sizes = 9 * own, 9 * (pattern.n_blocks - own)

    def write(self, values: Array) -> None:
        """Replace all entries by block rows ``values`` (n_blocks, 3, 3); collective."""
        whole = ctypes.c_void_p(self._mat.handle)
        parts = [whole]
        if self._mat.getComm().size > 1:
            inside, outside, columns = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_void_p()
            self._parts(whole, ctypes.byref(inside), ctypes.byref(outside), ctypes.byref(columns))
            parts = [inside, outside]
        pointers = [ctypes.POINTER(ctypes.c_double)() for _ in parts]
        arrays = [np.empty(0), np.empty(0)]  # on one rank there is no outside
        for number, (part, pointer) in enumerate(zip(parts, pointers, strict=True)):
            self._get(part, ctypes.byref(pointer))
            if self._sizes[number]:
                arrays[number] = np.ctypeslib.as_array(pointer, (self._sizes[number],))
        self._fill(self._pattern.indptr, self._pattern.columns, self._n_owned, values, *arrays)
        for part, pointer in zip(parts, pointers, strict=True):
            self._give_back(part, ctypes.byref(pointer))
        self._mat.assemble()
