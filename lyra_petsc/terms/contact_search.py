"""Which vertices, edges and triangles of the sheets may come near each other: first patches, then parts."""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel, leaf
from lyra_petsc.mesh import patches
from lyra_petsc.mesh.near import near_in_order
from lyra_petsc.mesh.topology import edge_table
from lyra_petsc.terms.contact_margins import Margins
from lyra_petsc.terms.contact_pairs import EDGE_EDGE, VERTEX_TRIANGLE, approach_bound, distance

SPARE = 0.7
"""Over the reach, how much farther simplices of neighbouring patches are looked for: as long as they do not
come nearer by that, they need not be looked for again."""


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
        return self.corners[np.arange(len(shift)) + shift]


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
        # the vertices of each patch once, as places among the corners of all triangles
        at = np.column_stack([np.repeat(patch, 3), surface.ravel()])
        found, corner = np.unique(at, axis=0, return_index=True)
        self._corners, self._n_own = corner, len(corner)
        self._own_first = np.searchsorted(found[:, 0], np.arange(self._n + 1))
        self._margins = Margins(self._flat.beside, self._own_first)
        self._alone = np.repeat(np.arange(self._n)[:, None], 2, axis=1)
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
        theirs = self.triangles.first[self._n :]
        self._vertices = np.concatenate(
            [triangles.ravel()[self._corners], self.triangles.corners[theirs[0] :].ravel()]
        )
        self._first = np.concatenate([self._own_first, self._n_own + 3 * (theirs[1:] - theirs[0])])
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

    def boxes(self, x: Array, way: Array) -> Array:
        """Low and high corners (4, P, 3) [m] of patches at the start and the end of their ways (N, 3) [m]."""
        out = np.empty((4, len(self._first) - 1, 3))
        _boxes(x, way, self._vertices, self._first, out)
        return out

    def pairs(
        self,
        x: Array,
        way: Array,
        numbers: Ints,
        reach: float,
        edges: float | None = None,
        boxes: Array | None = None,
        most: float = math.inf,
    ) -> Ints | None:
        """Rows (m, 7) of pairs that may come within ``reach`` [m] on their ways: kind, −1, vertices, and what
        is around the triangle; None if there are more than ``most``.

        Two edges within ``edges`` [m], not more than ``reach``. ``boxes`` are those of `boxes`.
        """
        reaches = reach, reach if edges is None else edges
        if len(self._first) == 1:
            return np.empty((0, 7), dtype=np.int64)
        n = len(self._first) - 1
        swept, goes = np.empty((2, n, 3)), np.empty((n, 3))
        _sweep(self.boxes(x, way) if boxes is None else boxes, swept, goes)
        met = np.concatenate([self._alone, near_in_order(swept[0], swept[1], reach)])
        lasting = self._margins.spend(x, way, self._vertices[: self._n_own])
        met, row, known = self._margins.among(met, lasting, *reaches)
        if not len(met):
            return np.empty((0, 7), dtype=np.int64)
        if np.count_nonzero(row >= 0) > self._n:  # to look at gradients takes less time than at simplices
            known = np.maximum(known, self.kept(x, way, met, reaches[1])[:, None])
            self._margins.learn(row, known)
        some = (known < reaches).any(axis=1)
        met, row, known = met[some], row[some], known[some]
        if not len(met):
            return np.empty((0, 7), dtype=np.int64)
        more = np.where(row >= 0, SPARE * reach, 0.0)
        asked = np.zeros((2, n), dtype=np.bool_)
        for column in (0, 1):
            asked[column, met[known[:, column] < reaches[column]]] = True
        given = []
        for of, column in ((self.vertices, 0), (self.edges, 1), (self.triangles, 0)):
            around, whole = np.empty((7, len(of.corners))), np.empty((n, 7))
            _around(x, way, of.corners, of.first, asked[column], goes, around, whole)
            given.append((of.corners, of.first, around, whole))
        while True:
            out, apart = np.empty((self._room, 7), dtype=np.int64), known.copy()
            between = met, known, more, apart, goes
            several = 3 * patches.SIZE, self._rings, most
            found = _pairs(x, way, *between, *given, numbers, *reaches, *several, out)
            if found > most:
                return None
            if found <= self._room:
                self._margins.learn(row, apart)
                return out[:found]
            self._room = found + found // 4

    def kept(self, x: Array, way: Array, met: Ints, least: float) -> Array:
        """Distances (n,) [m] that simplices of pairs of patches met (n, 2) surely keep, without those that
        have a vertex in common: 0 where it may be less than ``least`` [m].
        """
        flat, n, out = self._flat, self._n, np.empty(len(met))
        found: tuple[Array, Array, Array] = np.empty((n, 6)), np.empty(n), np.empty(n)
        place, needs = np.empty(len(met), dtype=np.int64), np.zeros(n, dtype=np.bool_)
        patches.needed(met, flat.pairs, flat.around, flat.reached, place, needs)
        patches.gradients(x, way, self._given, flat.order, flat.first, flat.inverse, needs, *found)
        flats = flat.around, flat.height, flat.reached
        patches.distances_kept(place, least, *flats, np.ascontiguousarray(met[:, 0]), *found, out)
        return out


