"""Seams on rank 0: which vertices are sewn to which, by arc length; and the joining of those that coincide.

Each vertex of the side with more vertices is tied to a point on an edge of the other side, at the same part
of the rest length. Were the vertices of both sides tied, two sides of different vertices could only be
straight and evenly stretched: between common points both are linear, so each tie would remove a kink of one.
"""

from __future__ import annotations

from collections import Counter
from itertools import product
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.measures import SAME_PLACE, mean_edge_length
from lyra_petsc.mesh.mesh import Group, Mesh, Source
from lyra_petsc.mesh.readers import first_few
from lyra_petsc.mesh.select import DIMENSION_NAMES, find_group
from lyra_petsc.mesh.topology import Hinges, connected_components, edge_table, side_vertices, walk
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.seam_block import Seam

AT_VERTEX = 1e-4
"""Part of an edge within which a tie belongs to the edge's end: the distance that a rigid seam leaves."""


class SeamSide(NamedTuple):
    """One side of a seam.

    Attributes
    ----------
    vertices : (n,) int64
        In order; of a closed curve the first one again at the end.
    place : (n,) float64
        Arc length from the first vertex in the rest shape [m].
    """

    vertices: Ints
    place: Array

    @property
    def closed(self) -> bool:
        return bool(self.vertices[0] == self.vertices[-1])

    @property
    def length(self) -> float:
        """Rest length [m]."""
        return float(self.place[-1])

    @property
    def own(self) -> int:
        """Number of vertices, each counted once."""
        return len(self.vertices) - self.closed

    def reversed(self) -> SeamSide:
        """The same from its other end."""
        return SeamSide(self.vertices[::-1].copy(), self.length - self.place[::-1])

    def steps(self) -> list[tuple[int, int]]:
        """The edges, each with its lower vertex first."""
        ends = np.sort(np.stack([self.vertices[:-1], self.vertices[1:]], axis=1), axis=1)
        return [(a, b) for a, b in ends.tolist()]

    def shares(self) -> Array:
        """Arc length [m] that belongs to each vertex, (own,)."""
        half = 0.5 * np.diff(self.place)
        out = np.zeros(len(self.vertices))
        out[:-1] += half
        out[1:] += half
        if self.closed:
            out[0] += out[-1]
        return out[: self.own]


class Ties(NamedTuple):
    """Ties of one seam or of several.

    Attributes
    ----------
    stencil : (n, 3) int64
        The tied vertex, and the two vertices of an edge of the other side.
    weight : (n,) float64
        Place of the tie on the edge, from 0 at its first vertex to below 1.
    share : (n,) float64
        Arc length of the tied vertex [m].
    """

    stencil: Ints
    weight: Array
    share: Array

    def gaps(self, x: Array) -> Array:
        """Vectors (n, 3) [m] from the places on the edges to the tied vertices at positions x (V, 3)."""
        vertex, first, second = x[self.stencil].transpose(1, 0, 2)
        w = self.weight[:, None]
        return np.asarray(vertex - (1.0 - w) * first - w * second)


class Threads(NamedTuple):
    """What holds pairs of vertices together; of a pair that several threads join, one after another, each.

    Attributes
    ----------
    pairs : (n, 2) int64
        Vertices.
    seam : (n,) int64
        Number of the thread's seam.
    length : (n,) float64
        Length [m] of the thread at the start.
    """

    pairs: Ints
    seam: Ints
    length: Array


class SewnCurves(NamedTuple):
    """The two sides of a seam.

    Attributes
    ----------
    sides : two SeamSide
        As the scene names them, in the direction in which they are sewn.
    tied : int
        The side, 0 or 1, of which each vertex is tied to an edge of the other one.
    ties : Ties
        Without vertices that both sides have in common.
    """

    sides: tuple[SeamSide, SeamSide]
    tied: int
    ties: Ties


class SeamHinges(NamedTuple):
    """Edges of seams, each with a triangle on either side: those of the side whose vertices are tied.

    Attributes
    ----------
    stencil : (n, 4) int64
        The edge's vertices, and the vertices opposite to it in the two triangles, as in ``dihedral_angle``.
        The second triangle has the edge of the other side on which the middle of this edge lies.
    triangles : (n, 2) int64
    length : (n,) float64
        Rest length of the edge [m].
    heights : (n, 2) float64
        Rest heights of both triangles on their edges [m].
    seam : (n,) int64
        Number of the seam.
    hinge : (n,) int64
        Number among the hinges of the mesh where both sides have the same edge, else −1.
    start_gap : (n,) float64
        Distance [m] of the middle of the edge from the other side in the start shape.
    start_angle : (n,) float64
        Dihedral angle [rad] in the start shape, as if there were no gap.
    """

    stencil: Ints
    triangles: Ints
    length: Array
    heights: Array
    seam: Ints
    hinge: Ints
    start_gap: Array
    start_angle: Array


