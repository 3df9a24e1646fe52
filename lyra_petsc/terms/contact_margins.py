"""How far from each other neighbouring patches of a sheet surely are, as long as they hardly bend.

Let d be the vector between a point of each of two patches, and let it change by ω × d + δ. As ω × d stands
across d, their distance is afterwards at least |d| − |δ|, for any rotation ω: what patches do as a rigid body
brings none of their points nearer. So a distance that was proved once is known as long as it exceeds what
the patches have bent and moved beside each other since, which is a sum over vertices, not over pairs of
simplices. Rotations are those of a fit to the displacements of each patch's vertices.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.element import kernel
from lyra_petsc.mesh import patches


class Margins:
    """Least distances of simplices of patches next to each other, without those that have a common vertex.

    Parameters
    ----------
    pairs : (T, 2)
        Patches, the smaller number first, in ascending order.
    first : (P + 1,)
        Where the vertices of each patch begin among those of all.

    Attributes
    ----------
    left : (T, 2)
        Distance [m] of vertices from triangles, and of edges, at the end of the ways last seen.
    """

    def __init__(self, pairs: Ints, first: Ints) -> None:
        self._pairs, self._first = pairs, first
        self._begins = np.searchsorted(pairs[:, 0], np.arange(len(first)))  # of pairs by their first patch
        self.left = np.zeros((len(pairs), 2))
        self._at: Array | None = None

    def spend(self, x: Array, way: Array, vertices: Ints) -> Array:
        """What is left of the distances, (T, 2) [m], all along the ways (N, 3) [m] from points x (N, 3) [m].

        ``vertices`` are those of the patches, one after the other.
        """
        if self._at is None:
            self._at = x[vertices]
        moves = np.empty((len(self._first) - 1, 15))
        _moves(x, way, vertices, self._first, self._at, moves)
        lasting = np.empty_like(self.left)
        _spend(self._pairs, moves, self.left, lasting)
        return lasting

    def among(self, met: Ints, lasting: Array, reach: float, edges: float) -> tuple[Ints, Ints, Array]:
        """Of pairs of patches met (m, 2), those of which simplices may be within reach [m], two edges within
        ``edges`` [m]; rows of this table, or −1, and the known distances (n, 2) [m].

        Pairs of other patches than those in the table's are known to be of no interest.
        """
        out, row, known = np.empty_like(met), np.empty(len(met), dtype=np.int64), np.empty((len(met), 2))
        n = _among(met, lasting, self._pairs, self._begins, reach, edges, out, row, known)
        return out[:n], row[:n], known[:n]

    def learn(self, row: Ints, known: Array) -> None:
        """Distances (n, 2) [m] known of pairs in rows (n,), all along the ways last seen."""
        _learn(row, known, self.left)


@kernel()
def _moves(x, way, vertices, first, at, out):  # type: ignore[no-untyped-def]
    """How patches have moved since their vertices were ``at`` (n, 3), which becomes where they go.

    Into out (P, 15): centre; mean displacement at the end and at the start of the ways; rotation vector;
    radius, and farthest that a vertex goes beside the rigid motion, and at the start beside the mean.
    """
    off, went = np.empty((3 * patches.SIZE, 3)), np.empty((3 * patches.SIZE, 3))
    a = np.empty((3, 3))
    for p in range(len(first) - 1):
        begin, n = first[p], first[p + 1] - first[p]
        for k in range(3):
            centre = to = start = 0.0
            for i in range(n):
                row = vertices[begin + i]
                centre += at[begin + i, k]
                off[i, k] = at[begin + i, k]
                went[i, k] = x[row, k] + way[row, k] - at[begin + i, k]
                to += went[i, k]
                start += x[row, k] - at[begin + i, k]
            centre, to, start = centre / n, to / n, start / n
            out[p, k], out[p, 3 + k], out[p, 6 + k] = centre, to, start
            for i in range(n):
                off[i, k] -= centre
                went[i, k] -= to
        farthest = wrong = 0.0
        for i in range(n):
            row, square, error = vertices[begin + i], 0.0, 0.0
            for k in range(3):
                square += off[i, k] * off[i, k]
                error += (x[row, k] - at[begin + i, k] - out[p, 6 + k]) ** 2
                at[begin + i, k] = x[row, k] + way[row, k]
            farthest, wrong = max(farthest, square), max(wrong, error)
        # moments of the displacements about the centre are the tensor of inertia times the rotation
        moment0 = moment1 = moment2 = 0.0
        a[:] = 0.0
        for i in range(n):
            r0, r1, r2 = off[i, 0], off[i, 1], off[i, 2]
            w0, w1, w2 = went[i, 0], went[i, 1], went[i, 2]
            moment0, moment1, moment2 = (
                moment0 + r1 * w2 - r2 * w1,
                moment1 + r2 * w0 - r0 * w2,
                moment2 + r0 * w1 - r1 * w0,
            )
            a[0, 0], a[1, 1], a[2, 2] = (
                a[0, 0] + r1 * r1 + r2 * r2,
                a[1, 1] + r0 * r0 + r2 * r2,
                a[2, 2] + r0 * r0 + r1 * r1,
            )
            a[0, 1], a[0, 2], a[1, 2] = a[0, 1] - r0 * r1, a[0, 2] - r0 * r2, a[1, 2] - r1 * r2
        c0, c1, c2 = (
            a[1, 1] * a[2, 2] - a[1, 2] ** 2,
            a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2],
            a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1],
        )
        d1, d2, d3 = (
            a[0, 0] * a[2, 2] - a[0, 2] ** 2,
            a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2],
            a[0, 0] * a[1, 1] - a[0, 1] ** 2,
        )
        det = a[0, 0] * c0 + a[0, 1] * c1 + a[0, 2] * c2
        turn0 = turn1 = turn2 = 0.0
        if det > 0.0:
            turn0 = (c0 * moment0 + c1 * moment1 + c2 * moment2) / det
            turn1 = (c1 * moment0 + d1 * moment1 + d2 * moment2) / det
            turn2 = (c2 * moment0 + d2 * moment1 + d3 * moment2) / det
        beside = 0.0
        for i in range(n):
            e0 = went[i, 0] - turn1 * off[i, 2] + turn2 * off[i, 1]
            e1 = went[i, 1] - turn2 * off[i, 0] + turn0 * off[i, 2]
            e2 = went[i, 2] - turn0 * off[i, 1] + turn1 * off[i, 0]
            square = e0 * e0 + e1 * e1 + e2 * e2
            if not square <= beside:  # or no number
                beside = square
        out[p, 9], out[p, 10], out[p, 11] = turn0, turn1, turn2
        out[p, 12], out[p, 13], out[p, 14] = math.sqrt(farthest), math.sqrt(beside), math.sqrt(wrong)


@kernel()
def _spend(pairs, moves, left, lasting):  # type: ignore[no-untyped-def]
    """Take from distances left (T, 2) what patches came nearer, and tell those that last on the ways."""
    for t in range(len(pairs)):
        p, q = moves[pairs[t, 0]], moves[pairs[t, 1]]
        near, wrong, apart = p[13] + q[13], p[14] + q[14], 0.0
        if pairs[t, 0] != pairs[t, 1]:
            w0, w1, w2 = 0.5 * (p[9] + q[9]), 0.5 * (p[10] + q[10]), 0.5 * (p[11] + q[11])
            d0, d1, d2 = p[0] - q[0], p[1] - q[1], p[2] - q[2]
            e0 = p[3] - q[3] - w1 * d2 + w2 * d1
            e1 = p[4] - q[4] - w2 * d0 + w0 * d2
            e2 = p[5] - q[5] - w0 * d1 + w1 * d0
            near += math.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
            turn = (p[9] - q[9]) ** 2 + (p[10] - q[10]) ** 2 + (p[11] - q[11]) ** 2
            near += 0.5 * math.sqrt(turn) * (p[12] + q[12])
            for k in range(6, 9):
                apart += (p[k] - q[k]) ** 2
            wrong += math.sqrt(apart)
        # what comes to stand at the end by this and that at the start, comes between by a mean of both
        most = near if near >= wrong else wrong
        for k in range(2):
            lasting[t, k] = left[t, k] - most
            left[t, k] -= near


@kernel()
def _among(met, lasting, pairs, begins, reach, edges, out, row, known):  # type: ignore[no-untyped-def]
    found = 0
    for m in range(len(met)):
        i, j = met[m]
        if i >= len(begins) - 1:
            continue
        at = begins[i]  # few are beside one
        while at < begins[i + 1] and pairs[at, 1] != j:
            at += 1
        if at == begins[i + 1]:
            at = -1
        known[found] = 0.0
        if at >= 0:
            if lasting[at, 0] >= reach and lasting[at, 1] >= edges:
                continue
            for k in range(2):
                if lasting[at, k] > 0.0:
                    known[found, k] = lasting[at, k]
        out[found, 0], out[found, 1], row[found] = i, j, at
        found += 1
    return found


@kernel()
def _learn(row, known, left):  # type: ignore[no-untyped-def]
    for m in range(len(row)):
        if row[m] >= 0:
            for k in range(2):
                if not left[row[m], k] >= known[m, k]:  # or no number
                    left[row[m], k] = known[m, k]
