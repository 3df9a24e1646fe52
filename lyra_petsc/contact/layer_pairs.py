"""Pairs of parts of surfaces that lie above each other, as layers do, and on which side each is to lie.

Heights are measured along directions that vary slowly: vertex normals, averaged over a neighbourhood
wider than usual overlaps, so that a dent does not turn them. Along a direction, a vertex lies above or
below a triangle, and an edge above or below an edge that it passes in the projection. Surfaces in which no
such pair changes sides do not cross.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.contact.joined import JoinedVertices
from lyra_petsc.contact.near import overlapping_pairs
from lyra_petsc.mesh.topology import connected_components, connected_pieces, enclosed_volumes, unique_edges

SMOOTHING = 60
"""Rounds in which each normal is averaged with its neighbours': over about eight edges."""

STEEP = 0.2
"""Cosine between direction and normal of a triangle below which it does not lie above or below anything."""

TILT = 0.1
"""Tangent of the angle by which directions may be wrong: vertices of sheets that pass triangles of sheets by
that part of the height count as above or below them."""

REACH, PART = 8.0, 1.0 / 6.0
"""Height up to which pairs are known: over the mean edge, and at most over the size of the smallest piece."""

BODY, BODY_SMOOTHING = 0.5, 3
"""The same over the radius of a sphere with a closed obstacle's ratio of volume and area, and rounds in which
normals of obstacles are averaged: their dents are meant."""

OTHER_SURFACE = 2.0
"""Height over the least one of the same part from which on it is that of another surface behind."""

RINGS = 30
"""Width, in edges, of the patches around a contour in which a sheet crosses itself."""


Boxes: TypeAlias = tuple[Array, Array]
"""Low and high corners (n, 3) [m]."""


class Surfaces(NamedTuple):
    """Triangles of all sheets, then those of obstacles.

    Attributes
    ----------
    triangles : (F, 3) int64
    edges : (E, 2) int64
    piece : (V,) int64
        Number of the connected piece of each point; those of sheets come first.
    n_sheets : int
        Number of pieces that are sheets.
    outward : (pieces,) float64
        For closed obstacles 1 or −1: sign by which normals point outwards; else 0.
    normals : (V, 3) float64
        Directions of height.
    area : (V,) float64
        A third of the area of the triangles at each point [m²].
    reach : float
        Height [m] up to which pairs are known.
    """

    triangles: Ints
    edges: Ints
    piece: Ints
    n_sheets: int
    outward: Array
    normals: Array
    area: Array
    reach: float

    @classmethod
    def build(cls, points: Array, triangles: Ints, n_sheet_triangles: int) -> Surfaces:
        """From points (V, 3) [m] and triangles (F, 3), of which those of sheets come first."""
        of_sheet = connected_pieces(triangles[:n_sheet_triangles])
        n_sheets = int(of_sheet.max()) + 1
        of_obstacle = connected_pieces(triangles[n_sheet_triangles:])
        of_triangle = np.concatenate([of_sheet, of_obstacle + n_sheets])
        piece = np.zeros(len(points), dtype=np.int64)
        piece[triangles] = of_triangle[:, None]
        volume = enclosed_volumes(points, triangles, of_triangle)
        outward = np.where(np.arange(len(volume)) >= n_sheets, np.sign(volume), 0.0)
        corners = points[triangles]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        cross *= np.where(outward < 0.0, -1.0, 1.0)[of_triangle][:, None]
        edges = unique_edges(triangles)
        normals = unit(_summed(triangles.ravel(), np.repeat(cross, 3, axis=0), len(points)))
        rigid = (piece >= n_sheets)[:, None]
        for number in range(SMOOTHING):
            sums = normals + _summed(edges.T.ravel(), normals[edges[:, ::-1].T.ravel()], len(points))
            normals = np.where(rigid & (number >= BODY_SMOOTHING), normals, unit(sums))
        double_area = np.repeat(np.linalg.norm(cross, axis=1), 3)
        area: Array = np.bincount(triangles.ravel(), double_area / 6.0, len(points)).astype(np.float64)
        of_sheets = edges[piece[edges[:, 0]] < n_sheets]
        length = np.linalg.norm(points[of_sheets[:, 1]] - points[of_sheets[:, 0]], axis=1)
        sizes = [float(np.linalg.norm(np.ptp(points[piece == k], axis=0))) for k in range(len(volume))]
        surface = np.bincount(of_triangle, 0.5 * np.linalg.norm(cross, axis=1))
        bodies = outward != 0.0
        sizes += (BODY * 3.0 * np.abs(volume)[bodies] / surface[bodies] / PART).tolist()
        reach = min(REACH * float(length.mean()), PART * min(sizes))
        return cls(triangles, edges, piece, n_sheets, outward, normals, area, reach)


