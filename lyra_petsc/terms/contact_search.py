"""Which vertices, edges and triangles of the sheets may come near each other: first patches, then parts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.kernels.element import kernel
from lyra_petsc.mesh import patches
from lyra_petsc.mesh.near import near
from lyra_petsc.mesh.topology import edge_table
from lyra_petsc.terms.contact_pairs import EDGE_EDGE, VERTEX_TRIANGLE, at_least, distance, speed

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class Simplices:
    """Vertices, edges or triangles (n, m), those of patch p from ``first[p]`` to ``first[p + 1]``."""

    def __init__(self, corners: Ints, patch: Ints, n_patches: int) -> None:
        order: Ints = np.argsort(patch, kind="stable")
        self.order, self.corners = order, np.ascontiguousarray(corners[order])
        self.first = np.searchsorted(patch[order], np.arange(n_patches + 1))

    def of(self, chosen: Ints) -> Ints:
        """Corners of those of some patches (n,)."""
        sizes = self.first[chosen + 1] - self.first[chosen]
        shift = np.repeat(self.first[chosen] - np.cumsum(sizes) + sizes, sizes)
        corners: Ints = self.corners[np.arange(len(shift)) + shift]
        return corners


class SheetSearch:
    """The simplices of the sheets in patches.

    Parameters
    ----------
    surface : (F, 3)
        Triangles of this rank, in local rows.
    uv : (F, 3, 2)
        Material coordinates [m] of their corners.

    Attributes
    ----------
    vertices, edges, triangles : Simplices
        Of the last search.
    """

    def __init__(self, surface: Ints, uv: Array) -> None:
        patch = patches.patches_of(uv.mean(axis=1), patches.connected(surface))
        patch = np.unique(patches.connected(surface, patch), return_inverse=True)[1].astype(np.int64)
        self._patch, self._flat = patch, patches.flat(surface, uv, patch)
        self._n = len(self._flat.first) - 1
        self._given: Ints | None = None
        self._room = 1024

    def take(self, x: Array, numbers: Ints, triangles: Ints, rings: Ints | None = None) -> None:
        """Let the simplices be those of triangles (F, 3), of which this rank's come first.

        x (N, 3) [m] and numbers (N,) are positions and global numbers of all points, rings (F,) what is
        around the triangles, as `surface_shares.rings` has it; 0 where that does not matter.
        """
        if self._given is not None and np.array_equal(triangles, self._given):
            return
        self._given, own = triangles, len(self._patch)
        more = patches.patches_of(x[triangles[own:]].mean(axis=1))
        patch = np.concatenate([self._patch, self._n + more])
        n = self._n + int(more.max(initial=-1)) + 1
        self.triangles = Simplices(triangles, patch, n)
        self._rings = (
            np.zeros(len(triangles), dtype=np.int64) if rings is None else rings[self.triangles.order]
        )
        first = np.full(len(x), n)
        np.minimum.at(first, triangles.ravel(), np.repeat(patch, 3))
        used = np.flatnonzero(first < n)
        self.vertices = Simplices(used[:, None], first[used], n)
        table = edge_table(triangles)
        sides = table.sides[table.first]
        edges = np.column_stack([triangles[sides // 3, sides % 3], triangles[sides // 3, (sides + 1) % 3]])
        edges = np.where((numbers[edges[:, 0]] < numbers[edges[:, 1]])[:, None], edges, edges[:, ::-1])
        least = np.minimum.reduceat(patch[table.sides // 3], table.first) if len(edges) else patch[:0]
        self.edges = Simplices(edges, least, n)

    def boxes(self, x: Array, way: Array) -> tuple[Array, Array]:
        """Low and high corners (P, 3) [m] of what patches pass on their ways (N, 3) [m]."""
        low, high = np.empty((2, len(self.triangles.first) - 1, 3))
        _boxes(x, way, self.triangles.corners, self.triangles.first, low, high)
        return low, high

    def pairs(self, x: Array, way: Array, numbers: Ints, reach: float, edges: float | None = None) -> Ints:
        """Rows (m, 7) of pairs that may come within ``reach`` [m] on their ways: kind, −1, vertices, and what
        is around the triangle.

        Two edges within ``edges`` [m], not more than ``reach``.
        """
        way = way - way.mean(axis=0)  # what all of them go together brings none nearer
        met = near(self.boxes(x, way), reach=reach)
        every = np.repeat(np.arange(len(self.triangles.first) - 1)[:, None], 2, axis=1)
        met = np.concatenate([every, met])
        met = met[~self.apart(x, way, met, reach)]
        given = tuple((of.corners, of.first) for of in (self.vertices, self.edges, self.triangles))
        while True:
            out = np.empty((self._room, 7), dtype=np.int64)
            reaches = reach, reach if edges is None else edges
            found = _pairs(x, way, met, *given, numbers, *reaches, 3 * patches.SIZE, self._rings, out)
            if found <= self._room:
                return out[:found]
            self._room = found + found // 4

    def apart(self, x: Array, way: Array, met: Ints, reach: float) -> NDArray[np.bool_]:
        flat, n = self._flat, self._n
        found: tuple[Array, Array, Array] = np.empty((n, 6)), np.empty(n), np.empty(n)
        each = np.empty((2, len(flat.order), 6))
        patches.gradients(x, way, self._given, flat.order, flat.first, flat.inverse, each, *found)
        out = np.empty(len(met), dtype=np.bool_)
        patches.keep_apart(met, reach, flat.pairs, flat.around, flat.height, flat.reached, *found, out)
        return out


@kernel()
def _boxes(x, way, corners, first, low, high):  # type: ignore[no-untyped-def]
    for p in range(len(low)):
        low[p], high[p] = np.inf, -np.inf
        for at in range(first[p], first[p + 1]):
            _enclose(x, way, corners[at], low[p], high[p])


@kernel()
def _enclose(x, way, corners, low, high):  # type: ignore[no-untyped-def]
    for i in corners:
        for k in range(3):
            at = x[i, k]
            to = at + way[i, k]
            low[k], high[k] = min(low[k], at, to), max(high[k], at, to)


@kernel()
def _each_box(x, way, corners, lo, hi, box):  # type: ignore[no-untyped-def]
    """Low and high corners of simplices lo to hi into box (n, 2, 3)."""
    for n in range(hi - lo):
        box[n, 0], box[n, 1] = np.inf, -np.inf
        _enclose(x, way, corners[lo + n], box[n, 0], box[n, 1])


@kernel(inline="always")
def _far(one, other, square):  # type: ignore[no-untyped-def]
    left = square
    for k in range(3):
        apart = max(other[0, k] - one[1, k], one[0, k] - other[1, k], 0.0)
        left -= apart * apart
    return left < 0.0


@kernel()
def _pairs(x, way, met, vertices, edges, triangles, numbers, reach, edges_reach, most, rings, out):  # type: ignore[no-untyped-def]  # fmt: skip
    """Rows of the near simplices of pairs of patches, as many as fit; how many there are.

    No patch has more than ``most`` vertices, edges or triangles.
    """
    found = 0
    one, other, whole = np.empty((most, 2, 3)), np.empty((most, 2, 3)), np.empty((2, 3))
    p, w, points = np.empty((4, 3)), np.empty((4, 3)), np.empty(4, np.int64)
    for n in range(len(met)):
        for part in range(3):
            i, j = met[n]
            if part == 1:
                i, j = j, i
                if i == j:
                    continue
            kind, size = (EDGE_EDGE, 2) if part == 2 else (VERTEX_TRIANGLE, 1)
            within = edges_reach if part == 2 else reach
            square = within * within
            mine, first = edges if part == 2 else vertices
            theirs, begin = edges if part == 2 else triangles
            _each_box(x, way, mine, first[i], first[i + 1], one)
            _each_box(x, way, theirs, begin[j], begin[j + 1], other)
            whole[0], whole[1] = np.inf, -np.inf
            for b in range(begin[j + 1] - begin[j]):
                for k in range(3):
                    whole[0, k] = min(whole[0, k], other[b, 0, k])
                    whole[1, k] = max(whole[1, k], other[b, 1, k])
            for a in range(first[i + 1] - first[i]):
                if _far(one[a], whole, square):
                    continue
                start = a + 1 if part == 2 and i == j else 0
                for b in range(start, begin[j + 1] - begin[j]):
                    if _far(one[a], other[b], square):
                        continue
                    common = False
                    for k in range(size):
                        points[k] = mine[first[i] + a, k]
                    for k in range(4 - size):
                        points[size + k] = theirs[begin[j] + b, k]
                        for m in range(size):
                            common |= points[m] == points[size + k]
                    if common:
                        continue
                    for m in range(4):
                        for k in range(3):
                            p[m, k], w[m, k] = x[points[m], k], way[points[m], k]
                    left = within + speed(kind, w)
                    if at_least(p, kind) >= left or distance(kind, p) >= left:
                        continue
                    if found < len(out):
                        turned = part == 2 and numbers[points[0]] > numbers[points[2]]
                        out[found, 0], out[found, 1] = kind, -1
                        out[found, 6] = 0 if part == 2 else rings[begin[j] + b]
                        for m in range(4):
                            out[found, 2 + m] = points[(m + 2) % 4 if turned else m]
                    found += 1
    return found
