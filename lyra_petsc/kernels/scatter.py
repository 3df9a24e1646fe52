"""Element blocks added to block rows, where the ``offsets`` of the pattern say.

An element's offsets are those of its pairs of points (0, 0), (0, 1), …, (n − 1, n − 1): twice the number of
the block that the pair is added to, plus 1 where it is added transposed; negative where others have it.
"""

from __future__ import annotations

from lyra_petsc.kernels.cache import cached
from lyra_petsc.kernels.vectors import fetch

AHEAD = 8
"""Elements by which blocks are fetched before they are added to: neighbours' lie far apart in memory."""


@cached(forceinline=True)
def fetch_ahead(element, offsets, values, n_pairs, ahead=AHEAD):  # type: ignore[no-untyped-def]
    """Let the blocks of a later element with offsets (E, n_pairs) come into the caches."""
    later = min(element + ahead, offsets.shape[0] - 1)
    for pair in range(n_pairs):  # which compilers know where it is written down
        fetch(values, offsets[later, pair] >> 1)


@cached(fastmath={"contract", "nsz"})
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
def add_mixed_elements(weight, blocks, vertices, edges, offsets, values):  # type: ignore[no-untyped-def]
    """Add weight (E,) times the Hessians (E, 3 n + m, 3 n + m) of elements of n vertices and m edge unknowns.

    ``vertices`` (E, n) are rows, ``edges`` (E, m) places in the flat form of arrays over rows; offsets are
    those of the pairs of n + m rows, of which several may be one and the same.
    """
    n, m = vertices.shape[1], edges.shape[1]
    for e in range(offsets.shape[0]):
        pair = 0
        for a in range(n + m):
            first_a, size_a = (3 * a, 3) if a < n else (2 * n + a, 1)
            row_a, at_a = (vertices[e, a], 0) if a < n else (edges[e, a - n] // 3, edges[e, a - n] % 3)
            for b in range(a, n + m):
                first_b, size_b = (3 * b, 3) if b < n else (2 * n + b, 1)
                row_b, at_b = (vertices[e, b], 0) if b < n else (edges[e, b - n] // 3, edges[e, b - n] % 3)
                at = offsets[e, pair]
                pair += 1
                if at < 0:
                    continue
                for i in range(size_a):
                    for j in range(size_b):
                        value = weight[e] * blocks[e, first_a + i, first_b + j]
                        p, q = at_a + i, at_b + j
                        # values of a block stand column by column
                        if at & 1:
                            values[at >> 1, q, p] += value
                        else:
                            values[at >> 1, p, q] += value
                            if a != b and row_a == row_b:
                                values[at >> 1, q, p] += value