def sewn_curves(scene: Scene, mesh: Mesh) -> list[SewnCurves]:
    """The curves of all seams of a scene, before or after `join_seams`.

    Raises
    ------
    InputError
        A group is unknown, or no curve; one curve is closed and the other is not, or ``start`` is missing.
    """
    edges = _Edges(mesh)
    return [_sewn(mesh, edges, seam, f"seams[{n}]", scene.source) for n, seam in enumerate(scene.seams)]


def _sewn(mesh: Mesh, edges: _Edges, seam: Seam, key: str, file: object | None) -> SewnCurves:
    one, other = (_curve(mesh, edges, name, f"{key}.between", file) for name in seam.between)
    if one.closed != other.closed:
        names = seam.between if one.closed else seam.between[::-1]
        message = f"'{names[0]}' is a closed curve and '{names[1]}' is not; sew curves of one kind"
        raise InputError(message, key=f"{key}.between", file=file)
    if one.closed:
        if seam.start is None:
            message = "closed curves need start: [x, y, z], the point where both begin"
            raise InputError(message, key=key, file=file)
        one, other = (_begun_at(mesh, curve, np.array(seam.start)) for curve in (one, other))
    elif seam.start is not None:
        raise InputError("is for closed curves; these have ends", key=f"{key}.start", file=file)
    tied = 0 if one.own > other.own else 1
    fine, coarse = (one, other) if tied == 0 else (other, one)
    turned = fine.reversed()
    trials = [(way, _tie(way, coarse)) for way in (fine, turned)]
    distance = [float(np.linalg.norm(ties.gaps(mesh.positions), axis=1) @ ties.share) for _, ties in trials]
    backwards = distance[1] < (1.0 - SAME_PLACE) * distance[0]
    fine, ties = trials[int(backwards != seam.reverse)]
    at = ties.stencil
    own = (at[:, 0] == at[:, 1]) & (ties.weight == 0.0)
    ties = Ties(*(values[~own] for values in ties))
    if len(wrong := np.flatnonzero((ties.stencil[:, :1] == ties.stencil[:, 1:]).any(axis=1))):
        message = f"vertex {ties.stencil[wrong[0], 0]} would be sewn to an edge of its own"
        raise InputError(message, key=f"{key}.between", file=file)
    return SewnCurves((fine, coarse) if tied == 0 else (coarse, fine), tied, ties)


def _tie(fine: SeamSide, coarse: SeamSide) -> Ties:
    """Ties of all vertices of a curve to edges of another one."""
    place = fine.place[: fine.own] / fine.length * coarse.length
    edge = np.clip(np.searchsorted(coarse.place, place, side="right") - 1, 0, len(coarse.place) - 2)
    weight = (place - coarse.place[edge]) / np.diff(coarse.place)[edge]
    first, second = coarse.vertices[edge], coarse.vertices[edge + 1]
    at_end = weight > 1.0 - AT_VERTEX
    first, second = np.where(at_end, second, first), np.where(at_end, first, second)
    weight = np.where(at_end | (weight < AT_VERTEX), 0.0, weight)
    return Ties(np.stack([fine.vertices[: fine.own], first, second], axis=1), weight, fine.shares())


def _begun_at(mesh: Mesh, curve: SeamSide, point: Array) -> SeamSide:
    """A closed curve that begins at the vertex nearest to the point (3,) [m]."""
    n = curve.own
    at = int(np.linalg.norm(mesh.positions[curve.vertices[:n]] - point, axis=1).argmin())
    steps = np.roll(np.diff(curve.place), -at)
    vertices = np.roll(curve.vertices[:n], -at)
    return SeamSide(np.append(vertices, vertices[0]), np.concatenate([[0.0], np.cumsum(steps)]))


