"""Gauss-Seidel with unknowns on edges: scalar over the edges, block by block over the vertices.

Like ``gauss_seidel``, with the storage of ``edge_couplings``. The residual of edges is a separate array
(n_local, 3). Coarser levels only have vertices; besides their correction each edge gets one of its residual
over its diagonal entry (Jacobi). Both corrections between the sweeps are symmetric and positive semidefinite,
so that the cycle stays positive definite, and conjugate gradients take a fifth fewer iterations.

Bending is of fourth order, and one sweep reduces its error little. If it is stiff compared with inertia,
vertices are swept several times, and edges before every second of these sweeps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.kernels.llvm import WIDTH
from lyra_petsc.kernels.vectors import AHEAD, gather, gather_edges, scatter, scatter_edges
from lyra_petsc.linear.edge_couplings import AHEAD_EDGES
from lyra_petsc.linear.gauss_seidel import (
    NEGLIGIBLE,
    begin,
    flushed,
    invert_diagonal,
    negligible_size,
    solved,
    store,
    subtract_ghosts,
)

if TYPE_CHECKING:
    from lyra_petsc.linear.edge_couplings import EdgeCouplings
    from lyra_petsc.linear.pattern import BlockPattern

Floats = NDArray[np.float32]


SWEEPS = ((0.03, (3, 3, 3)), (0.3, (2, 2, 2)))
"""Upper bounds of inertia's share in the stiffness of the vertices' softest directions, and the numbers of
sweeps over the vertices on the finest level, the next coarser one, and those below; else one. Among
numbers that cost equal time these let iterations grow least with the mesh."""


def memory_sizes(pattern: BlockPattern) -> tuple[int, int]:
    """Memory of `SweepsWithEdges`, in float64 numbers: of the copy of its rows, and of its vectors.

    The vectors begin at a multiple of four, so that no row of the residual lies on two cache lines.
    """
    return WIDTH * -(-9 * pattern.n_stored // (2 * WIDTH)), 8 * pattern.n_local


@cached()
def invert_edge_diagonal(indptr, entries, inverse):  # type: ignore[no-untyped-def]
    """inverse (n_edges,) = inverses of the edges' diagonal entries; 0 for entries of 0."""
    for edge in range(Index(len(inverse))):
        value = entries[Index(indptr[edge]), 0]
        inverse[edge] = 1.0 / value if value != 0.0 else 0.0


@cached()
def _sum_of_traces(weight, blocks):  # type: ignore[no-untyped-def]
    """Weighted sum of the traces of the first n of blocks (n_blocks, 9), weight (n,)."""
    total = 0.0
    for k in range(Index(len(weight))):
        total += weight[k] * (blocks[k, 0] + blocks[k, 4] + blocks[k, 8])
    return total


@cached(fastmath=True)
def backward_edges(first, indptr, columns, entries, inverse, x, r):  # type: ignore[no-untyped-def]
    """``gauss_seidel.backward`` over the owned edges, from index ``first`` on, in x and r (3 n_local,).

    An edge depends on the edge processed before it, which is mostly its first coupling: that one is added
    last, here and in ``forward_edges``, so that the processor need not wait.
    """
    n, first = Index(len(inverse)), Index(first)
    for swept in range(n):
        edge = n - Index(1) - swept
        at, lo, hi = first + edge, Index(indptr[edge]) + Index(1), Index(indptr[edge + Index(1)])
        s = r[at]
        for k in range(hi - lo):
            s -= entries[hi - Index(1) - k, 0] * x[Index(columns[hi - Index(1) - k])]
        y = flushed(inverse[edge] * s)
        decrement = x[at] - y
        x[at], r[at] = y, 0.0
        for k in range(lo, hi):
            r[Index(columns[k])] += entries[k, 0] * decrement


@cached(fastmath=True)
def forward_edges(first, indptr, columns, entries, inverse, x, r):  # type: ignore[no-untyped-def]
    """``gauss_seidel.forward`` over the owned edges; couplings to ghosts are already subtracted from r."""
    first = Index(first)
    for edge in range(Index(len(inverse))):
        at, lo, hi = first + edge, Index(indptr[edge]) + Index(1), Index(indptr[edge + Index(1)])
        s = entries.dtype.type(0.0)
        for k in range(lo, hi):
            s += entries[k, 0] * x[Index(columns[k])]
        y = flushed(inverse[edge] * (r[at] - s))
        x[at] = y
        for k in range(lo, hi):
            r[Index(columns[k])] -= entries[k, 0] * y


