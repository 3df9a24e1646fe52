"""Addition of element blocks to block rows at the ``offsets`` of the pattern.

The offsets of an element are those of its pairs of points (0, 0), (0, 1), …, (n − 1, n − 1): twice the number
of the block to which the pair is added, plus 1 if it is added transposed; negative if another rank stores the
block. Offsets of edge unknowns are from ``edge_couplings.offsets_of``.
"""

from __future__ import annotations

from lyra_petsc.kernels.cache import cached, inner
from lyra_petsc.kernels.vectors import fetch

AHEAD = 8
"""Number of elements by which prefetching runs ahead: blocks of neighbouring elements are far apart in
memory."""


@inner(forceinline=True)
def fetch_ahead(element, offsets, values, n_pairs, ahead=AHEAD):  # type: ignore[no-untyped-def]
    """Prefetch the blocks of a later element with offsets (E, n_pairs) into the caches."""
    later = min(element + ahead, offsets.shape[0] - 1)
    for pair in range(n_pairs):  # a constant for the compiler
        fetch(values, offsets[later, pair] >> 1)


@inner(fastmath={"contract", "nsz"})
def add_element(weight, blocks, offsets, values):  # type: ignore[no-untyped-def]
    """Add weight times the blocks (n, n, 3, 3) of one element to values (n_blocks, 3, 3)."""
    pair = 0
    for a in range(blocks.shape[0]):
        for b in range(a, blocks.shape[0]):
            at = offsets[pair]
            pair += 1
            if at >= 0:
                row, column = (b, a) if at & 1 else (a, b)
                for i in range(3):
                    for j in range(3):
                        values[at >> 1, i, j] += weight * blocks[row, column, i, j]


@cached(fastmath={"contract", "nsz"})
def add_elements(weight, blocks, offsets, values):  # type: ignore[no-untyped-def]
    """Add weight (E,) times the blocks (E, n, n, 3, 3) of elements with offsets (E, n (n + 1) / 2)."""
    for e in range(offsets.shape[0]):
        fetch_ahead(e, offsets, values, offsets.shape[1])
        add_element(weight[e], blocks[e], offsets[e], values)


@cached(fastmath={"contract", "nsz"})
def add_mixed_elements(weight, blocks, n, corners, offsets, values):  # type: ignore[no-untyped-def]
    """Add weight (E,) times the Hessians (E, 3 n + m, 3 n + m) of elements of n vertices and m edge unknowns.

    ``corners`` are offsets of pairs of vertices, ``offsets`` those of all other pairs.
    """
    flat, m = values.reshape(-1), blocks.shape[1] - 3 * n
    for e in range(offsets.shape[0]):
        corner = pair = 0
        for a in range(n + m):
            for b in range(a, n + m):
                if b < n:
                    at = corners[e, corner]
                    corner += 1
                else:
                    at = offsets[e, pair]
                    pair += 1
                if at < 0:
                    continue
                if a >= n:
                    flat[at] += weight[e] * blocks[e, 2 * n + a, 2 * n + b]
                    continue
                for i in range(3):
                    if b >= n:
                        flat[(at >> 2) + i * ((at & 3) + 1)] += weight[e] * blocks[e, 3 * a + i, 2 * n + b]
                        continue
                    for j in range(3):
                        p, q = (j, i) if at & 1 else (i, j)
                        values[at >> 1, p, q] += weight[e] * blocks[e, 3 * a + i, 3 * b + j]