class _Edges:
    """The mesh's edges by their vertices: rest lengths, numbers of their triangles, and their sides."""

    def __init__(self, mesh: Mesh) -> None:
        table, uv = edge_table(mesh.triangles), mesh.triangle_uv
        first = table.sides[table.first]
        ends = np.sort(side_vertices(mesh.triangles, first)[:, :2], axis=1)
        length = np.linalg.norm(uv - np.roll(uv, -1, axis=1), axis=2).ravel()
        self._n, self._length, self._count = mesh.n_vertices, length[first], table.sizes
        self._table = table
        self._key = ends[:, 0] * self._n + ends[:, 1]  # ascending

    def of(self, edges: Ints) -> tuple[Array, Ints]:
        """Lengths [m] and numbers of triangles, 0 where there is no such edge, of edges (k, 2)."""
        at, known = self._places(edges)
        return np.where(known, self._length[at], 0.0), np.where(known, self._count[at], 0)

    def sides(self, edges: Ints, which: Ints | int = 0) -> Ints:
        """Number (k,), as in `EdgeTable`, of the first side, or another one, of edges (k, 2) of the mesh."""
        return self._table.sides[self._table.first[self._places(edges)[0]] + which]

    def _places(self, edges: Ints) -> tuple[Ints, Mask]:
        low, high = np.sort(edges, axis=1).T
        key = low * self._n + high
        at = np.minimum(np.searchsorted(self._key, key), len(self._key) - 1)
        return at, np.asarray(self._key[at] == key)


def _curve(mesh: Mesh, edges: _Edges, name: str, key: str, file: object | None) -> SeamSide:
    """The edges of a group as one curve."""

    def refuse(message: str) -> InputError:
        return InputError(f"group '{name}' {message}", key=key, file=file)

    group = find_group(mesh, name, key=key, file=file)
    if not len(group.edges):
        curves = [other for other, candidate in mesh.groups.items() if len(candidate.edges)]
        kind = DIMENSION_NAMES[group.dimension]
        listed = f"groups of edges: {first_few(sorted(curves), 20) or 'none'}"
        raise refuse(f"is a {kind} group without edges; sew groups of boundary edges ({listed})")
    ends = np.unique(group.edges, return_inverse=True)[1].reshape(-1, 2)
    degree = np.bincount(ends.ravel())
    if (degree > 2).any():
        raise refuse(f"branches at vertex {group.vertices[degree.argmax()]}; sew one curve without branches")
    pieces = len(np.unique(connected_components(len(degree), ends)))
    if pieces > 1:
        hint = "; name the sheet, as in sheet/group" if len(mesh.sources) > 1 and "/" not in name else ""
        raise refuse(f"is {pieces} curves, not one{hint}")
    vertices = walk(group.edges)
    steps = np.stack([vertices[:-1], vertices[1:]], axis=1)
    length, count = edges.of(steps)
    if not count.all():
        a, b = steps[count.argmin()]
        raise refuse(f"has the edge {a}-{b}, which is none of a triangle")
    return SeamSide(vertices, np.concatenate([[0.0], np.cumsum(length)]))


def join_seams(scene: Scene, mesh: Mesh) -> Mesh:
    """The mesh with vertices joined that rigid seams hold together where they coincide at the start.

    ``tied`` gets the pairs of vertices of the other seams. Those that share an edge are among these: where
    three sheets became one edge, it would not tell which two of them a seam bends.

    Raises
    ------
    InputError
        As `sewn_curves`; or edges that are not at a boundary, or in both groups; or triangles that would
        lose a side.
    """
    same: Ints = np.arange(mesh.n_vertices)
    edge, edges = mean_edge_length(mesh), _Edges(mesh)
    taken: set[tuple[int, int, frozenset[str]]] = set()
    curves = sewn_curves(scene, mesh)
    seams_at = Counter(step for sewn in curves for side in sewn.sides for step in side.steps())
    for number, (seam, sewn) in enumerate(zip(scene.seams, curves, strict=True)):
        key = f"seams[{number}].between"
        for curve in sewn.sides:
            _check_boundary(curve, edges, frozenset(seam.between), taken, key, scene.source)
        one, other = sewn.sides
        alone = all(seams_at[step] == 1 for side in sewn.sides for step in side.steps())
        if seam.rigid and alone and one.own == other.own:
            pairs = np.stack([one.vertices, other.vertices])
            apart = np.linalg.norm(np.subtract(*mesh.positions[pairs]), axis=1)
            if apart.max() <= SAME_PLACE * edge:
                same = connected_components(len(same), np.concatenate([_links(same), pairs.T]))
                mesh.notes.append(f"seam {seam.label}: {one.own} pairs of vertices joined")
    if (same != np.arange(len(same))).any():
        mesh = _joined(mesh, same, scene)
    mesh.tied = tied_pairs(scene, mesh)
    return mesh


