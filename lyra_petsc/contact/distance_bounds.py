"""Lower bounds of the distances of neighbouring patches of a sheet, as long as they hardly bend.

Let d be the vector between two points, one of each patch, and let it change by ω × d + δ. As ω × d is
perpendicular to d, the new distance is at least |d| − |δ| for any rotation vector ω: a common rigid motion of
the patches does not bring their points nearer. So a bound that was computed once holds until the patches have
bent and moved relative to each other by so much, which needs a sum over vertices, not over pairs of
simplices. The rotations are fitted to the displacements of each patch's vertices.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact import patches
from lyra_petsc.kernels.element import kernel


class DistanceBounds:
    """Lower bounds of the distances of simplices without a common vertex in neighbouring patches.

    Parameters
    ----------
    pairs : (T, 2)
        Patches, the lower number first, in ascending order.
    first : (P + 1,)
        Where the vertices of each patch begin in the list of all patches' vertices.

    Attributes
    ----------
    bounds : (T, 2)
        Bounds of distances [m] of vertices and triangles, and of edges, after the last displacements.
    """

    def __init__(self, pairs: Ints, first: Ints) -> None:
        self._pairs, self._first = pairs, first
        self._begins = np.searchsorted(pairs[:, 0], np.arange(len(first)))  # of pairs by their first patch
        self.bounds = np.zeros((len(pairs), 2))
        self._x: Array | None = None

    def update(self, x: Array, dx: Array, vertices: Ints) -> Array:
        """Bounds (T, 2) [m] that hold everywhere on displacements dx (N, 3) [m] from points x (N, 3) [m].

        ``vertices`` are those of the patches, one after the other.
        """
        if self._x is None:
            self._x = x[vertices]
        motions = np.empty((len(self._first) - 1, 15))
        capacity = 3 * patches.MAX_TRIANGLES
        _patch_motions(x, dx, vertices, self._first, self._x, capacity, motions)
        path_bounds = np.empty_like(self.bounds)
        _update(self._pairs, motions, self.bounds, path_bounds)
        return path_bounds

    def select(
        self, pairs: Ints, path_bounds: Array, radius: float, edge_radius: float
    ) -> tuple[Ints, Ints, Array]:
        """Those of ``pairs`` (m, 2) of patches that may have simplices within ``radius`` [m], two edges
        within ``edge_radius`` [m]; their rows in the table, or −1, and the known bounds (n, 2) [m].

        Pairs of two patches of other ranks are left out, since those ranks find them.
        """
        row, known = np.empty(len(pairs), dtype=np.int64), np.empty((len(pairs), 2))
        out = np.empty_like(pairs)
        n = _select(pairs, path_bounds, self._pairs, self._begins, radius, edge_radius, out, row, known)
        return out[:n], row[:n], known[:n]

    def raise_to(self, row: Ints, bounds: Array) -> None:
        """Raise the bounds of the pairs in rows (n,) to bounds (n, 2) [m] that hold on the last
        displacements.
        """
        _raise(row, bounds, self.bounds)


@kernel()
def _patch_motions(x, dx, vertices, first, old, capacity, out):  # type: ignore[no-untyped-def]
    """Motion of each patch since its vertices were at ``old`` (n, 3), which is overwritten by the end
    positions. No patch has more than ``capacity`` vertices.

    Written to out (P, 15): centre; mean displacement to the end and to the start of dx; rotation vector;
    radius; largest deviation from the rigid motion, at the end, and from the mean displacement, at the start.
    """
    r, u = np.empty((capacity, 3)), np.empty((capacity, 3))
    a = np.empty((3, 3))
    for p in range(len(first) - 1):
        begin, n = first[p], first[p + 1] - first[p]
        for k in range(3):
            centre = mean_end = mean_start = 0.0
            for i in range(n):
                row = vertices[begin + i]
                centre += old[begin + i, k]
                r[i, k] = old[begin + i, k]
                u[i, k] = x[row, k] + dx[row, k] - old[begin + i, k]
                mean_end += u[i, k]
                mean_start += x[row, k] - old[begin + i, k]
            centre, mean_end, mean_start = centre / n, mean_end / n, mean_start / n
            out[p, k], out[p, 3 + k], out[p, 6 + k] = centre, mean_end, mean_start
            for i in range(n):
                r[i, k] -= centre
                u[i, k] -= mean_end
        largest_r = largest_start_error = 0.0
        for i in range(n):
            row, square, error = vertices[begin + i], 0.0, 0.0
            for k in range(3):
                square += r[i, k] * r[i, k]
                error += (x[row, k] - old[begin + i, k] - out[p, 6 + k]) ** 2
                old[begin + i, k] = x[row, k] + dx[row, k]
            largest_r, largest_start_error = max(largest_r, square), max(largest_start_error, error)
        # the moment m of the displacements about the centre is the tensor of inertia a times the rotation w
        m0 = m1 = m2 = 0.0
        a[:] = 0.0
        for i in range(n):
            r0, r1, r2 = r[i, 0], r[i, 1], r[i, 2]
            u0, u1, u2 = u[i, 0], u[i, 1], u[i, 2]
            m0, m1, m2 = m0 + r1 * u2 - r2 * u1, m1 + r2 * u0 - r0 * u2, m2 + r0 * u1 - r1 * u0
            a[0, 0], a[1, 1] = a[0, 0] + r1 * r1 + r2 * r2, a[1, 1] + r0 * r0 + r2 * r2
            a[2, 2] = a[2, 2] + r0 * r0 + r1 * r1
            a[0, 1], a[0, 2], a[1, 2] = a[0, 1] - r0 * r1, a[0, 2] - r0 * r2, a[1, 2] - r1 * r2
        # cofactors of the symmetric matrix a
        c00, c01 = a[1, 1] * a[2, 2] - a[1, 2] ** 2, a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
        c02, c11 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1], a[0, 0] * a[2, 2] - a[0, 2] ** 2
        c12, c22 = a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2], a[0, 0] * a[1, 1] - a[0, 1] ** 2
        det = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
        w0 = w1 = w2 = 0.0
        if det > 0.0:
            w0 = (c00 * m0 + c01 * m1 + c02 * m2) / det
            w1 = (c01 * m0 + c11 * m1 + c12 * m2) / det
            w2 = (c02 * m0 + c12 * m1 + c22 * m2) / det
        largest_error = 0.0
        for i in range(n):
            e0 = u[i, 0] - w1 * r[i, 2] + w2 * r[i, 1]
            e1 = u[i, 1] - w2 * r[i, 0] + w0 * r[i, 2]
            e2 = u[i, 2] - w0 * r[i, 1] + w1 * r[i, 0]
            square = e0 * e0 + e1 * e1 + e2 * e2
            if not square <= largest_error:  # also if NaN
                largest_error = square
        out[p, 9], out[p, 10], out[p, 11], out[p, 12] = w0, w1, w2, math.sqrt(largest_r)
        out[p, 13], out[p, 14] = math.sqrt(largest_error), math.sqrt(largest_start_error)


@kernel()
def _update(pairs, motions, bounds, path_bounds):  # type: ignore[no-untyped-def]
    """Reduce bounds (T, 2) by the approach of the patches; writes the bounds that hold along the
    displacements.
    """
    for t in range(len(pairs)):
        p, q = motions[pairs[t, 0]], motions[pairs[t, 1]]
        approach_end, approach_start, square = p[13] + q[13], p[14] + q[14], 0.0
        if pairs[t, 0] != pairs[t, 1]:
            w0, w1, w2 = 0.5 * (p[9] + q[9]), 0.5 * (p[10] + q[10]), 0.5 * (p[11] + q[11])
            d0, d1, d2 = p[0] - q[0], p[1] - q[1], p[2] - q[2]
            e0 = p[3] - q[3] - w1 * d2 + w2 * d1
            e1 = p[4] - q[4] - w2 * d0 + w0 * d2
            e2 = p[5] - q[5] - w0 * d1 + w1 * d0
            approach_end += math.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
            rotation_square = (p[9] - q[9]) ** 2 + (p[10] - q[10]) ** 2 + (p[11] - q[11]) ** 2
            approach_end += 0.5 * math.sqrt(rotation_square) * (p[12] + q[12])
            for k in range(6, 9):
                square += (p[k] - q[k]) ** 2
            approach_start += math.sqrt(square)
        # in between, the approach is a weighted mean of those at the start and at the end
        largest = approach_end if approach_end >= approach_start else approach_start
        for k in range(2):
            path_bounds[t, k] = bounds[t, k] - largest
            bounds[t, k] -= approach_end


@kernel()
def _select(pairs, path_bounds, table, begins, radius, edge_radius, out, row, known):  # type: ignore[no-untyped-def]
    n_selected = 0
    for m in range(len(pairs)):
        i, j = pairs[m]
        if i >= len(begins) - 1:
            continue
        t = begins[i]  # a patch has few neighbours
        while t < begins[i + 1] and table[t, 1] != j:
            t += 1
        if t == begins[i + 1]:
            t = -1
        known[n_selected] = 0.0
        if t >= 0:
            if path_bounds[t, 0] >= radius and path_bounds[t, 1] >= edge_radius:
                continue
            for k in range(2):
                if path_bounds[t, k] > 0.0:
                    known[n_selected, k] = path_bounds[t, k]
        out[n_selected, 0], out[n_selected, 1], row[n_selected] = i, j, t
        n_selected += 1
    return n_selected


@kernel()
def _raise(row, known, bounds):  # type: ignore[no-untyped-def]
    for m in range(len(row)):
        if row[m] >= 0:
            for k in range(2):
                if not bounds[row[m], k] >= known[m, k]:  # also if NaN
                    bounds[row[m], k] = known[m, k]