class LayerPairs(NamedTuple):
    """Pairs of a vertex and a triangle, or of two edges.

    Attributes
    ----------
    points : (n, 4) int64
        Vertex, then triangle; or edge, then edge.
    weights : (n, 4) float64
        Height is the product of the direction with the weighted sum of the positions; positive for the
        first part, the vertex or edge.
    directions : (n, 3) float64
        Unit vectors.
    slope : (n,) float64
        Distance of the parts over height.
    n_vertex_pairs : int
        Number of the pairs with a triangle, which come first.
    """

    points: Ints
    weights: Array
    directions: Array
    slope: Array
    n_vertex_pairs: int

    def at_seams(self, joined: JoinedVertices) -> Mask:
        """Whether seams hold a vertex of the first part together with one of the second, (n,)."""
        rows = joined.concern(self.points)
        first = np.arange(4) < np.where(rows < self.n_vertex_pairs, 1, 2)[:, None]
        held = joined.between(self.points[rows], self.points[rows])
        held &= first[:, :, None] & ~first[:, None, :]
        at_seam = np.zeros(len(self.points), dtype=bool)
        at_seam[rows] = held.any(axis=(1, 2))
        return at_seam

    def heights(self, x: Array) -> Array:
        """(n,) heights [m] of the first above the second part at positions x (V, 3) [m]."""
        return np.einsum("ni,nk,nki->n", self.directions, self.weights, x[self.points], optimize=True)


def find_layer_pairs(surfaces: Surfaces, x: Array, within: Mask) -> LayerPairs:
    """The pairs at positions x (V, 3) [m] of different pieces, not both of obstacles, and within the pieces
    for which ``within`` (pieces,) is true.
    """
    number = np.arange(len(within))
    may = (number[:, None] != number) & (np.minimum(number[:, None], number) < surfaces.n_sheets)
    may |= np.diag(within)
    # in the principal axes of the normals, boxes around layers along them are flat
    axes = np.linalg.eigh(surfaces.normals.T @ surfaces.normals)[1]
    turned, there = surfaces._replace(normals=surfaces.normals @ axes), x @ axes
    parts = [_vertex_pairs(turned, there, may), _edge_pairs(turned, there, np.triu(may))]
    points, weights, directions, slope = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return LayerPairs(points, weights, directions @ axes.T, slope, len(parts[0][0]))


def _candidates(may: Mask, first: Ints, boxes: Boxes, second: Ints, others: Boxes) -> Ints:
    """Numbers (n, 2) of boxes and others that overlap; those of the pieces ``first`` (k,) and ``second`` (m,)
    are examined that ``may`` (pieces, pieces) be pairs.
    """
    lists = [np.empty((0, 2), dtype=np.int64)]
    for piece in np.unique(first):
        rows, columns = np.flatnonzero(first == piece), np.flatnonzero(may[piece][second])
        pairs = overlapping_pairs((boxes[0][rows], boxes[1][rows]), (others[0][columns], others[1][columns]))
        lists.append(np.column_stack([rows[pairs[:, 0]], columns[pairs[:, 1]]]))
    return np.concatenate(lists)