def tied_pairs(scene: Scene, mesh: Mesh) -> Ints:
    """Pairs of vertices (n, 2) that the seams of a scene hold together, of the mesh from `join_seams`."""
    return threads(scene, mesh).pairs


def threads(scene: Scene, mesh: Mesh) -> Threads:
    """The threads of a scene's seams, of the mesh from `join_seams`.

    Where seams meet, vertices at one place are held together by the threads between others there, too.
    """
    sewn = [one.ties for one in sewn_curves(scene, mesh)]
    ties = Ties(*(np.concatenate(arrays) for arrays in zip(*sewn, strict=True)))
    seam = np.repeat(np.arange(len(sewn)), [len(one.share) for one in sewn])
    length = np.linalg.norm(ties.gaps(mesh.positions), axis=1)
    to_vertex = np.flatnonzero(ties.weight == 0.0)
    place = connected_components(mesh.n_vertices, ties.stencil[to_vertex, :2])
    vertices_at: dict[int, list[int]] = {}
    for vertex in np.unique(ties.stencil).tolist():
        vertices_at.setdefault(int(place[vertex]), []).append(vertex)
    threads_at: dict[int, list[int]] = {}
    for tie in to_vertex.tolist():
        threads_at.setdefault(int(place[ties.stencil[tie, 0]]), []).append(tie)
    rows = [
        (vertex, end, tie)
        for tie, (vertex, *edge) in enumerate(ties.stencil.tolist())
        for end in (edge if ties.weight[tie] > 0.0 else edge[:1])
    ]
    direct = {frozenset(pair) for *pair, _ in rows}
    for vertex, end, tie in rows.copy():
        here, there = int(place[vertex]), int(place[end])
        between = {tie, *threads_at.get(here, ()), *threads_at.get(there, ())}
        if here == there and tie != min(between):
            continue  # all pairs there are those of its first thread
        for one, other in product(vertices_at[here], vertices_at[there]):
            if one != other and frozenset((one, other)) not in direct:
                rows += [(one, other, thread) for thread in sorted(between)]
    every = np.array(rows, dtype=np.int64).reshape(-1, 3)
    return Threads(every[:, :2], seam[every[:, 2]], length[every[:, 2]])


