"""Search for near vertices, edges and triangles of the sheets: first pairs of patches, then of their
simplices.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact import patches
from lyra_petsc.contact.distance_bounds import DistanceBounds
from lyra_petsc.contact.near import near_pairs_by_tree
from lyra_petsc.contact.pair_distances import EDGE_EDGE, VERTEX_TRIANGLE, approach_bound, distance
from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import inlined, kernel, leaf
from lyra_petsc.mesh.topology import connected_pieces, edge_table

EXTRA_RADIUS = 0.7
"""Additional search radius for neighbouring patches over the radius: their simplices are not searched again
before they have approached each other by so much."""


class Simplices:
    """Vertices, edges or triangles (n, m) in the order of patches: those of patch p are first[p] to first[p +
    1].
    """

    def __init__(self, corners: Ints, patch: Ints, n_patches: int) -> None:
        order: Ints = np.argsort(patch, kind="stable")
        self.order, self.corners = order, np.ascontiguousarray(corners[order])
        self.first = np.searchsorted(patch[order], np.arange(n_patches + 1))

    def corners_of(self, chosen: Ints) -> Ints:
        """Corners of the simplices of some patches (n,)."""
        sizes = self.first[chosen + 1] - self.first[chosen]
        shift = np.repeat(self.first[chosen] - np.cumsum(sizes) + sizes, sizes)
        return self.corners[np.arange(len(shift)) + shift]


class SheetSearch:
    """Search for near simplices of the sheets, which are split into patches.

    Parameters
    ----------
    surface : (F, 3)
        Triangles of this rank, in local rows.
    uv : (F, 3, 2)
        Material coordinates [m] of their corners.

    Attributes
    ----------
    vertices, edges, triangles : Simplices
        Simplices of the last search.
    """

    def __init__(self, surface: Ints, uv: Array) -> None:
        patch = patches.split_into_patches(uv.mean(axis=1), connected_pieces(surface))
        patch = connected_pieces(surface, patch)
        self._patch, self._n = patch, int(patch.max(initial=-1)) + 1
        # the vertices of each patch once, as places among the corners of all triangles
        patch_corners = np.column_stack([np.repeat(patch, 3), surface.ravel()])
        patch_vertices, corner = np.unique(patch_corners, axis=0, return_index=True)
        self._corners, self._n_own = corner, len(corner)
        self._own_first = np.searchsorted(patch_vertices[:, 0], np.arange(self._n + 1))
        self._bounds = DistanceBounds(patches.neighbouring_patches(surface, uv, patch), self._own_first)
        self._same_patch = np.repeat(np.arange(self._n)[:, None], 2, axis=1)
        self._triangles: Ints | None = None
        self._capacity = 1024

    def set_triangles(self, x: Array, numbers: Ints, triangles: Ints, rings: Ints | None = None) -> None:
        """Set the triangles (F, 3) to be searched, of which this rank's come first.

        x (N, 3) [m] and numbers (N,) are positions and global numbers of all points, rings (F,) the codes
        from `surface_shares.rings`; 0 if they do not matter.
        """
        if self._triangles is not None and np.array_equal(triangles, self._triangles):
            return
        self._triangles, n_own = triangles, len(self._patch)
        other_patch = patches.split_into_patches(x[triangles[n_own:]].mean(axis=1))
        patch = np.concatenate([self._patch, self._n + other_patch])
        n = self._n + int(other_patch.max(initial=-1)) + 1
        self.triangles = Simplices(triangles, patch, n)
        other_first = self.triangles.first[self._n :]
        self._vertices = np.concatenate(
            [triangles.ravel()[self._corners], self.triangles.corners[other_first[0] :].ravel()]
        )
        self._first = np.concatenate([self._own_first, self._n_own + 3 * (other_first[1:] - other_first[0])])
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
        lowest_patch = np.minimum.reduceat(patch[table.sides // 3], table.first) if len(edges) else patch[:0]
        self.edges = Simplices(edges, lowest_patch, n)

    def boxes(self, x: Array, dx: Array) -> Array:
        """Low and high corners (4, P, 3) [m] of patches at the start and at the end of displacements dx (N,
        3) [m].
        """
        out = np.empty((4, len(self._first) - 1, 3))
        _boxes(x, dx, self._vertices, self._first, out)
        return out

    def pairs(
        self,
        x: Array,
        dx: Array,
        numbers: Ints,
        radius: float,
        edge_radius: float | None = None,
        boxes: Array | None = None,
        limit: float = math.inf,
    ) -> Ints | None:
        """Rows (m, 7) of pairs that may come within ``radius`` [m] on displacements dx (N, 3) [m]: kind, −1,
        four vertices, and the code of the triangle's surroundings. None if there are more than ``limit``.

        Two edges must come within ``edge_radius`` [m], at most ``radius``. ``boxes`` are those from `boxes`.
        """
        radii = radius, radius if edge_radius is None else edge_radius
        if len(self._first) == 1:
            return np.empty((0, 7), dtype=np.int64)
        n = len(self._first) - 1
        swept, drift = np.empty((2, n, 3)), np.empty((n, 3))
        _swept_boxes(self.boxes(x, dx) if boxes is None else boxes, swept, drift)
        patch_pairs = np.concatenate([self._same_patch, near_pairs_by_tree(swept[0], swept[1], radius)])
        path_bounds = self._bounds.update(x, dx, self._vertices[: self._n_own])
        patch_pairs, row, known = self._bounds.select(patch_pairs, path_bounds, *radii)
        if not len(patch_pairs):
            return np.empty((0, 7), dtype=np.int64)
        close = (known < radii).any(axis=1)
        patch_pairs, row, known = patch_pairs[close], row[close], known[close]
        if not len(patch_pairs):
            return np.empty((0, 7), dtype=np.int64)
        extra = np.where(row >= 0, EXTRA_RADIUS * radius, 0.0)
        needed = np.zeros((2, n), dtype=np.bool_)
        for column in (0, 1):
            needed[column, patch_pairs[known[:, column] < radii[column]]] = True
        simplices = []
        for group, column in ((self.vertices, 0), (self.edges, 1), (self.triangles, 0)):
            boxes_of, patch_boxes = np.empty((7, len(group.corners))), np.empty((n, 7))
            _simplex_boxes(x, dx, group.corners, group.first, needed[column], drift, boxes_of, patch_boxes)
            simplices.append((group.corners, group.first, boxes_of, patch_boxes))
        while True:
            out, new_bounds = np.empty((self._capacity, 7), dtype=np.int64), known.copy()
            between = patch_pairs, known, extra, new_bounds, drift
            constants = 3 * patches.MAX_TRIANGLES, self._rings, float(limit)
            n_pairs = _find_pairs(x, dx, *between, *simplices, numbers, *radii, *constants, out)
            if n_pairs > limit:
                return None
            if n_pairs <= self._capacity:
                self._bounds.raise_to(row, new_bounds)
                return out[:n_pairs]
            self._capacity = n_pairs + n_pairs // 4


@kernel()
def _boxes(x, dx, vertices, first, out):  # type: ignore[no-untyped-def]
    for p in range(len(first) - 1):
        for k in range(3):
            low = low_end = np.inf
            high = high_end = -np.inf
            for at in range(first[p], first[p + 1]):
                start = x[vertices[at], k]
                end = start + dx[vertices[at], k]
                low, high = min(low, start), max(high, start)
                low_end, high_end = min(low_end, end), max(high_end, end)
            out[0, p, k], out[1, p, k], out[2, p, k], out[3, p, k] = low, high, low_end, high_end


@kernel()
def _swept_boxes(boxes, swept, drift):  # type: ignore[no-untyped-def]
    """Boxes around patches on their displacements relative to the mean of all patches, which brings none
    nearer.

    From boxes as of `SheetSearch.boxes`: low and high corners to swept (2, P, 3) [m], and the mean
    displacements of the centres of the boxes to drift (P, 3) [m].
    """
    low, high, low_end, high_end = boxes
    for k in range(3):
        mean = 0.0
        for p in range(len(drift)):
            drift[p, k] = 0.5 * (low_end[p, k] + high_end[p, k] - low[p, k] - high[p, k])
            mean += drift[p, k] / len(drift)
        for p in range(len(drift)):
            swept[0, p, k] = min(low[p, k], low_end[p, k] - mean)
            swept[1, p, k] = max(high[p, k], high_end[p, k] - mean)


@kernel()
def _simplex_boxes(x, dx, corners, first, needed, drift, out, patch_box):  # type: ignore[no-untyped-def]
    """Low and high corners [m] of simplices and their largest displacement [m] relative to the drift of the
    patch, to out (7, n); the same for whole patches to patch_box (P, 7). For patches that are needed (P,).
    """
    for p in np.flatnonzero(needed):
        patch_box[p, :3], patch_box[p, 3:6], patch_box[p, 6] = np.inf, -np.inf, 0.0
        for at in range(first[p], first[p + 1]):
            largest = 0.0
            for k in range(3):
                out[k, at], out[3 + k, at] = np.inf, -np.inf
            for i in corners[at]:
                square = 0.0
                for k in range(3):
                    out[k, at], out[3 + k, at] = min(out[k, at], x[i, k]), max(out[3 + k, at], x[i, k])
                    square += (dx[i, k] - drift[p, k]) ** 2
                largest = max(largest, square)
            out[6, at] = math.sqrt(largest)
            for k in range(3):
                patch_box[p, k] = min(patch_box[p, k], out[k, at])
                patch_box[p, 3 + k] = max(patch_box[p, 3 + k], out[3 + k, at])
            patch_box[p, 6] = max(patch_box[p, 6], out[6, at])


@inlined()
def _interval_distance(low, high, other_low, other_high):  # type: ignore[no-untyped-def]
    """Distance of two intervals; 0 if they overlap."""
    above, below = other_low - high, low - other_high
    distance = above if above > below else below
    return distance if distance > 0.0 else 0.0


@leaf()
def _box_margins(boxes, a, others, lo, hi, radius, out):  # type: ignore[no-untyped-def]
    """Radius² less the squared distance of box ``a`` of boxes (7, n) from boxes lo to hi of others (7, m), to
    out.
    """
    x0, y0, z0 = boxes[0, a], boxes[1, a], boxes[2, a]
    x1, y1, z1 = boxes[3, a], boxes[4, a], boxes[5, a]
    x2, y2, z2, x3, y3, z3 = others[0], others[1], others[2], others[3], others[4], others[5]
    motion = others[6]
    for n in range(hi - lo):
        b = Index(lo + n)
        x, y = _interval_distance(x0, x1, x2[b], x3[b]), _interval_distance(y0, y1, y2[b], y3[b])
        z, limit = _interval_distance(z0, z1, z2[b], z3[b]), radius + motion[b]
        out[Index(n)] = limit * limit - x * x - y * y - z * z


@kernel()
def _find_pairs(  # type: ignore[no-untyped-def]
    x, dx, patch_pairs, known, extra, new_bounds, drift,
    vertices, edges, triangles, numbers, radius, edge_radius, size_of_patch, rings, limit, out,
):  # fmt: skip
    """Write rows of near simplices of pairs of patches, as many as fit; returns their number, or more than
    ``limit``.

    No patch has more than ``size_of_patch`` vertices, edges or triangles. For each pair of patches, vertices
    and triangles, and edges, are compared if the ``known`` bound (n, 2) [m] is below their radius.
    ``new_bounds`` (n, 2) [m] then gets the bound that was found, at most radius + ``extra`` (n,) [m].
    ``drift`` is from `_swept_boxes`, the boxes of vertices, edges and triangles are from `_simplex_boxes`.
    """
    n_pairs = 0
    margin, p, w = np.empty(size_of_patch), np.empty((4, 3)), np.empty((4, 3))
    points, hits = np.empty(4, np.int64), np.empty(size_of_patch, np.int64)
    for n in range(len(patch_pairs)):
        if n_pairs > limit:
            break
        for part in range(3):
            i, j = patch_pairs[n]
            if part == 1:
                i, j = j, i
                if i == j:
                    continue
            kind, size = (EDGE_EDGE, 2) if part == 2 else (VERTEX_TRIANGLE, 1)
            limit_radius, column = (edge_radius, 1) if part == 2 else (radius, 0)
            if known[n, column] >= limit_radius:
                continue
            wide_radius = limit_radius + extra[n]
            if part != 1:
                new_bounds[n, column] = wide_radius
            own, own_first, own_boxes, _ = edges if part == 2 else vertices
            other, other_first, other_boxes, patch_boxes = edges if part == 2 else triangles
            square = 0.0
            for k in range(3):
                square += (drift[i, k] - drift[j, k]) ** 2
            wide_reach = wide_radius + math.sqrt(square)
            for a in range(own_first[i], own_first[i + 1]):
                start = a + 1 if part == 2 and i == j else other_first[j]
                end = other_first[j + 1]
                if start == end:
                    continue
                reach = wide_reach + own_boxes[6, a]
                rest = (reach + patch_boxes[j, 6]) ** 2
                for k in range(3):
                    low, high = own_boxes[k, a], own_boxes[3 + k, a]
                    rest -= _interval_distance(low, high, patch_boxes[j, k], patch_boxes[j, 3 + k]) ** 2
                if rest < 0.0:
                    continue
                _box_margins(own_boxes, a, other_boxes, start, end, reach, margin)
                n_hits = 0
                for b in range(end - start):  # without a branch that is hard to predict
                    hits[n_hits] = start + b
                    n_hits += 0 if margin[b] < 0.0 else 1
                for b in hits[:n_hits]:
                    shared = False
                    for k in range(size):
                        points[k] = own[a, k]
                    for k in range(4 - size):
                        points[size + k] = other[b, k]
                        for m in range(size):
                            shared |= points[m] == points[size + k]
                    if shared:
                        continue
                    for m in range(4):
                        for k in range(3):
                            w[m, k] = dx[points[m], k]
                    approach = approach_bound(kind, w)
                    longest = wide_radius + approach
                    if (reach + other_boxes[6, b]) ** 2 - margin[b - start] >= longest * longest:
                        continue
                    for m in range(4):
                        for k in range(3):
                            p[m, k] = x[points[m], k]
                    bound = distance(kind, p) - approach
                    if not bound >= new_bounds[n, column]:
                        new_bounds[n, column] = bound
                    if bound >= limit_radius:
                        continue
                    if n_pairs < len(out):
                        swapped = part == 2 and numbers[points[0]] > numbers[points[2]]
                        out[n_pairs, 0], out[n_pairs, 1] = kind, -1
                        out[n_pairs, 6] = 0 if part == 2 else rings[b]
                        for m in range(4):
                            out[n_pairs, 2 + m] = points[(m + 2) % 4 if swapped else m]
                    n_pairs += 1
    return n_pairs