def _vertex_pairs(surfaces: Surfaces, x: Array, may: Mask) -> tuple[Ints, Array, Array, Array]:
    triangles, normals, piece = surfaces.triangles, surfaces.normals, surfaces.piece
    swept = np.stack([x - surfaces.reach * normals, x + surfaces.reach * normals])
    corners = x[triangles]
    boxes, others = (swept.min(axis=0), swept.max(axis=0)), (corners.min(axis=1), corners.max(axis=1))
    v, t = _candidates(may, piece, boxes, piece[triangles[:, 0]], others).T
    keep = (triangles[t] != v[:, None]).all(axis=1)
    v, t = v[keep], t[keep]
    a, b, c = (x[triangles[t, k]] for k in range(3))
    direction, normal = normals[v], np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    rise = np.einsum("ni,ni->n", normal, direction)
    keep = np.abs(rise) > STEEP * size
    v, t, a, b, c, direction, normal, size, rise = (
        array[keep] for array in (v, t, a, b, c, direction, normal, size, rise)
    )
    height = np.einsum("ni,ni->n", x[v] - a, normal) / rise
    foot = x[v] - height[:, None] * direction
    square = size**2
    w_b = np.einsum("ni,ni->n", np.cross(foot - a, c - a), normal) / square
    w_c = np.einsum("ni,ni->n", np.cross(b - a, foot - a), normal) / square
    w_a = 1.0 - w_b - w_c
    of_sheets = np.maximum(piece[v], piece[triangles[t, 0]]) < surfaces.n_sheets
    aside = np.where(of_sheets, TILT, 0.0) * np.abs(height) / np.sqrt(size)
    keep = (np.minimum(np.minimum(w_a, w_b), w_c) >= -aside) & (np.abs(height) <= surfaces.reach)
    weights = np.column_stack([np.ones_like(w_a), -w_a, -w_b, -w_c])[keep]
    points = np.column_stack([v, triangles[t]])[keep]
    return points, weights, direction[keep], (np.abs(rise) / size)[keep]


def _edge_pairs(surfaces: Surfaces, x: Array, may: Mask) -> tuple[Ints, Array, Array, Array]:
    edges, normals = surfaces.edges, surfaces.normals
    mean = unit(normals[edges].sum(axis=1))
    ends = x[edges]
    low, high = ends.min(axis=1), ends.max(axis=1)
    offset = surfaces.reach * np.abs(mean)
    piece = surfaces.piece[edges[:, 0]]
    candidates = _candidates(may, piece, (low - offset, high + offset), piece, (low, high))
    own, other = piece[candidates.T]
    candidates = candidates[(own != other) | (candidates[:, 0] < candidates[:, 1])]
    first, second = edges[candidates[:, 0]], edges[candidates[:, 1]]
    keep = (first[:, :, None] != second[:, None, :]).all(axis=(1, 2))
    first, second, candidates = first[keep], second[keep], candidates[keep]
    one, two = mean[candidates[:, 0]], mean[candidates[:, 1]]
    sign = np.where(np.einsum("ni,ni->n", one, two) < 0.0, -1.0, 1.0)
    direction = unit(one + sign[:, None] * two)
    a, u = x[first[:, 0]], x[first[:, 1]] - x[first[:, 0]]
    b, w = x[second[:, 0]], x[second[:, 1]] - x[second[:, 0]]
    normal = np.cross(u, w)
    size, rise = np.linalg.norm(normal, axis=1), np.einsum("ni,ni->n", normal, direction)
    lengths = np.linalg.norm(u, axis=1) * np.linalg.norm(w, axis=1)
    keep = (size > 1e-6 * lengths) & (np.abs(rise) > STEEP * size)
    first, second, direction, a, u, b, w, size, rise = (
        array[keep] for array in (first, second, direction, a, u, b, w, size, rise)
    )
    # a + s u = b + t w + height · direction
    apart = b - a
    s = np.einsum("ni,ni->n", np.cross(apart, w), direction) / rise
    t = np.einsum("ni,ni->n", np.cross(apart, u), direction) / rise
    weights = np.column_stack([1.0 - s, s, t - 1.0, -t])
    points = np.column_stack([first, second])
    height = np.einsum("ni,nk,nki->n", direction, weights, x[points], optimize=True)
    keep = (s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0) & (np.abs(height) <= surfaces.reach)
    return points[keep], weights[keep], direction[keep], (np.abs(rise) / size)[keep]