def seam_hinges(scene: Scene, mesh: Mesh, hinges: Hinges) -> SeamHinges:
    """The hinges across the seams of a scene, of the mesh from `join_seams` with these ``hinges``."""
    edges, curves = _Edges(mesh), sewn_curves(scene, mesh)
    parts = [_hinges_of(mesh, edges, hinges, number, sewn) for number, sewn in enumerate(curves)]
    return SeamHinges(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _hinges_of(mesh: Mesh, edges: _Edges, hinges: Hinges, number: int, sewn: SewnCurves) -> SeamHinges:
    fine, coarse = sewn.sides[sewn.tied], sewn.sides[1 - sewn.tied]
    middle = 0.5 * (fine.place[1:] + fine.place[:-1]) / fine.length * coarse.length
    at = np.clip(np.searchsorted(coarse.place, middle, side="right") - 1, 0, len(coarse.place) - 2)
    part = ((middle - coarse.place[at]) / np.diff(coarse.place)[at])[:, None]
    own, other = (
        np.stack([curve.vertices[rows], curve.vertices[rows + 1]], axis=1)
        for curve, rows in ((fine, np.arange(len(middle))), (coarse, at))
    )
    joined = (np.sort(own, axis=1) == np.sort(other, axis=1)).all(axis=1)
    sides = [edges.sides(own), edges.sides(other, joined.astype(np.int64))]
    corners = [side_vertices(mesh.triangles, side) for side in sides]
    # the angle's sign is by the normals of the seam's first side
    forwards = corners[0][:, 0] == own[:, 0] if sewn.tied == 0 else corners[1][:, 0] == other[:, 1]
    stencil = np.column_stack(
        [np.where(forwards[:, None], own, own[:, ::-1]), corners[0][:, 2], corners[1][:, 2]]
    )
    uv, (face, corner) = mesh.triangle_uv, np.divmod(sides, 3)
    length = np.linalg.norm(uv[face, (corner + 1) % 3] - uv[face, corner], axis=2)
    twice = np.abs(np.linalg.det(uv[face][:, :, 1:] - uv[face][:, :, :1]))
    hinge = np.full(len(own), -1)
    if joined.any():
        keys = [np.sort(pairs, axis=1) @ [mesh.n_vertices, 1] for pairs in (hinges.vertices[:, :2], own)]
        order = np.argsort(keys[0])
        row = order[np.minimum(np.searchsorted(keys[0][order], keys[1]), len(order) - 1)]
        hinge = np.where(joined & (keys[0][row] == keys[1]), row, -1)
    points = mesh.positions[stencil]
    first, second = mesh.positions[other].transpose(1, 0, 2)
    gap = points[:, :2].mean(axis=1) - (1.0 - part) * first - part * second
    points[:, 3] += gap
    return SeamHinges(
        stencil,
        face.T,
        length[0],
        (twice / length).T,
        np.full(len(own), number),
        hinge,
        np.linalg.norm(gap, axis=1),
        _folds(points),
    )


def _folds(points: Array) -> Array:
    """Dihedral angles (n,) [rad] of hinges at points (n, 4, 3)."""
    edge, first, second = (points[:, 1:] - points[:, :1]).transpose(1, 0, 2)
    one, two = np.cross(edge, first), np.cross(second, edge)
    sine = np.sum(np.cross(one, two) * edge, axis=1) / np.linalg.norm(edge, axis=1)
    return np.arctan2(sine, np.sum(one * two, axis=1))


def _links(same: Ints) -> Ints:
    """Pairs (m, 2) of vertices that are joined, ``same`` (V,) being the lowest one of each."""
    others = np.flatnonzero(same != np.arange(len(same)))
    return np.column_stack([others, same[others]])


def _check_boundary(
    curve: SeamSide,
    edges: _Edges,
    pair: frozenset[str],
    taken: set[tuple[int, int, frozenset[str]]],
    key: str,
    file: object | None,
) -> None:
    """Refuse edges of more than one triangle, and those that are sewn to themselves or twice to the same
    ``pair`` of groups; ``taken`` gets the edges. Three sheets meet in several seams.
    """
    steps = curve.steps()
    _, count = edges.of(np.array(steps))
    for (a, b), triangles in zip(steps, count.tolist(), strict=True):
        if triangles > 1:
            raise InputError(f"edge {a}-{b} is inside the sheet; sew boundary edges", key=key, file=file)
        if (a, b, pair) in taken:
            message = f"edge {a}-{b} is sewn to itself, or twice to the same group"
            raise InputError(message, key=key, file=file)
        taken.add((a, b, pair))


def _joined(mesh: Mesh, same: Ints, scene: Scene) -> Mesh:
    """The mesh with vertices joined to the lowest one of each, ``same`` (V,)."""
    kept = np.flatnonzero(same == np.arange(len(same)))
    number = np.full(len(same), -1, dtype=np.int64)
    number[kept] = np.arange(len(kept))
    number = number[same]
    triangles = number[mesh.triangles]
    if (bad := np.flatnonzero((triangles == np.roll(triangles, 1, axis=1)).any(axis=1))).size:
        message = f"seams join vertices of one triangle: {first_few(bad.tolist())} (counted from 0)"
        raise InputError(message, key="seams", file=scene.source)
    owner = np.repeat(np.arange(len(mesh.sources)), [source.n_vertices for source in mesh.sources])
    counts = np.bincount(owner[kept], minlength=len(mesh.sources))
    sources = [
        Source(source.label, int(count), source.n_triangles)
        for source, count in zip(mesh.sources, counts, strict=True)
    ]

    def joined(group: Group) -> Group:
        edges = np.unique(np.sort(number[group.edges], axis=1), axis=0) if len(group.edges) else group.edges
        return Group(group.dimension, np.unique(number[group.vertices]), group.triangles, edges)

    # the shape at the start is the same as that at rest, but for a rigid motion of each sheet
    return Mesh(
        mesh.positions[kept],
        mesh.positions[kept].copy(),
        triangles,
        mesh.triangle_uv,
        mesh.flat_rest,
        groups={name: joined(group) for name, group in mesh.groups.items()},
        notes=mesh.notes,
        has_uv=mesh.has_uv,
        sources=sources,
        tags=None if mesh.tags is None else mesh.tags[kept],
    )
