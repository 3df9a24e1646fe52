"""Block rows of a coarse matrix: interpolationᵀ · block rows · interpolation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.assembly.pattern import BlockPattern, diagonal_keys, index_type, places, union
from lyra_petsc.kernel_cache import cached
from lyra_petsc.partition.distribute import local_numbers
from lyra_petsc.partition.points import Points

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

CHUNK_ROWS = 1 << 14
"""Fine rows whose products are looked at together while the coarse pattern is made."""


@cached()
def _keys(lo, hi, indptr, columns, parents, place, width, keys):  # type: ignore[no-untyped-def]
    """Keys row · width + column place of what fine rows lo..hi add to, in the order of `_project`."""
    q = 0
    for row in range(lo, hi):
        for k in range(indptr[row], indptr[row + 1]):
            c = columns[k]
            for a in range(3):
                if parents[row, a] >= 0:
                    for b in range(3):
                        if parents[c, b] >= 0:
                            keys[q] = parents[row, a] * width + place[parents[c, b]]
                            q += 1
    return q


@cached()
def _project(indptr, columns, parents, weights, free, target, values, out):  # type: ignore[no-untyped-def]
    """out[target] += weight · weight · block, coordinates that are not free left out."""
    q = 0
    for row in range(len(indptr) - 1):
        r0, r1, r2 = free[row, 0], free[row, 1], free[row, 2]
        for k in range(indptr[row], indptr[row + 1]):
            c = columns[k]
            c0, c1, c2 = free[c, 0], free[c, 1], free[c, 2]
            v = values[k]
            v00, v01, v02 = r0 * c0 * v[0, 0], r0 * c1 * v[0, 1], r0 * c2 * v[0, 2]
            v10, v11, v12 = r1 * c0 * v[1, 0], r1 * c1 * v[1, 1], r1 * c2 * v[1, 2]
            v20, v21, v22 = r2 * c0 * v[2, 0], r2 * c1 * v[2, 1], r2 * c2 * v[2, 2]
            for a in range(3):
                if parents[row, a] >= 0:
                    for b in range(3):
                        if parents[c, b] >= 0:
                            w = weights[row, a] * weights[c, b]
                            o = out[target[q]]
                            q += 1
                            o[0, 0] += w * v00
                            o[0, 1] += w * v01
                            o[0, 2] += w * v02
                            o[1, 0] += w * v10
                            o[1, 1] += w * v11
                            o[1, 2] += w * v12
                            o[2, 0] += w * v20
                            o[2, 1] += w * v21
                            o[2, 2] += w * v22


@cached()
def _fill_diagonal(diagonal, values):  # type: ignore[no-untyped-def]
    """A one where nothing is interpolated from a coordinate."""
    for k in diagonal:
        for i in range(3):
            if values[k, i, i] == 0.0:
                values[k, i, i] = 1.0


class Galerkin:
    """The coarse rows of a rank, whose vertices are interpolated from coarse ones of the same rank.

    Parameters
    ----------
    points : Points
        The fine ones.
    pattern : BlockPattern
        Of the fine rows.
    parents, weights : (n_owned, 3)
        Interpolation from owned coarse points; −1 for none.
    n_coarse : int
        Coarse points of this rank.

    Attributes
    ----------
    points : Points
        The coarse ones, with those of other ranks that the rows couple to as ghosts.
    pattern : BlockPattern
        Of the coarse rows.
    """

    def __init__(
        self, points: Points, pattern: BlockPattern, parents: Ints, weights: Array, n_coarse: int
    ) -> None:
        comm, n = points.comm, points.n_owned
        bounds = np.concatenate([[0], np.cumsum(comm.allgather(n_coarse))]).astype(np.int64)
        first = int(bounds[comm.rank])
        number, self._weights = np.empty((points.n_local, 3)), np.empty((points.n_local, 3))
        number[:n], self._weights[:n] = np.where(parents >= 0, parents + first, -1), weights
        for values in (number, self._weights):
            points.update_ghosts(values)
        everyone = number.astype(np.int64)
        beyond = everyone[n:][everyone[n:] >= 0]
        ghosts = np.unique(beyond[(beyond < first) | (beyond >= first + n_coarse)])
        self.points = Points(comm, bounds, ghosts, np.arange(n_coarse))
        numbers = local_numbers(everyone, ghosts, first, first + n_coarse)
        self._parents = np.where(everyone >= 0, numbers, -1)
        self._fine = pattern
        self._make_pattern(n_coarse, places(self.points.global_number))

    def _make_pattern(self, n_coarse: int, place: Ints) -> None:
        n = len(self._fine.indptr) - 1
        chunks = [(lo, min(lo + CHUNK_ROWS, n)) for lo in range(0, n, CHUNK_ROWS)]
        keys = diagonal_keys(n_coarse, place)
        for lo, hi in chunks:
            keys = union(keys, self._keys_of(lo, hi, place))
        self.pattern = BlockPattern.of_keys(keys, n_coarse, place)
        kind = index_type(len(keys))
        found = [np.searchsorted(keys, self._keys_of(lo, hi, place)).astype(kind) for lo, hi in chunks]
        self._target = np.concatenate([np.zeros(0, dtype=kind), *found])
        self.values = np.zeros((len(keys), 3, 3))

    def _keys_of(self, lo: int, hi: int, place: Ints) -> Ints:
        fine = self._fine
        keys = np.empty(9 * int(fine.indptr[hi] - fine.indptr[lo]), dtype=np.int64)
        return keys[: _keys(lo, hi, fine.indptr, fine.columns, self._parents, place, len(place), keys)]

    def project(self, values: Array, free: Array) -> Array:
        """Coarse block rows (C, 3, 3) of fine ones (n_blocks, 3, 3).

        ``free`` (n_local, 3) is 0 for coordinates that nothing is interpolated to, 1 for others.
        """
        fine = self._fine
        self.values[:] = 0.0
        _project(
            fine.indptr, fine.columns, self._parents, self._weights, free, self._target, values, self.values
        )
        _fill_diagonal(self.pattern.diagonal, self.values)
        return self.values