class Overlap(NamedTuple):
    """Parts of two surfaces, of which one has moved through the other.

    Attributes
    ----------
    first, second : (V,) bool
        Points of either; of the first one if it is an obstacle.
    seeds : (V,) bool
        Points that are known to be at the overlap.
    outside : bool
        Whether the first one is a closed obstacle, of which the second is to be outside.
    """

    first: Mask
    second: Mask
    seeds: Mask
    outside: bool


def wanted_sides(
    surfaces: Surfaces, x: Array, pairs: LayerPairs, crossings: Ints, enclosed: Ints
) -> tuple[Array, Mask]:
    """The sign (n,) that the height of each pair is to have, and whether it has the other one now.

    The overlap of the ``crossings`` (m, 2) of triangles has moved parts to the wrong side, or pieces lie in
    others: ``enclosed`` (k, 2) are a sheet and a closed piece of an obstacle around it.

    Along each contour of crossings the greater part of both surfaces, by area, is on the right side; of a
    closed obstacle it is the outside.
    """
    heights = pairs.heights(x)
    wrong = np.zeros(len(heights), dtype=bool)
    overlaps = [_overlap_at(surfaces, contour) for contour in _contours(surfaces, crossings)]
    for sheet, body in enclosed:
        inside = surfaces.piece == sheet
        overlaps.append(Overlap(surfaces.piece == body, inside, inside, outside=True))
    for overlap in overlaps:
        wrong[_on_the_wrong_side(surfaces, pairs, heights, overlap)] = True
    return np.where((heights < 0.0) ^ wrong, -1.0, 1.0), wrong


def _overlap_at(surfaces: Surfaces, contour: Ints) -> Overlap:
    """The overlap at a contour of crossings."""
    (one, first), (two, second) = (_patch(surfaces, contour, role) for role in (0, 1))
    own, other = surfaces.piece[surfaces.triangles[contour[0], 0]]
    seeds = np.zeros(len(one), dtype=bool)
    seeds[first] = seeds[second] = True
    of_one, of_two = (one < two, two < one) if own == other else (np.isfinite(one), np.isfinite(two))
    return Overlap(of_one, of_two, seeds, bool(surfaces.outward[own] != 0.0))


def _on_the_wrong_side(surfaces: Surfaces, pairs: LayerPairs, heights: Array, overlap: Overlap) -> Ints:
    """The pairs that an overlap has moved to the wrong side."""
    in_one, in_two = overlap.first[pairs.points], overlap.second[pairs.points]
    count = np.where(np.arange(len(heights)) < pairs.n_vertex_pairs, 1, 2)
    leading = np.arange(4) < count[:, None]
    # whether the first part of the pair is of the first surface, or of the second
    forward = np.where(leading, in_one, in_two).all(axis=1)
    backward = np.where(leading, in_two, in_one).all(axis=1)
    chosen = np.flatnonzero(forward | backward)
    # the direction, turned to the normals of the first surface
    theirs = surfaces.normals[np.where(forward[chosen], pairs.points[chosen, 0], pairs.points[chosen, 3])]
    turned = np.sign(np.einsum("ni,ni->n", theirs, pairs.directions[chosen]))
    # height of the second above the first surface is factor · height of the pair
    factor = np.where(forward[chosen], -1.0, 1.0) * np.where(turned == 0.0, 1.0, turned)
    relative = factor * heights[chosen]
    of_vertex = chosen < pairs.n_vertex_pairs
    at, n = pairs.points[chosen[of_vertex], 0], len(overlap.seeds)
    sign = _vertex_signs(at, relative[of_vertex], n)
    least = np.full(n, np.inf)
    np.minimum.at(least, at, np.abs(relative[of_vertex]))
    regions = {s: _flood(surfaces.edges, sign == s, overlap.seeds) for s in (-1.0, 1.0)}
    areas = {s: float(surfaces.area[region].sum()) for s, region in regions.items()}
    right = 1.0 if overlap.outside else max(areas, key=lambda s: areas[s])
    touched = regions[-right] | overlap.seeds
    parts = least[pairs.points[chosen]]
    parts = np.where(np.isfinite(parts), parts, 0.0)
    limit = np.full(len(chosen), np.inf)
    for part in (leading[chosen], ~leading[chosen]):
        height = np.where(part, parts, 0.0).max(axis=1)
        limit = np.where(height > 0.0, np.minimum(limit, height), limit)
    nearest = np.abs(relative) <= OTHER_SURFACE * limit
    on_it = touched[pairs.points[chosen]].any(axis=1)
    return np.asarray(chosen[nearest & (relative * right < 0.0) & on_it])


