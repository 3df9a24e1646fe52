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
                for i in range(3):
                    for j in range(3):
                        inside[9 * p + 3 * (i * n_in + a) + j] = values[k, i, j]
                a += 1
            else:
                for i in range(3):
                    for j in range(3):
                        outside[9 * q + 3 * (i * n_out + b) + j] = values[k, i, j]
                b += 1
        p += n_in
        q += n_out


class Storage:
    """Writes block rows into the arrays of an assembled matrix.

    Parameters
    ----------
    mat : PETSc.Mat
        Assembled, with the entries of the pattern and no others.
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
        self._library = ctypes.CDLL(PETSc.__file__)
        self._name, self._mat = KINDS[kind], mat
        self._get = getattr(self._library, f"MatSeq{self._name}GetArray")
        self._give_back = getattr(self._library, f"MatSeq{self._name}RestoreArray")
        self._parts = getattr(self._library, f"MatMPI{self._name}GetSeq{self._name}")
        self._pattern, self._n_owned = pattern, n_owned
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
        for part, pointer in zip(parts, pointers, strict=True):
            self._get(part, ctypes.byref(pointer))
        arrays = [
            np.ctypeslib.as_array(pointer, (size,)) if size else np.empty(0)
            for pointer, size in zip(pointers, self._sizes, strict=False)
        ]
        outside_array = arrays[1] if len(arrays) > 1 else np.empty(0)
        self._fill(
            self._pattern.indptr, self._pattern.columns, self._n_owned, values, arrays[0], outside_array
        )
        for part, pointer in zip(parts, pointers, strict=True):
            self._give_back(part, ctypes.byref(pointer))
        self._mat.assemble()