@cached(fastmath=True)
def correct_edges(first, inverse, x, r):  # type: ignore[no-untyped-def]
    """x += D⁻¹ r in the owned edges' unknowns; x and r (3 n_local,)."""
    first = Index(first)
    for edge in range(Index(len(inverse))):
        x[first + edge] += flushed(inverse[edge] * r[first + edge])


@cached(fastmath=True)
def backward_vertices(  # type: ignore[no-untyped-def]
    indptr, ends, columns, group_ptr, columns4, blocks, groups, inverse, x, r, of_edges
):
    """``gauss_seidel.backward`` over the owned vertices, after that over the edges."""
    n = Index(len(inverse))
    for swept in range(n):
        row = n - Index(1) - swept
        lo, hi = Index(indptr[row] + 1), Index(ends[row])
        first, last = Index(group_ptr[row]), Index(group_ptr[row + Index(1)])
        s0, s1, s2 = gather(blocks, columns, x, lo, hi, -AHEAD)
        t0, t1, t2 = gather_edges(groups, columns4, x, first, last, -AHEAD_EDGES)
        r0, r1, r2 = r[row, 0] - t0, r[row, 1] - t1, r[row, 2] - t2
        y0, y1, y2 = solved(inverse, row, r0 - s0, r1 - s1, r2 - s2)
        decrement = x[row, 0] - y0, x[row, 1] - y1, x[row, 2] - y2
        x[row, 0], x[row, 1], x[row, 2] = y0, y1, y2
        r[row, 0] = r[row, 1] = r[row, 2] = 0.0
        scatter(blocks, columns, r, lo, hi, decrement)
        scatter_edges(groups, columns4, of_edges, first, last, decrement)


@cached(fastmath=True)
def forward_vertices(  # type: ignore[no-untyped-def]
    indptr, ends, columns, group_ptr, columns4, blocks, groups, inverse, b, x, r, of_edges
):
    """``gauss_seidel.forward`` over the owned vertices; r and of_edges become b − L x.

    ``of_edges`` may be None if another forward sweep over the vertices follows at once.
    """
    n, n_owned = Index(len(inverse)), Index(len(ends))
    for row in range(n):
        r[row, 0], r[row, 1], r[row, 2] = b[row, 0], b[row, 1], b[row, 2]
    if of_edges is not None:
        for row in range(n, n_owned):
            of_edges[row, 0], of_edges[row, 1], of_edges[row, 2] = b[row, 0], b[row, 1], b[row, 2]
    for row in range(n):
        lo, hi = Index(indptr[row] + 1), Index(indptr[row + Index(1)])
        first, last = Index(group_ptr[row]), Index(group_ptr[row + Index(1)])
        s0, s1, s2 = gather(blocks, columns, x, lo, hi, AHEAD)
        t0, t1, t2 = gather_edges(groups, columns4, x, first, last, AHEAD_EDGES)
        r0, r1, r2 = r[row, 0] - t0, r[row, 1] - t1, r[row, 2] - t2
        y0, y1, y2 = solved(inverse, row, r0 - s0, r1 - s1, r2 - s2)
        x[row, 0], x[row, 1], x[row, 2] = y0, y1, y2
        scatter(blocks, columns, r, lo, Index(ends[row]), (-y0, -y1, -y2))
        if of_edges is not None:
            scatter_edges(groups, columns4, of_edges, first, last, (-y0, -y1, -y2))


@cached(fastmath=True)
def backward_again(  # type: ignore[no-untyped-def]
    indptr, ends, columns, group_ptr, columns4, blocks, groups, inverse, increment, x, r, of_edges
):
    """Like ``backward_vertices``, but r and of_edges are the full residual b − A x.

    increment (n_vertices, 3) is what the sweep adds to x.
    """
    n = Index(len(inverse))
    for swept in range(n):
        row = n - Index(1) - swept
        lo, hi = Index(indptr[row] + 1), Index(ends[row])
        s0, s1, s2 = gather(blocks, columns, increment, lo, hi, -AHEAD)
        y0, y1, y2 = solved(inverse, row, r[row, 0] - s0, r[row, 1] - s1, r[row, 2] - s2)
        increment[row, 0], increment[row, 1], increment[row, 2] = y0, y1, y2
        x[row, 0] += y0
        x[row, 1] += y1
        x[row, 2] += y2
        r[row, 0] = r[row, 1] = r[row, 2] = 0.0
        scatter(blocks, columns, r, lo, hi, (-y0, -y1, -y2))
        first, last = Index(group_ptr[row]), Index(group_ptr[row + Index(1)])
        scatter_edges(groups, columns4, of_edges, first, last, (-y0, -y1, -y2))


