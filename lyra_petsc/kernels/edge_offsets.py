"""Where the couplings of elements with unknowns of edges stand, in one byte each.

In the flat form of values, of a vertex and an edge four times the place of the first of three numbers, plus
how far apart they are, less one; of two edges the place of their number. What a vertex or an edge couples
with stands together, so that a byte tells which of these it is, but for elements that also touch other ranks'
rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel, leaf

FAR = 255
"""In place of the first byte of an element whose offsets are among ``far``."""


@leaf()
def _find_far(which, far, e, out, at):  # type: ignore[no-untyped-def]
    lo, hi = 0, len(which)
    while hi - lo > 1:
        middle = (lo + hi) // 2
        if which[middle] <= e:
            lo = middle
        else:
            hi = middle
    for pair in range(15):
        out[at + pair] = far[lo, pair]


@kernel()
def find_of_triangles(  # type: ignore[no-untyped-def]
    vertices, edges, first_group, first_number, near, which, far, firsts, first, n, out
):
    """Put the offsets of n triangles, from one on, into ``out``; the last fills it."""
    groups, numbers, places, last = firsts[0], firsts[1], firsts[2], len(near) - 1
    for number in range(n if last >= 0 else 0):
        e, at = Index(min(first + number, last)), Index(15 * number)
        if near[e, 0] == FAR:
            _find_far(which, far, e, out, at)
            continue
        for a in range(3):
            begin = groups + 12 * first_group[Index(vertices[e, a])]
            for b in range(3):
                pair = Index(3 * a + b)
                out[at + pair] = 4 * (begin + near[e, pair]) + 3
        p, q, r = edges[e, 0], edges[e, 1], edges[e, 2]
        i = numbers + first_number[Index(p - places)]
        j = numbers + first_number[Index(q - places)]
        k = numbers + first_number[Index(r - places)]
        out[at + Index(9)] = i
        out[at + Index(10)] = (i if p < q else j) + near[e, 10]
        out[at + Index(11)] = (i if p < r else k) + near[e, 11]
        out[at + Index(12)] = j
        out[at + Index(13)] = (j if q < r else k) + near[e, 13]
        out[at + Index(14)] = k


class EdgeOffsets(NamedTuple):
    """Offsets of the pairs (a, b), b ≥ a, of the vertices and edges of E elements in which b is an edge.

    −1 where other ranks have both. Edges come after vertices.

    Attributes
    ----------
    vertices, edges : (E, n), (E, m) int32
        Local rows, and places in the flat form of arrays over these.
    first_group, first_number : (N + 1,), (M + 1,)
        Of vertices and of edges, see ``edge_couplings``.
    near : (E, n m + m (m + 1) / 2) uint8
        How far behind a vertex' first number, or that of the lesser edge.
    which, far : (k,), (k, n m + m (m + 1) / 2)
        Elements, ascending, whose first byte is FAR, and their offsets.
    firsts : (3,)
        Places of the first group and of the first number in values, and that of the first edge.
    """

    vertices: NDArray[np.int32]
    edges: NDArray[np.int32]
    first_group: NDArray[Any]
    first_number: NDArray[Any]
    near: NDArray[np.uint8]
    which: NDArray[np.int64]
    far: NDArray[np.int64]
    firsts: NDArray[np.int64]

    def begins(self, part: slice) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """From where on in values ``near`` counts, of vertices and of edges; elsewhere some number."""
        vertex = np.minimum(self.vertices[part], len(self.first_group) - 1)
        one, other = np.triu_indices(self.edges.shape[1])
        edge = np.minimum(self.edges[part][:, one], self.edges[part][:, other]) - self.firsts[2]
        group = self.firsts[0] + 12 * self.first_group[vertex].astype(np.int64)
        number = self.first_number[np.minimum(edge, len(self.first_number) - 1)]
        return np.repeat(group, self.edges.shape[1], axis=1), self.firsts[1] + number

    def of(self, lo: int, hi: int) -> NDArray[np.int64]:
        """Those of elements lo to hi, (hi − lo, n m + m (m + 1) / 2)."""
        group, number = self.begins(slice(lo, hi))
        mixed, n = self.near[lo:hi], group.shape[1]
        found = np.concatenate([4 * (group + mixed[:, :n]) + 3, number + mixed[:, n:]], axis=1)
        first, last = np.searchsorted(self.which, (lo, hi))
        found[self.which[first:last] - lo] = self.far[first:last]
        return found
