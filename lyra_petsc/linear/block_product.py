"""Products of symmetric block rows with vectors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lyra_petsc.arrays import Array, read_only
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.kernels.vectors import AHEAD, gather, scatter
from lyra_petsc.linear.pattern import BlockPattern

if TYPE_CHECKING:
    from lyra_petsc.linear.edge_couplings import ProductWithEdges


MAX_SCRATCH_ROWS = 20_000
"""Rows up to which scratch arrays are kept; allocating larger ones costs little beside the product, and
assembly needs the memory."""


@cached(fastmath={"contract", "nsz"})
def multiply_half(indptr, ends, columns, blocks, x, sums, out):  # type: ignore[no-untyped-def]
    """out (n_owned, 3) = A x for x (n_local, 3) and a symmetric matrix A of which one half is stored.

    ``blocks`` (n_blocks, 9): the first block of a row is the diagonal one; from ``ends`` (n_owned,) on the
    columns are ghosts, whose rows belong to other ranks. sums (n_owned, 4) is scratch.
    """
    n = Index(len(ends))
    sums[:] = 0.0
    for row in range(n):
        lo, hi = Index(indptr[row]), Index(indptr[row + Index(1)])
        s0, s1, s2 = gather(blocks, columns, x, lo, hi, AHEAD)
        scatter(blocks, columns, sums, lo + Index(1), Index(ends[row]), (x[row, 0], x[row, 1], x[row, 2]))
        # the rows before this one have added their transposed blocks to ``sums``
        out[row, 0], out[row, 1], out[row, 2] = s0 + sums[row, 0], s1 + sums[row, 1], s2 + sums[row, 2]


def make_product(pattern: BlockPattern, values: Array) -> HalfStoredProduct | ProductWithEdges:
    """A function ``(x, out)`` that multiplies by values (n_stored, 3, 3), of which it keeps a view."""
    if pattern.edge_couplings is None:
        return HalfStoredProduct(pattern, values)
    from lyra_petsc.linear.edge_couplings import ProductWithEdges  # only needed here

    return ProductWithEdges(pattern, values)


class HalfStoredProduct:
    """Products with symmetric block rows of which one half is stored.

    Parameters
    ----------
    pattern : BlockPattern
    values : (n_blocks, 3, 3)
    """

    def __init__(self, pattern: BlockPattern, values: Array) -> None:
        self._rows = pattern.indptr, pattern.ends, pattern.columns, values.reshape(-1, 9)
        self._shape = pattern.n_owned, 4
        self._kept = np.empty(self._shape) if pattern.n_owned <= MAX_SCRATCH_ROWS else None

    def __call__(self, x: Array, out: Array) -> None:
        """out (n_owned, 3) = A x for x (n_local, 3) with current ghost values."""
        sums = np.empty(self._shape) if self._kept is None else self._kept
        multiply_half(*self._rows, read_only(x), sums, out)