class SweepsWithEdges:
    """``gauss_seidel.BlockSweeps`` with unknowns on edges.

    Parameters
    ----------
    pattern : BlockPattern
    couplings : EdgeCouplings
    memory : (n,) float64, optional
        Holds the copy of the rows in single precision, then the vectors (`memory_sizes`). The vectors' part
        may be used for something else between a call of ``store`` and the next one of ``begin``.

    Attributes
    ----------
    b, x, increment : (n_local, 3)
        Right-hand side, solution, and increment of the solution by a sweep.
    r : (n_local, 4)
        Residual of vertices; the fourth column is padding.
    of_edges : (n_local, 3)
        Residual of edges.
    flops : float
        Operations of a sweep.
    """

    def __init__(
        self,
        pattern: BlockPattern,
        couplings: EdgeCouplings,
        memory: Array | None = None,
    ) -> None:
        self._couplings, self._n_blocks = couplings, pattern.n_blocks
        self._rows = pattern.indptr, pattern.ends, pattern.columns
        self._groups = couplings.groups
        self._entries, self._first = couplings.entries, 3 * couplings.n_vertices
        n, n_local = couplings.n_vertices, pattern.n_local
        rows = np.flatnonzero(pattern.ends < pattern.indptr[1:])
        self._with_ghosts, self._edges_with_ghosts = rows[rows < n], rows[rows >= n]
        self._weight = self._translation_weights(pattern, n)
        of_rows, of_vectors = memory_sizes(pattern)
        memory = np.empty(of_rows + of_vectors) if memory is None else memory
        self._copy = memory[:of_rows].view(np.float32)[: 9 * pattern.n_stored].reshape(-1, 9)
        self._values = couplings.parts(self._copy, pattern.n_blocks)
        self._inverse = np.empty((n, 9), dtype=np.float32)
        self._inverse_of_edges = np.empty(3 * (pattern.n_owned - n), dtype=np.float32)
        vectors = memory[of_rows : of_rows + of_vectors].view(np.float32)
        self._changing = vectors[: 13 * n_local]  # all but b
        self._clean = False
        self.r = vectors[: 4 * n_local].reshape(-1, 4)
        self.x, self.of_edges, self.increment, self.b = vectors[4 * n_local :].reshape(4, -1, 3)
        self.flops = 18.0 * pattern.n_couplings

    def _translation_weights(self, pattern: BlockPattern, n: int) -> NDArray[np.int8]:
        """Weights of the blocks of n vertices in the product tᵀ A t with a translation t of all vertices."""
        of_edges = np.zeros(pattern.n_local, dtype=bool)
        for part in pattern.edges.values():
            of_edges[part.edges // 3] = True
        begin = pattern.indptr[: n + 1]
        columns = pattern.columns[: begin[-1]]
        weight = np.where(columns < n, 2, np.where(of_edges[columns], 0, 1)).astype(np.int8)
        weight[begin[:-1]] = 1
        return weight

    def diagonal(self, values: Array, rows: Ints) -> Array:
        """Blocks (n, 9) of rows (n,) that sweeps invert, from (n_stored, 9); for edges only the diagonal."""
        blocks, edges = np.zeros((len(rows), 9)), rows >= len(self._inverse)
        blocks[~edges] = values[self._rows[0][rows[~edges]]]
        own = self._couplings.diagonal(self._n_blocks).reshape(-1, 3)[rows[edges] - len(self._inverse)]
        blocks[np.flatnonzero(edges)[:, None], [0, 4, 8]] = values.reshape(-1)[own]
        return blocks

    def inertia(self, values: Array) -> Array:
        """Sums (2,) over owned vertices of inertia, and of the stiffness in their softest directions.

        A translation of all vertices is only resisted by inertia. ``values`` (n_stored, 9) are those of
        ``invert``.
        """
        together = _sum_of_traces(self._weight, values)
        softness = self._inverse[:, [0, 4, 8]].sum(axis=1)
        return np.array([together / 3.0, np.sum(1.0 / softness[softness > 0.0])])

    def invert(self, values: Array) -> None:
        """Invert the diagonal of block rows (n_stored, 9)."""
        begin = self._rows[0][: len(self._inverse) + 1]
        invert_diagonal(begin, values, self._inverse)
        entries = self._couplings.parts(values, self._n_blocks).entries
        invert_edge_diagonal(self._entries.indptr, entries, self._inverse_of_edges)

    def store(self, values: Array) -> None:
        """Copy block rows (n_stored, 9), which may overlap the memory of the copy."""
        begin = self._rows[0][: len(self._inverse) + 1]
        own = values.reshape(-1)[self._couplings.diagonal(self._n_blocks)]
        smallest = NEGLIGIBLE * float(own.min(initial=np.inf, where=own > 0.0))
        store(values, min(smallest, negligible_size(begin, values)), self._copy)
        self._clean = False

    def shrink(self, rows: Ints, factor: Array) -> None:
        """Divide the inverses of the diagonal of rows (n,) by ``factor`` (n, 1)."""
        edges = rows >= len(self._inverse)
        self._inverse[rows[~edges]] /= factor[~edges]
        self._inverse_of_edges.reshape(-1, 3)[rows[edges] - len(self._inverse)] /= factor[edges]

    def begin(self, b: Floats) -> None:
        """Set the residual to b (n_local, 3), that of x = 0."""
        n, n_owned = len(self._inverse), len(self._rows[1])
        if not self._clean:
            self._changing[:] = 0.0
            self._clean = True
        begin(b, self.r[:n])
        self.of_edges[n:n_owned] = b[n:n_owned]
        self.r[n_owned:] = 0.0  # ``mult_transpose_add`` adds to ghosts

    def add(self, rows: Ints, more: Floats) -> None:
        """Add to the residual of rows (n,)."""
        edges = rows >= len(self._inverse)
        self.r[rows[~edges], :3] += more[~edges]
        self.of_edges[rows[edges]] += more[edges]

    def backward(self, x: Floats) -> None:
        """Sweep over the edges, then over the vertices."""
        blocks, groups, entries = self._values
        flat = x.reshape(-1), self.of_edges.reshape(-1)
        backward_edges(self._first, *self._entries, entries, self._inverse_of_edges, *flat)
        rows = *self._rows, *self._groups, blocks, groups
        backward_vertices(*rows, self._inverse, x, self.r, self.of_edges)

    def backward_again(self, x: Floats, number: int) -> None:
        """Sweep over the vertices once more, and if ``number`` is even over the edges before that."""
        if number % 2 == 0:
            self.increment[:] = 0.0
            self.backward(self.increment)
            x += self.increment
            return
        blocks, groups, _ = self._values
        rows = *self._rows, *self._groups, blocks, groups
        backward_again(*rows, self._inverse, self.increment, x, self.r, self.of_edges)

    def subtract_ghosts(self, x: Floats) -> None:
        """``gauss_seidel.subtract_ghosts`` for both residuals."""
        subtract_ghosts(self._with_ghosts, *self._rows, self._values.blocks, x, self.r)
        subtract_ghosts(self._edges_with_ghosts, *self._rows, self._values.blocks, x, self.of_edges)

    def correct(self, x: Floats) -> bool:
        """Add the residual of owned edges over their diagonal to x (n_local, 3); True, as x has changed."""
        correct_edges(self._first, self._inverse_of_edges, x.reshape(-1), self.of_edges.reshape(-1))
        return True

    def forward(self, b: Floats, x: Floats, number: int = 0) -> None:
        """Sweep over the vertices, and if ``number`` is even over the edges after that."""
        blocks, groups, entries = self._values
        rows = *self._rows, *self._groups, blocks, groups
        if number % 2:
            forward_vertices(*rows, self._inverse, b, x, self.r, None)
            return
        forward_vertices(*rows, self._inverse, b, x, self.r, self.of_edges)
        with_ghosts = self._edges_with_ghosts
        before = self.of_edges[with_ghosts]
        subtract_ghosts(with_ghosts, *self._rows, blocks, x, self.of_edges)
        of_ghosts = before - self.of_edges[with_ghosts]
        flat = x.reshape(-1), self.of_edges.reshape(-1)
        forward_edges(self._first, *self._entries, entries, self._inverse_of_edges, *flat)
        self.of_edges[with_ghosts] += of_ghosts  # the residual of vertices does not contain ghosts either