@kernel()
def _boxes(x, way, vertices, first, out):  # type: ignore[no-untyped-def]
    for p in range(len(first) - 1):
        for k in range(3):
            low = low_then = np.inf
            high = high_then = -np.inf
            for at in range(first[p], first[p + 1]):
                here = x[vertices[at], k]
                to = here + way[vertices[at], k]
                low, high = min(low, here), max(high, here)
                low_then, high_then = min(low_then, to), max(high_then, to)
            out[0, p, k], out[1, p, k], out[2, p, k], out[3, p, k] = low, high, low_then, high_then


@kernel()
def _sweep(boxes, swept, goes):  # type: ignore[no-untyped-def]
    """Boxes around patches all along their ways but for what all of them go together, which brings none
    nearer, from `SheetSearch.boxes`: low and high corners into swept (2, P, 3) [m]; how far the middles of
    their boxes go into goes (P, 3) [m].
    """
    low, high, low_then, high_then = boxes
    for k in range(3):
        drift = 0.0
        for p in range(len(goes)):
            goes[p, k] = 0.5 * (low_then[p, k] + high_then[p, k] - low[p, k] - high[p, k])
            drift += goes[p, k] / len(goes)
        for p in range(len(goes)):
            swept[0, p, k] = min(low[p, k], low_then[p, k] - drift)
            swept[1, p, k] = max(high[p, k], high_then[p, k] - drift)


@kernel()
def _around(x, way, corners, first, asked, goes, out, whole):  # type: ignore[no-untyped-def]
    """Low and high corners [m] of simplices, and how far [m] they go at most beside their patch (P, 3),
    into out (7, n); the same of all of a patch into whole (P, 7). Of patches asked for (P,).
    """
    for p in np.flatnonzero(asked):
        whole[p, :3], whole[p, 3:6], whole[p, 6] = np.inf, -np.inf, 0.0
        for at in range(first[p], first[p + 1]):
            farthest = 0.0
            for k in range(3):
                out[k, at], out[3 + k, at] = np.inf, -np.inf
            for i in corners[at]:
                square = 0.0
                for k in range(3):
                    out[k, at], out[3 + k, at] = min(out[k, at], x[i, k]), max(out[3 + k, at], x[i, k])
                    square += (way[i, k] - goes[p, k]) ** 2
                farthest = max(farthest, square)
            out[6, at] = math.sqrt(farthest)
            for k in range(3):
                whole[p, k] = min(whole[p, k], out[k, at])
                whole[p, 3 + k] = max(whole[p, 3 + k], out[3 + k, at])
            whole[p, 6] = max(whole[p, 6], out[6, at])


@kernel(inline="always")
def _outside(low, high, other_low, other_high):  # type: ignore[no-untyped-def]
    """How far two intervals are from each other."""
    one, other = other_low - high, low - other_high
    apart = one if one > other else other
    return apart if apart > 0.0 else 0.0


