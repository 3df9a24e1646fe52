"""Vertices that ties hold together, on the levels of multigrid.

Sweeps over single vertices hardly move vertices that a stiff tie couples, and coarse meshes that do not know
the tie would pull it open. Each tie determines one of its vertices by the others, which are the unknowns of
the first coarser level: its sweeps move tied vertices together. Coarse meshes are those of the sheets before
they are sewn, as these may be apart at the start; where one has a vertex that a tie determines, it is tied to
the interpolation of the others.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.linear.coarsening import CoarseMesh
from lyra_petsc.linear.pattern import row_pointers

Combination = dict[int, float]
"""Weighted sum of the positions of vertices."""

REDUNDANT = 0.1
"""Largest factor that is left of a tie, others inserted, up to which these hold its vertices already."""


class CompressedRows(NamedTuple):
    """Compressed rows of an interpolation.

    Attributes
    ----------
    start : (n + 1,)
    parents : (P,)
    weights : (P,)
    """

    start: Ints
    parents: Ints
    weights: Array

    @classmethod
    def of(cls, combinations: Iterable[Combination]) -> CompressedRows:
        """Rows of these sums."""
        rows = list(combinations)
        return cls(
            row_pointers(np.array([len(row) for row in rows])),
            np.array([parent for row in rows for parent in row], dtype=np.int64),
            np.array([weight for row in rows for weight in row.values()], dtype=np.float64),
        )


class TiedVertices:
    """What ties leave of n vertices.

    Attributes
    ----------
    free : (k,)
        Vertices that no tie determines.
    rows : CompressedRows
        All vertices from these.
    nearest : (n,)
        Index into ``free`` of the largest weight in each row.
    """

    def __init__(self, n: int, ties: Iterable[Combination]) -> None:
        self._determined = determined = _determined(ties)
        self.free = np.setdiff1d(np.arange(n), np.array(list(determined), dtype=np.int64))
        number = np.full(n, -1)
        number[self.free] = np.arange(len(self.free))
        every = [determined.get(vertex, {vertex: 1.0}) for vertex in range(n)]
        rows = CompressedRows.of(every)
        self.rows = rows._replace(parents=number[rows.parents])
        self.nearest = number[[max(row, key=row.__getitem__) for row in every]]

    def after(self, mesh: CoarseMesh) -> CompressedRows:
        """Rows of the next finer mesh, of which ``mesh`` is the coarse mesh with these ties."""
        counts = np.diff(self.rows.start)[mesh.parents]
        entry = np.repeat(np.arange(len(mesh.parents)), counts)
        first = np.repeat(self.rows.start[mesh.parents] - row_pointers(counts)[:-1], counts)
        at = first + np.arange(len(entry))
        row = np.repeat(np.arange(len(mesh.start) - 1), np.diff(mesh.start))[entry]
        key, place = np.unique(row * len(self.free) + self.rows.parents[at], return_inverse=True)
        weights = np.zeros(len(key))
        np.add.at(weights, place, mesh.weights[entry] * self.rows.weights[at])
        row, parents = np.divmod(key, len(self.free))
        return CompressedRows(row_pointers(np.bincount(row, minlength=len(mesh.start) - 1)), parents, weights)

    def coarse(self, mesh: CoarseMesh) -> TiedVertices:
        """The same of a coarse mesh."""
        ties = []
        for coarse, vertex in enumerate(mesh.vertices.tolist()):
            if vertex in self._determined:
                tie = {coarse: 1.0}
                for parent, weight in self._determined[vertex].items():
                    entries = slice(mesh.start[parent], mesh.start[parent + 1])
                    for other, part in zip(mesh.parents[entries], mesh.weights[entries], strict=True):
                        tie[int(other)] = tie.get(int(other), 0.0) - weight * float(part)
                ties.append(tie)
        return TiedVertices(len(mesh.vertices), ties)


def _determined(ties: Iterable[Combination]) -> dict[int, Combination]:
    """The vertices that ties determine by others, which none determines."""
    determined: dict[int, Combination] = {}

    def inserted(tie: Combination) -> Combination:
        out: Combination = {}
        left = list(tie.items())
        while left:
            vertex, factor = left.pop()
            if vertex in determined:
                left += [(other, factor * weight) for other, weight in determined[vertex].items()]
            else:
                out[vertex] = out.get(vertex, 0.0) + factor
        return out

    for tie in ties:
        sums = inserted(tie)
        vertex = max(sums, key=lambda v: abs(sums[v]))
        factor = sums.pop(vertex)
        if abs(factor) > REDUNDANT:
            determined[vertex] = {v: -f / factor for v, f in sums.items() if f != 0.0}
    return {vertex: inserted(row) for vertex, row in determined.items()}