def _contours(surfaces: Surfaces, crossings: Ints) -> list[Ints]:
    """Pairs (k, 2) of triangles along each connected contour; the first ones are of one surface: an obstacle
    if there is one.
    """
    piece = surfaces.piece[surfaces.triangles[crossings, 0]]
    swap = piece[:, 1] >= surfaces.n_sheets
    ordered = np.where(swap[:, None], crossings[:, ::-1], crossings)
    swap = (piece[:, 0] > piece[:, 1]) & (piece[:, 0] < surfaces.n_sheets)
    ordered = np.where(swap[:, None], ordered[:, ::-1], ordered)
    of_one = piece[:, 0] == piece[:, 1]
    nodes = np.concatenate([ordered, crossings[of_one][:, ::-1]])
    links = []
    for role in (0, 1):
        order = np.argsort(nodes[:, role], kind="stable")
        same = nodes[order[1:], role] == nodes[order[:-1], role]
        same &= _pieces_of(surfaces, nodes[order[1:]]) == _pieces_of(surfaces, nodes[order[:-1]])
        links.append(np.column_stack([order[1:], order[:-1]])[same])
    component = connected_components(len(nodes), np.concatenate(links))
    n, contours = len(crossings), []
    mirror = np.full(len(nodes), -1)
    mirror[np.flatnonzero(of_one)] = n + np.arange(of_one.sum())
    mirror[n:] = np.flatnonzero(of_one)
    for label in np.unique(component):
        members = np.flatnonzero(component == label)
        other = mirror[members[0]]
        if other < 0 or component[other] >= label:
            contours.append(nodes[members])
    return contours


def _pieces_of(surfaces: Surfaces, pairs: Ints) -> Ints:
    """One number for the pieces of each pair (n, 2) of triangles."""
    piece = surfaces.piece[surfaces.triangles[pairs, 0]]
    return np.asarray(piece[:, 0] * (int(surfaces.piece.max()) + 1) + piece[:, 1])


def _patch(surfaces: Surfaces, contour: Ints, role: int) -> tuple[Array, Ints]:
    """Number of edges (V,) from the contour's triangles of one role, infinite outside of their piece, and
    their points.
    """
    seeds = np.unique(surfaces.triangles[contour[:, role]])
    distance = np.full(len(surfaces.piece), np.inf)
    distance[seeds] = 0.0
    both = surfaces.piece[surfaces.triangles[contour[0], 0]]
    if both[0] != both[1]:
        distance[surfaces.piece == both[role]] = 0.0
        return distance, seeds
    for _ in range(RINGS):
        np.minimum.at(distance, surfaces.edges, distance[surfaces.edges[:, ::-1]] + 1.0)
    return distance, seeds


def _vertex_signs(vertices: Ints, heights: Array, n: int) -> Array:
    """Sign (n,) of the least of the heights at each vertex, by magnitude; 0 where there is none."""
    sign = np.zeros(n)
    order = np.argsort(-np.abs(heights), kind="stable")
    sign[vertices[order]] = np.where(heights[order] < 0.0, -1.0, 1.0)
    return sign


def _flood(edges: Ints, inside: Mask, seeds: Mask) -> Mask:
    """Points (V,) ``inside`` that edges between such points connect with seeds."""
    component = connected_components(len(inside), edges[inside[edges].all(axis=1)])
    reached = np.zeros(len(inside), dtype=bool)
    reached[component[inside & seeds]] = True
    return reached[component] & inside


def _summed(at: Ints, vectors: Array, n: int) -> Array:
    """Sums (n, 3) of vectors (m, 3) at numbered points (m,)."""
    return np.stack([np.bincount(at, vectors[:, k], n) for k in range(3)], axis=1)


def unit(vectors: Array) -> Array:
    """Unit vectors (n, 3) along vectors; zero ones stay."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)