@leaf()
def _near(around, a, others, lo, hi, reach, out):  # type: ignore[no-untyped-def]
    """What is left of reach² of boxes lo to hi of others (7, m) around one of around (7, n), into out."""
    x0, y0, z0 = around[0, a], around[1, a], around[2, a]
    x1, y1, z1 = around[3, a], around[4, a], around[5, a]
    x2, y2, z2, x3, y3, z3, way = others[0], others[1], others[2], others[3], others[4], others[5], others[6]
    for n in range(hi - lo):
        b = Index(lo + n)
        x, y = _outside(x0, x1, x2[b], x3[b]), _outside(y0, y1, y2[b], y3[b])
        z, within = _outside(z0, z1, z2[b], z3[b]), reach + way[b]
        out[Index(n)] = within * within - x * x - y * y - z * z


@kernel()
def _pairs(  # type: ignore[no-untyped-def]
    x, way, met, known, more, apart, goes,
    vertices, edges, triangles, numbers, reach, edges_reach, size_of_patch, rings, most, out,
):  # fmt: skip
    """Rows of the near simplices of pairs of patches, as many as fit; how many there are, or more than
    ``most``.

    No patch has more than ``size_of_patch`` vertices, edges or triangles. Vertices and triangles, and edges,
    of a pair of patches that are ``known`` (n, 2) [m] to be apart are looked at where that is less than their
    reach; ``apart`` takes what is known then, which is not beyond their reach and ``more`` (n,) [m]. ``goes``
    is that of `_sweep`, and of vertices, edges and triangles there is what `_around` gives.
    """
    found = 0
    left, p, w = np.empty(size_of_patch), np.empty((4, 3)), np.empty((4, 3))
    points, hits = np.empty(4, np.int64), np.empty(size_of_patch, np.int64)
    for n in range(len(met)):
        if found > most:
            break
        for part in range(3):
            i, j = met[n]
            if part == 1:
                i, j = j, i
                if i == j:
                    continue
            kind, size = (EDGE_EDGE, 2) if part == 2 else (VERTEX_TRIANGLE, 1)
            within, column = (edges_reach, 1) if part == 2 else (reach, 0)
            if known[n, column] >= within:
                continue
            ample = within + more[n]
            if part != 1:
                apart[n, column] = ample
            mine, first, around, _ = edges if part == 2 else vertices
            theirs, begin, others, whole = edges if part == 2 else triangles
            square = 0.0
            for k in range(3):
                square += (goes[i, k] - goes[j, k]) ** 2
            together = ample + math.sqrt(square)
            for a in range(first[i], first[i + 1]):
                start = a + 1 if part == 2 and i == j else begin[j]
                end = begin[j + 1]
                if start == end:
                    continue
                nearer = together + around[6, a]
                far = (nearer + whole[j, 6]) ** 2
                for k in range(3):
                    far -= _outside(around[k, a], around[3 + k, a], whole[j, k], whole[j, 3 + k]) ** 2
                if far < 0.0:
                    continue
                _near(around, a, others, start, end, nearer, left)
                close = 0
                for b in range(end - start):  # written so that no branch is guessed
                    hits[close] = start + b
                    close += 0 if left[b] < 0.0 else 1
                for b in hits[:close]:
                    common = False
                    for k in range(size):
                        points[k] = mine[a, k]
                    for k in range(4 - size):
                        points[size + k] = theirs[b, k]
                        for m in range(size):
                            common |= points[m] == points[size + k]
                    if common:
                        continue
                    for m in range(4):
                        for k in range(3):
                            w[m, k] = way[points[m], k]
                    nearer_by = approach_bound(kind, w)
                    longest = ample + nearer_by
                    if (nearer + others[6, b]) ** 2 - left[b - start] >= longest * longest:
                        continue
                    for m in range(4):
                        for k in range(3):
                            p[m, k] = x[points[m], k]
                    left_over = distance(kind, p) - nearer_by
                    if not left_over >= apart[n, column]:
                        apart[n, column] = left_over
                    if left_over >= within:
                        continue
                    if found < len(out):
                        turned = part == 2 and numbers[points[0]] > numbers[points[2]]
                        out[found, 0], out[found, 1] = kind, -1
                        out[found, 6] = 0 if part == 2 else rings[b]
                        for m in range(4):
                            out[found, 2 + m] = points[(m + 2) % 4 if turned else m]
                    found += 1
    return found
