"""Galerkin products: coarse matrix Pᵀ A P of symmetric block rows A and interpolation P."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.linear.exchange_blocks import SharedBlocks
from lyra_petsc.linear.pattern import BlockPattern, diagonal_keys, index_type, row_pointers, union
from lyra_petsc.mesh.distribute import local_numbers
from lyra_petsc.mesh.points import Points
from lyra_petsc.phases import GALERKIN, logged

CHUNK_ROWS = 1 << 13
"""Fine rows whose products are processed together when the coarse pattern is built."""

FAR = np.iinfo(np.uint8).max
"""Replaces an offset that does not fit into a byte, or that of a block outside the owned coarse rows."""


@cached()
def _slots(lo, hi, indptr, columns, start, parents, slots, keys, width):  # type: ignore[no-untyped-def]
    """Slots of the products A P of fine rows lo..hi, and keys of the coarse blocks that Pᵀ adds them to.

    A row of A P has one block, in a *slot*, for each coarse point of its columns, in order of appearance,
    first over owned and then over ghost columns. ``slots`` has the slot of each product A_ij P_jc. ``keys``
    has one key for each parent of the row and each slot: for owned columns, whose blocks also represent
    their transpose, smaller · width + larger coarse point, or ~ of this if the product must be transposed;
    for ghost columns width² + row · width + column.
    """
    n_owned = len(indptr) - 1
    seen, slot_of = np.full(width, -1, np.int64), np.zeros(width, np.int64)
    points = np.empty(2 * width, np.int64)  # coarse point of each slot
    s = q = 0
    for row in range(lo, hi):
        m = n_own = 0
        mark = 2 * row
        for k in range(indptr[row], indptr[row + 1]):
            if columns[k] >= n_owned and mark == 2 * row:
                mark, n_own = mark + 1, m
            for p in range(start[columns[k]], start[columns[k] + 1]):
                c = parents[p]
                if seen[c] != mark:
                    seen[c], slot_of[c], points[m] = mark, m, c
                    m += 1
                slots[s] = slot_of[c]
                s += 1
        if mark == 2 * row:
            n_own = m
        for p in range(start[row], start[row + 1]):
            a = parents[p]
            for t in range(m):
                c = points[t]
                if t >= n_own:
                    keys[q] = (width + a) * width + c
                else:
                    keys[q] = a * width + c if c >= a else ~(c * width + a)
                q += 1


@cached()
def _counts(indptr, columns, start, parents, width, slots, keys):  # type: ignore[no-untyped-def]
    """Numbers of slots and of keys of each fine row."""
    n_owned = len(indptr) - 1
    seen = np.full(width, -1, np.int64)
    for row in range(n_owned):
        m = n = 0
        for k in range(indptr[row], indptr[row + 1]):
            mark = 2 * row + (columns[k] >= n_owned)
            for p in range(start[columns[k]], start[columns[k] + 1]):
                n += 1
                if seen[parents[p]] != mark:
                    seen[parents[p]] = mark
                    m += 1
        slots[row] = n
        keys[row] = m * (start[row + 1] - start[row])


@cached(fastmath=True)
def _project(indptr, columns, start, parents, weights, slots, n_slots, first, offset, far, values, free, out):  # type: ignore[no-untyped-def]  # fmt: skip
    """Add the products of the fine rows to the coarse blocks out (C, 9); diagonal blocks get one half.

    The product of a slot and a parent is added to the block ``offset`` behind the ``first`` one of the
    smaller coarse point's row; if offset is FAR, to the next block of ``far``, ~ of it if transposed.
    Coordinates that are not free are decoupled in the fine rows, so that only their diagonal is skipped.
    Indices are unsigned and there are no views, as checks of the sign would take four times as long.
    """
    sums, points = np.empty((n_slots, 9)), np.empty(n_slots, np.int64)
    s = q = f = 0
    for row in range(len(indptr) - 1):
        m = 0
        for k in range(Index(indptr[row]), Index(indptr[row + 1])):
            j = Index(columns[k])
            b0, b1, b2 = values[k, 0], values[k, 1], values[k, 2]
            b3, b4, b5 = values[k, 3], values[k, 4], values[k, 5]
            b6, b7, b8 = values[k, 6], values[k, 7], values[k, 8]
            half = 1.0
            if j == Index(row):
                half = 0.5
                b0, b4, b8 = free[row, 0] * b0, free[row, 1] * b4, free[row, 2] * b8
            for p in range(start[j], start[j + Index(1)]):
                w, t = half * weights[p], Index(slots[s])
                s += 1
                if t == Index(m):
                    points[m] = parents[p]
                    m += 1
                    sums[t, 0], sums[t, 1], sums[t, 2] = w * b0, w * b1, w * b2
                    sums[t, 3], sums[t, 4], sums[t, 5] = w * b3, w * b4, w * b5
                    sums[t, 6], sums[t, 7], sums[t, 8] = w * b6, w * b7, w * b8
                else:
                    sums[t, 0] += w * b0
                    sums[t, 1] += w * b1
                    sums[t, 2] += w * b2
                    sums[t, 3] += w * b3
                    sums[t, 4] += w * b4
                    sums[t, 5] += w * b5
                    sums[t, 6] += w * b6
                    sums[t, 7] += w * b7
                    sums[t, 8] += w * b8
        for p in range(start[row], start[row + 1]):
            w, a = weights[p], parents[p]
            for u in range(Index(m)):
                if offset[q] == FAR:
                    k = far[f]
                    f += 1
                elif a <= points[u]:
                    k = first[a] + offset[q]
                else:
                    k = ~(first[points[u]] + offset[q])
                q += 1
                b0, b1, b2 = w * sums[u, 0], w * sums[u, 1], w * sums[u, 2]
                b3, b4, b5 = w * sums[u, 3], w * sums[u, 4], w * sums[u, 5]
                b6, b7, b8 = w * sums[u, 6], w * sums[u, 7], w * sums[u, 8]
                if k < 0:
                    k = ~k
                    b1, b2, b3, b5, b6, b7 = b3, b6, b1, b7, b2, b5
                o = Index(k)
                out[o, 0] += b0
                out[o, 1] += b1
                out[o, 2] += b2
                out[o, 3] += b3
                out[o, 4] += b4
                out[o, 5] += b5
                out[o, 6] += b6
                out[o, 7] += b7
                out[o, 8] += b8


@cached()
def _finish_diagonal(indptr, values):  # type: ignore[no-untyped-def]
    """Add the transpose to the diagonal blocks, of which values (n_blocks, 9) hold half."""
    for row in range(len(indptr) - 1):
        k = indptr[row]
        for i in range(3):
            values[k, 4 * i] *= 2.0
        for i, j in ((1, 3), (2, 6), (5, 7)):
            values[k, i] = values[k, j] = values[k, i] + values[k, j]


@cached()
def _fill_diagonal(indptr, values, free):  # type: ignore[no-untyped-def]
    """Set the diagonal to 1 and free (n, 3) to 0 for coordinates that nothing is interpolated from."""
    for row in range(len(indptr) - 1):
        for i in range(3):
            free[row, i] = 1.0
            if values[indptr[row], 4 * i] == 0.0:
                values[indptr[row], 4 * i], free[row, i] = 1.0, 0.0


class Galerkin:
    """Galerkin product of a rank's fine rows with the interpolation.

    Parameters
    ----------
    points : Points
        Fine points.
    pattern : BlockPattern
        Pattern of the fine rows.
    start : (n_owned + 1,)
        Row pointers of the interpolation of the fine points.
    parents, weights : (P,)
        Coarse points in global numbers from which a fine point is interpolated, and weights.
    bounds : (ranks + 1,)
        First coarse point of each rank.

    Attributes
    ----------
    points : Points
        Coarse points; ghosts are those of other ranks in the coarse rows or the interpolation.
    pattern : BlockPattern
        Pattern of the coarse rows.
    interpolation : (n_local + 1,), (P,) int32, (P,)
        Compressed rows of the interpolation of all local fine points: row pointers, parents in local numbers
        of coarse points, weights.
    """

    def __init__(
        self, points: Points, pattern: BlockPattern, start: Ints, parents: Ints, weights: Array, bounds: Ints
    ) -> None:
        comm = points.comm
        first, end = int(bounds[comm.rank]), int(bounds[comm.rank + 1])
        everyone, self._weights, self._start = _with_ghosts(points, start, parents, weights)
        near = np.unique(everyone[(everyone < first) | (everyone >= end)])
        n, width = end - first, end - first + len(near)
        self._fine = pattern
        self._parents = local_numbers(everyone, near, first, end).astype(np.int32)
        keys, target = self._products(width)
        one, other = np.divmod(keys, max(width, 1))
        inside = (one < n) & (other < n)
        mixed = ~inside
        symmetric = one < width
        number = np.concatenate([np.arange(first, end), near])
        pairs = np.column_stack([number[one - np.where(symmetric, 0, width)], number[other]])[mixed]
        self._shared = shared = SharedBlocks(comm, bounds, pairs, symmetric[mixed])
        needed = np.concatenate([shared.columns, everyone])
        ghosts = np.unique(needed[(needed < first) | (needed >= end)])
        self.points = Points(comm, bounds, ghosts)
        local = local_numbers(everyone, ghosts, first, end).astype(np.int32)
        self.interpolation = self._start, local, self._weights
        n_local = self.points.n_local
        own = one[inside] * n_local + other[inside]
        received = (shared.rows - first) * n_local + local_numbers(shared.columns, ghosts, first, end)
        final = union(diagonal_keys(n, n_local), own, received)
        self.pattern = BlockPattern.of_keys(final, n, n_local)
        shared.set_targets(np.searchsorted(final, received))
        blocks = np.empty(len(keys), dtype=np.int64)
        blocks[inside] = np.searchsorted(final, own)
        blocks[mixed] = len(final) + np.arange(len(pairs))
        self._offset, self._far = self._offsets(target, blocks)
        self._n_sums = len(final) + len(pairs)

    def _offsets(self, target: Ints, blocks: Ints) -> tuple[NDArray[np.uint8], Ints]:
        """``offset`` and ``far`` of `_project` for the keys ``target`` of products, and each key's block."""
        counts = np.diff(self.pattern.indptr)
        in_row = np.arange(self.pattern.n_blocks) - np.repeat(self.pattern.indptr[:-1], counts)
        short = np.full(len(blocks), FAR, dtype=np.uint8)
        inside = blocks < len(in_row)
        short[inside] = np.minimum(in_row[blocks[inside]], FAR)
        offset, far = np.empty(len(target), dtype=np.uint8), [np.empty(0, dtype=np.int64)]
        size = 128 * CHUNK_ROWS  # about as many as a chunk of rows has
        for lo in range(0, len(target), size):
            part = target[lo : lo + size]
            key = np.where(part < 0, ~part, part)
            offset[lo : lo + len(part)] = short[key]
            beyond = short[key] == FAR
            block = blocks[key[beyond]]
            far.append(np.where(part[beyond] < 0, ~block, block))
        return offset, np.concatenate(far)

    def _products(self, width: int) -> tuple[Ints, Ints]:
        """All keys, ascending, and the index of the key of each product, ~ of it if transposed."""
        fine, n = self._fine, self._fine.n_owned
        rows = fine.indptr, fine.columns, self._start, self._parents
        n_slots, n_keys = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
        _counts(*rows, width, n_slots, n_keys)
        self._max_slots = int((n_keys // np.maximum(np.diff(self._start[: n + 1]), 1)).max(initial=0))
        self._slots = np.empty(int(n_slots.sum()), dtype=np.int16 if self._max_slots < 2**15 else np.int32)
        firsts = row_pointers(n_slots)
        chunks = [(lo, min(lo + CHUNK_ROWS, n)) for lo in range(0, n, CHUNK_ROWS)]

        def keys_of(lo: int, hi: int) -> Ints:
            keys = np.empty(int(n_keys[lo:hi].sum()), dtype=np.int64)
            _slots(lo, hi, *rows, self._slots[firsts[lo] :], keys, width)
            return keys

        keys = np.empty(0, dtype=np.int64)
        for lo, hi in chunks:
            new = keys_of(lo, hi)
            keys = union(keys, np.where(new < 0, ~new, new))
        target = np.empty(int(n_keys.sum()), dtype=index_type(2 * len(keys)))
        q = 0
        for lo, hi in chunks:
            new = keys_of(lo, hi)
            position = np.searchsorted(keys, np.where(new < 0, ~new, new))
            target[q : q + len(new)] = np.where(new < 0, ~position, position)
            q += len(new)
        return keys, target

    @logged(GALERKIN)
    def project(self, values: Array, free: Array) -> tuple[Array, Array]:
        """Coarse block rows of fine ones (n_blocks, 3, 3); collective.

        ``free`` (n_owned, 3) is 1 for coordinates to which is interpolated, 0 for others, which must be
        decoupled in ``values``.

        Returns
        -------
        values : (n_blocks, 3, 3)
            The coarse rows.
        free : (n_owned, 3)
            1 for coarse coordinates from which is interpolated, else 0.
        """
        fine, n = self._fine, self.pattern.n_blocks
        sums, coarse_free = np.zeros((self._n_sums, 9)), np.empty((self.pattern.n_owned, 3))
        rows = fine.indptr, fine.columns, self._start, self._parents, self._weights
        targets = self.pattern.indptr, self._offset, self._far
        _project(*rows, self._slots, self._max_slots, *targets, values.reshape(-1, 9), free, sums)
        _finish_diagonal(self.pattern.indptr, sums)
        # A P, and Pᵀ (A P)
        PETSc.Log.logFlops(18.0 * (len(self._slots) + len(self._offset)))
        self._shared.add(sums[n:], sums[:n])
        _fill_diagonal(self.pattern.indptr, sums, coarse_free)
        return sums[:n].reshape(-1, 3, 3), coarse_free


def _with_ghosts(points: Points, start: Ints, parents: Ints, weights: Array) -> tuple[Ints, Array, Ints]:
    """Parents, weights and row pointers of all local points, from those of the owned ones; collective."""
    if points.comm.size == 1:
        return parents, weights, start
    counts = np.zeros((points.n_local, 3))
    counts[: points.n_owned, 0] = np.diff(start)
    points.update_ghosts(counts)
    number = counts[:, 0].astype(np.int64)
    everywhere = row_pointers(number)
    all_parents, all_weights = np.empty(everywhere[-1], dtype=np.int64), np.empty(everywhere[-1])
    all_parents[: len(parents)], all_weights[: len(weights)] = parents, weights
    row = np.zeros((points.n_local, 3))
    for nth in range(points.comm.allreduce(int(number.max(initial=0)), MPI.MAX)):
        has = number > nth
        own = has[: points.n_owned]
        at = start[:-1][own] + nth
        row[: points.n_owned][own, 0], row[: points.n_owned][own, 1] = parents[at], weights[at]
        points.update_ghosts(row)
        ghosts = np.flatnonzero(has[points.n_owned :]) + points.n_owned
        all_parents[everywhere[ghosts] + nth] = row[ghosts, 0].astype(np.int64)
        all_weights[everywhere[ghosts] + nth] = row[ghosts, 1]
    return all_parents, all_weights, everywhere
