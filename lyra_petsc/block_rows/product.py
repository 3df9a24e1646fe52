"""Products of block rows with vectors."""

from __future__ import annotations

from lyra_petsc.block_rows.vectors import AHEAD, gather, scatter
from lyra_petsc.kernel_cache import Index, cached


@cached(fastmath={"contract", "nsz"})
def half_stored(indptr, ends, columns, blocks, x, sums, out):  # type: ignore[no-untyped-def]
    """out (n_owned, 3) = rows · x (n_local, 3) of a symmetric matrix of which one half is stored.

    The first block (n_blocks, 9) of a row is the diagonal one; from ``ends`` (n_owned,) on they are in
    columns of ghosts, whose rows are others'. sums (n_owned, 4) is scratch.
    """
    n = Index(len(ends))
    sums[:] = 0.0
    for row in range(n):
        lo, hi = Index(indptr[row]), Index(indptr[row + Index(1)])
        s0, s1, s2 = gather(blocks, columns, x, lo, hi, AHEAD)
        scatter(blocks, columns, sums, lo + Index(1), Index(ends[row]), (x[row, 0], x[row, 1], x[row, 2]))
        # the rows above have done their part
        out[row, 0], out[row, 1], out[row, 2] = s0 + sums[row, 0], s1 + sums[row, 1], s2 + sums[row, 2]


@cached(fastmath={"contract", "nsz"})
def whole(indptr, columns, blocks, x, out):  # type: ignore[no-untyped-def]
    """out (n, 3) = rows of blocks (n_blocks, 9), all of which are stored, times x."""
    for row in range(Index(len(indptr) - 1)):
        lo, hi = Index(indptr[row]), Index(indptr[row + Index(1)])
        out[row, 0], out[row, 1], out[row, 2] = gather(blocks, columns, x, lo, hi, AHEAD)
