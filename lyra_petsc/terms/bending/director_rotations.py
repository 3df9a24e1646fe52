"""Rotations of directors with the normals of their triangles, as a linear map of displacements of vertices.

When vertices are displaced by u the normal n of a triangle rotates about its edge i by −Σ_c ω_ic n · u_c,
ω as in ``midedge_energy``. Here the director of an edge rotates by the mean over its triangles, so that their
mean bending does not change; in rigid motions nothing bends. Coarse levels of multigrid have no
unknowns of edges. Without this map their corrections would bend a sheet with fixed directors, which is
stiffer than the sheet by (size / edge)². Arrays are in single precision, as those of the smoother.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.kernels.element import kernel
from lyra_petsc.kernels.vector3 import dot, point, scaled
from lyra_petsc.terms.bending.midedge import MidEdge
from lyra_petsc.terms.bending.midedge_shape import edges_and_normal

Floats = NDArray[np.float32]


@kernel()
def _write_factors(x, stencil, edges, sign, share, out):  # type: ignore[no-untyped-def]
    """Write the factors of triangles (E, 3) into out (E, 9); all 0 for a triangle without a normal.

    They are n, −e_i · e_c / 2A for the pairs 01, 02, 12, and −sign share / |e_i| for the three edges.
    """
    for e in range(stencil.shape[0]):
        x0, x1, x2 = point(x, stencil[e, 0]), point(x, stencil[e, 1]), point(x, stencil[e, 2])
        e0, e1, e2, normal, square = edges_and_normal(x0, x1, x2)
        if not square > 0.0:
            out[e, :] = 0.0
            continue
        inverse = 1.0 / math.sqrt(square)
        out[e, 0], out[e, 1], out[e, 2] = scaled(inverse, normal)
        out[e, 3], out[e, 4], out[e, 5] = scaled(-inverse, (dot(e0, e1), dot(e0, e2), dot(e1, e2)))
        out[e, 6] = -sign[e, 0] * share[edges[e, 0]] / math.sqrt(dot(e0, e0))
        out[e, 7] = -sign[e, 1] * share[edges[e, 1]] / math.sqrt(dot(e1, e1))
        out[e, 8] = -sign[e, 2] * share[edges[e, 2]] / math.sqrt(dot(e2, e2))


@cached(fastmath=True)
def _mult_add(stencil, indices, factors, x):  # type: ignore[no-untyped-def]
    """Add the rotations due to the displacements of vertices in x (n_local, 3) to its edge unknowns."""
    flat = x.reshape(-1)
    for e in range(Index(len(stencil))):
        n0, n1, n2 = factors[e, 0], factors[e, 1], factors[e, 2]
        a, b, c = Index(stencil[e, 0]), Index(stencil[e, 1]), Index(stencil[e, 2])
        h0 = n0 * x[a, 0] + n1 * x[a, 1] + n2 * x[a, 2]
        h1 = n0 * x[b, 0] + n1 * x[b, 1] + n2 * x[b, 2]
        h2 = n0 * x[c, 0] + n1 * x[c, 1] + n2 * x[c, 2]
        # the edges sum to 0, hence also ω over the corners
        d01, d02, d12 = factors[e, 3] * (h1 - h0), factors[e, 4] * (h2 - h0), factors[e, 5] * (h2 - h1)
        p, q, r = Index(indices[e, 0]), Index(indices[e, 1]), Index(indices[e, 2])
        flat[p] += factors[e, 6] * (d01 + d02)
        flat[q] += factors[e, 7] * (d12 - d01)
        flat[r] -= factors[e, 8] * (d02 + d12)


@cached(fastmath=True)
def _mult_transpose_add(stencil, indices, factors, of_edges, r):  # type: ignore[no-untyped-def]
    """Add the transposed map times ``of_edges`` (n_local, 3) to the vertices of r (n_local, 4)."""
    flat = of_edges.reshape(-1)
    for e in range(Index(len(stencil))):
        p, q, s = Index(indices[e, 0]), Index(indices[e, 1]), Index(indices[e, 2])
        f0, f1, f2 = factors[e, 6] * flat[p], factors[e, 7] * flat[q], factors[e, 8] * flat[s]
        d01, d02, d12 = factors[e, 3] * (f0 - f1), factors[e, 4] * (f0 - f2), factors[e, 5] * (f1 - f2)
        h0, h1, h2 = -d01 - d02, d01 - d12, d02 + d12
        n0, n1, n2 = factors[e, 0], factors[e, 1], factors[e, 2]
        a, b, c = Index(stencil[e, 0]), Index(stencil[e, 1]), Index(stencil[e, 2])
        r[a, 0] += h0 * n0
        r[a, 1] += h0 * n1
        r[a, 2] += h0 * n2
        r[b, 0] += h1 * n0
        r[b, 1] += h1 * n1
        r[b, 2] += h1 * n2
        r[c, 0] += h2 * n0
        r[c, 1] += h2 * n1
        r[c, 2] += h2 * n2


class DirectorRotations:
    """The linear map T from displacements of vertices to increments of owned edge unknowns; its transpose.

    Parameters
    ----------
    term : MidEdge
    n_owned : int
        Number of block rows that this rank owns.
    """

    def __init__(self, term: MidEdge, n_owned: int) -> None:
        assert term.edges is not None
        self._term, self._n_unknowns = term, 3 * n_owned
        self._stencil, self._indices = term.stencil, term.edges
        self._share = self._shares(term.of_edges.indices >= 3 * n_owned)
        self._factors = np.zeros((len(term.edges), 9), dtype=np.float32)

    def _shares(self, without: Mask) -> Floats:
        """Length [m] of each edge (n,) over its number of triangles; 0 for edges ``without`` a rotation."""
        _, _, length, edges = self._term.of_edges
        # this rank has all triangles of the edges that it owns
        share: Floats = (length / np.bincount(edges.ravel(), minlength=len(length))).astype(np.float32)
        share[without] = 0.0
        return share

    def exclude(self, held: Mask) -> None:
        """Exclude the prescribed unknowns ``held`` (n_local, 3) from the map."""
        indices = self._term.of_edges.indices
        self._share = self._shares(held.ravel()[indices] | (indices >= self._n_unknowns))

    def update(self, x: Array) -> None:
        """Compute the map at positions x (n_local, 3)."""
        edges, sign = self._term.of_edges.of_triangles, self._term.elements.data["sign"]
        _write_factors(x, self._stencil, edges, sign, self._share, self._factors)

    def mult_add(self, x: Floats) -> None:
        """Add T times the displacements of vertices in x (n_local, 3) to its owned edge unknowns."""
        _mult_add(self._stencil, self._indices, self._factors, x)

    def mult_transpose_add(self, of_edges: Floats, r: Floats) -> None:
        """Add Tᵀ times ``of_edges`` (n_local, 3) to the vertices of r (n_local, 4), ghosts included."""
        _mult_transpose_add(self._stencil, self._indices, self._factors, of_edges, r)
