"""How the directors of edges follow the vertices when no triangle's bending is to change, on the average.

As vertices move by u the normal n of a triangle turns about its edge i by −Σ_c ω_ic n · u_c, ω as in
``midedge_energy``. The director of an edge follows the mean of its triangles. Coarse levels of multigrid have
no unknowns of edges: without this they would bend a sheet whose directors stand still, which is stiffer than
the sheet by (size / edge)². Rigid motions are followed exactly. All in single precision, as what sweeps read.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.kernels.element import kernel
from lyra_petsc.terms.hinge import dot, point, scaled
from lyra_petsc.terms.midedge import MidEdge
from lyra_petsc.terms.midedge_shape import edges_of

Floats = NDArray[np.float32]


@kernel()
def _set(x, stencil, edges, sign, share, out):  # type: ignore[no-untyped-def]
    """n, −e_i · e_c / 2A of 01, 02, 12 and −sign share / |e_i| of triangles (E, 3) into out (E, 9); 0 without
    a normal.
    """
    for e in range(stencil.shape[0]):
        x0, x1, x2 = point(x, stencil[e, 0]), point(x, stencil[e, 1]), point(x, stencil[e, 2])
        e0, e1, e2, normal, square = edges_of(x0, x1, x2)
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
def _follow(stencil, places, turns, x):  # type: ignore[no-untyped-def]
    """Add to the edges' unknowns of x (n_local, 3) what its vertices make of them."""
    flat = x.reshape(-1)
    for e in range(Index(len(stencil))):
        n0, n1, n2 = turns[e, 0], turns[e, 1], turns[e, 2]
        a, b, c = Index(stencil[e, 0]), Index(stencil[e, 1]), Index(stencil[e, 2])
        h0 = n0 * x[a, 0] + n1 * x[a, 1] + n2 * x[a, 2]
        h1 = n0 * x[b, 0] + n1 * x[b, 1] + n2 * x[b, 2]
        h2 = n0 * x[c, 0] + n1 * x[c, 1] + n2 * x[c, 2]
        # the edges' sum is 0, so that of ω over the corners is, too
        d01, d02, d12 = turns[e, 3] * (h1 - h0), turns[e, 4] * (h2 - h0), turns[e, 5] * (h2 - h1)
        p, q, r = Index(places[e, 0]), Index(places[e, 1]), Index(places[e, 2])
        flat[p] += turns[e, 6] * (d01 + d02)
        flat[q] += turns[e, 7] * (d12 - d01)
        flat[r] -= turns[e, 8] * (d02 + d12)


@cached(fastmath=True)
def _gather(stencil, places, turns, of_edges, r):  # type: ignore[no-untyped-def]
    """Add to the vertices of r (n_local, 4) what the transpose of ``_follow`` makes of edges (n_local, 3)."""
    flat = of_edges.reshape(-1)
    for e in range(Index(len(stencil))):
        p, q, s = Index(places[e, 0]), Index(places[e, 1]), Index(places[e, 2])
        f0, f1, f2 = turns[e, 6] * flat[p], turns[e, 7] * flat[q], turns[e, 8] * flat[s]
        d01, d02, d12 = turns[e, 3] * (f0 - f1), turns[e, 4] * (f0 - f2), turns[e, 5] * (f1 - f2)
        h0, h1, h2 = -d01 - d02, d01 - d12, d02 + d12
        n0, n1, n2 = turns[e, 0], turns[e, 1], turns[e, 2]
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


class EdgeTurns:
    """The linear map T from movements of vertices to those of this rank's edge unknowns, and its transpose.

    Parameters
    ----------
    term : MidEdge
    n_owned : int
        Block rows that this rank owns.
    """

    def __init__(self, term: MidEdge, n_owned: int) -> None:
        assert term.edges is not None
        self._term, self._n_unknowns = term, 3 * n_owned
        self._stencil, self._places = term.stencil, term.edges
        self._share = self._shares(term.of_edges.places >= 3 * n_owned)
        self._turns = np.zeros((len(term.edges), 9), dtype=np.float32)

    def _shares(self, without: Mask) -> Floats:
        """Length [m] of each edge (n,) by its number of triangles; 0 ``without`` turns."""
        _, _, length, edges = self._term.of_edges
        # all triangles of an edge that this rank owns are here
        share: Floats = (length / np.bincount(edges.ravel(), minlength=len(length))).astype(np.float32)
        share[without] = 0.0
        return share

    def hold(self, held: Mask) -> None:
        """Let unknowns that are held (n_local, 3) not follow."""
        places = self._term.of_edges.places
        self._share = self._shares(held.ravel()[places] | (places >= self._n_unknowns))

    def set(self, x: Array) -> None:
        """Take positions x (n_local, 3)."""
        edges, sign = self._term.of_edges.of_triangles, self._term.elements.data["sign"]
        _set(x, self._stencil, edges, sign, self._share, self._turns)

    def follow(self, x: Floats) -> None:
        """Add to x (n_local, 3), all 0 in the edges' unknowns, what its vertices make of those owned."""
        _follow(self._stencil, self._places, self._turns, x)

    def gather(self, of_edges: Floats, r: Floats) -> None:
        """Add to the vertices, ghosts too, of r (n_local, 4) the transpose times edges' (n_local, 3)."""
        _gather(self._stencil, self._places, self._turns, of_edges, r)
