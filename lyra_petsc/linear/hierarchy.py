"""Levels of geometric multigrid: coarse meshes, interpolation from them, and Galerkin products."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.linear.coarsening import CoarseMesh, coarsen
from lyra_petsc.linear.galerkin import Galerkin
from lyra_petsc.linear.pattern import BlockPattern, row_pointers
from lyra_petsc.mesh.partitioner import locality_order, vertex_graph
from lyra_petsc.mesh.points import Layout, Points

if TYPE_CHECKING:
    from lyra_petsc.linear.tied_vertices import Combination, CompressedRows, TiedVertices
    from lyra_petsc.terms.bending.director_rotations import DirectorRotations


COARSEST = 100
"""Number of vertices, over all ranks, up to which a level is not coarsened further but factorised."""

MAX_RATIO = 0.7
"""Largest ratio of coarse to fine vertices for which a level pays."""


@dataclass(frozen=True)
class Surface:
    """A rank's part of the mesh.

    Attributes
    ----------
    x : (n_vertices, 3)
        Positions [m] of the owned vertices, from which interpolation weights are computed.
    triangles : (F, 3)
        Local numbering.
    ties : sequence of ((n, m), (n, m))
        Vertices in local numbering, and factors with which the sum of their positions stays near zero; each
        tie is on one rank.
    """

    x: Array
    triangles: NDArray[np.int32]
    ties: Sequence[tuple[Ints, Array]] = ()


@dataclass(frozen=True)
class InterpolationRows:
    """A rank's rows of the interpolation from a coarser level.

    Attributes
    ----------
    bounds : (ranks + 1,)
        First coarse vertex of each rank.
    start : (n_owned + 1,)
        Row pointers.
    parents : (P,)
        Coarse vertices from which a vertex is interpolated, in global numbers.
    weights : (P,)
    """

    bounds: Ints
    start: Ints
    parents: Ints
    weights: Array


class VertexMatrix(Protocol):
    """Replaces the finest level's matrix in the Galerkin product, as coarse levels have no edges' unknowns.

    Attributes
    ----------
    pattern : BlockPattern
        Has the same rows as the finest level's; those of edges are empty.
    turns : DirectorRotations
        Interpolation from displacements of vertices to the unknowns of edges.
    """

    pattern: BlockPattern
    turns: DirectorRotations

    def values(self, held: Mask, memory: Array) -> Array:
        """Current block rows (n_blocks, 3, 3), in ``memory``; updates ``turns``.

        held (n_local, 3) marks prescribed coordinates.
        """


class Level:
    """Points and pattern of a level, and its Galerkin product for the next coarser one.

    Attributes
    ----------
    points : Points
    pattern : BlockPattern
    galerkin : Galerkin or None
        Interpolation from the next coarser level, and its block rows; None on the coarsest one.
    turns : DirectorRotations or None
        Interpolation from displacements of vertices to the unknowns of edges.
    memory : (n,) float64 or None
        If edges have unknowns: work array of the sweeps, and before them of the next level's block rows.
    """

    def __init__(self, points: Points, pattern: BlockPattern, turns: DirectorRotations | None = None) -> None:
        self.points, self.pattern, self.turns = points, pattern, turns
        self.galerkin: Galerkin | None = None
        self.memory: Array | None = None


class Hierarchy:
    """All levels of a mesh, finest first; collective.

    Parameters
    ----------
    points : Points
    pattern : BlockPattern
    interpolations : sequence of InterpolationRows
        Between the levels, finest first.
    vertex_matrix : VertexMatrix, optional
        Given if edges carry unknowns.
    spare : bool
        Whether the finest level's block rows may be overwritten once its sweeps have copied them.

    Attributes
    ----------
    levels : list of Level
    rows : (n_stored, 3, 3) or None
        If ``vertex_matrix`` and ``spare`` are given: array for the finest level's block rows, in its memory.
    """

    def __init__(
        self,
        points: Points,
        pattern: BlockPattern,
        interpolations: Sequence[InterpolationRows],
        vertex_matrix: VertexMatrix | None = None,
        *,
        spare: bool = False,
    ) -> None:
        self._vertex_matrix = vertex_matrix
        level = Level(points, pattern, vertex_matrix.turns if vertex_matrix else None)
        self.rows: Array | None = None
        self._spare, self._overwritten = spare, False
        if vertex_matrix is not None:
            from lyra_petsc.linear.edge_sweeps import memory_sizes  # only needed here

            # if rows are spare, their copy overwrites them and the vertices' rows use the vectors' part;
            # else the vertices' rows begin at 0, as they are projected before the sweeps copy anything
            of_rows, of_vectors = memory_sizes(pattern)
            begin = of_rows if spare else 0
            size = max(of_rows + of_vectors, begin + 9 * vertex_matrix.pattern.n_blocks)
            level.memory = np.zeros(max(size, 9 * pattern.n_stored) if spare else size)
            self._vertex_memory = level.memory[begin:]
            if spare:
                self.rows = level.memory[: 9 * pattern.n_stored].reshape(-1, 3, 3)
        self.levels = [level]
        for interpolation in interpolations:
            rows = interpolation.start, interpolation.parents, interpolation.weights, interpolation.bounds
            fine = (
                vertex_matrix.pattern
                if vertex_matrix is not None and level is self.levels[0]
                else level.pattern
            )
            level.galerkin = Galerkin(level.points, fine, *rows)
            level = Level(level.galerkin.points, level.galerkin.pattern)
            self.levels.append(level)

    def rows_changed(self) -> None:
        """Tell that ``rows`` were set to those of a new matrix."""
        self._overwritten = False

    def entries(self) -> Array:
        """The last values of ``rows``; once they are overwritten, the sweeps' copy in single precision."""
        finest = self.levels[0]
        assert self.rows is not None
        assert finest.memory is not None
        if not self._overwritten:
            return self.rows
        kept = finest.memory.view(np.float32)[: self.rows.size].reshape(self.rows.shape)
        return kept.astype(np.float64)

    def block_rows(self, values: Array, held: Mask) -> Iterator[tuple[Array, Array]]:
        """Block rows of each level, finest first, from those of the finest; collective.

        Each is computed on demand, when the one before should be freed; those in ``rows`` are overwritten.

        Parameters
        ----------
        values : (n_blocks, 3, 3)
            Block rows of the finest level.
        held : (n_local, 3)
            Mask of the prescribed coordinates of the finest level.

        Yields
        ------
        values : (n_blocks, 3, 3)
        free : (n_owned, 3)
            1 for coordinates that take part in interpolation, 0 for others; on the finest level (n_vertices,
            3), as edges take no part.
        """
        finest = self.levels[0]
        free = np.where(held[: finest.pattern.n_diagonal], 0.0, 1.0)
        projected: tuple[Array, Array] | None = None
        if self._vertex_matrix is not None and not self._spare and finest.galerkin is not None:
            projected = finest.galerkin.project(self._vertex_matrix.values(held, self._vertex_memory), free)
        for level in self.levels:
            yield values, free
            if self._vertex_matrix is not None and self._spare and level is finest:
                self._overwritten = True
                values = self._vertex_matrix.values(held, self._vertex_memory)
            if projected is not None:
                (values, free), projected = projected, None
            elif level.galerkin is not None:
                values, free = level.galerkin.project(values, free)

    def destroy(self) -> None:
        """Free the communication objects of the coarse levels; collective."""
        for level in self.levels[1:]:
            level.points.destroy()
        self.levels = []


def interpolations(layout: Layout, surface: Surface, max_levels: int) -> list[InterpolationRows]:
    """This rank's rows of the interpolations between at most max_levels levels, finest first; collective.

    Rank 0 builds all coarse meshes, in the vertex numbering of a run on one rank, so that they depend neither
    on the number of ranks nor on the partition, which varies. Rows of edges are empty.
    """
    comm, n = layout.comm, layout.n_vertices
    first_owned = surface.triangles[:, 0] < n  # each triangle is sent once
    corners = layout.vertex_numbers(layout.global_number[surface.triangles[first_owned]])
    ties = [(layout.vertex_numbers(layout.global_number[rows]), factors) for rows, factors in surface.ties]
    parts = comm.gather((surface.x, corners, layout.mesh_vertices, ties))
    shares: list[list[InterpolationRows]] = []
    if parts is not None:
        *arrays, tied = zip(*parts, strict=True)
        x, triangles, original = map(np.concatenate, arrays)
        del parts, arrays
        serial = np.arange(len(x)) if comm.size == 1 else _serial_numbers(triangles, original)
        every = sorted(
            list(zip(serial[vertices].tolist(), factors.tolist(), strict=True))
            for of_rank in tied
            for of_term in of_rank
            for vertices, factors in zip(*of_term, strict=True)
        )
        combinations = [{vertex: factor for vertex, factor in tie if factor != 0.0} for tie in every]
        shares = _shares(x, triangles, serial, layout.vertex_bounds, max_levels, combinations)
    share: list[InterpolationRows] = comm.scatter(shares)
    if share and layout.n_owned > n:
        start = share[0].start
        share[0] = replace(share[0], start=np.append(start, np.full(layout.n_owned - n, start[-1])))
    return share


def _serial_numbers(triangles: Ints, original: Ints) -> Ints:
    """Number (N,) of each vertex in a run on one rank; ``original`` (N,) are its numbers in the mesh file."""
    position: Ints = locality_order(vertex_graph([original[triangles]], len(original)))[original]
    return position


def _shares(
    x: Array, triangles: Ints, serial: Ints, bounds: Ints, max_levels: int, ties: list[Combination]
) -> list[list[InterpolationRows]]:
    """Rows of each rank, from all vertices x (N, 3) and triangles (F, 3) in global numbers.

    ``serial`` (N,) are the vertices' numbers in a run on one rank, in which coarse meshes are built; ``ties``
    are in these numbers.
    """
    shares: list[list[InterpolationRows]] = [[] for _ in bounds[1:]]
    number = np.argsort(serial)
    x, triangles = x[number], serial[triangles]
    triangles = triangles[np.lexsort(np.sort(triangles, axis=1).T[::-1])]
    unknown = serial  # the vertex of the mesh that is each unknown
    tied: TiedVertices | None = None
    rows: CoarseMesh | CompressedRows
    levels = 1
    while levels < max_levels and (len(unknown) > COARSEST or levels == 1):
        if ties and tied is None:
            from lyra_petsc.linear.tied_vertices import TiedVertices  # only needed here

            vertices, tied = np.arange(len(x)), TiedVertices(len(x), ties)
            free, rows, nearest = tied.free, tied.rows, tied.nearest
        else:
            rows = coarse = coarsen(x, triangles)
            vertices = coarse.vertices
            x, triangles = x[vertices], coarse.triangles
            free = nearest = np.arange(len(vertices))
            if tied is not None:
                tied = tied.coarse(coarse)
                free, rows, nearest = tied.free, tied.after(coarse), tied.nearest
            if len(free) > MAX_RATIO * len(unknown):
                break
        kept = number[vertices[free]]
        coarse_bounds = np.searchsorted(np.sort(kept), bounds)
        coarse_number = np.argsort(np.argsort(kept, kind="stable"))
        for share, lo, hi in zip(shares, bounds, bounds[1:], strict=False):
            first, counts = rows.start[unknown[lo:hi]], np.diff(rows.start)[unknown[lo:hi]]
            start = row_pointers(counts)
            at = np.arange(start[-1]) + np.repeat(first - start[:-1], counts)
            parents = coarse_number[rows.parents[at]]
            share.append(InterpolationRows(coarse_bounds, start, parents, rows.weights[at]))
        number, unknown, bounds = coarse_number[nearest], free[np.argsort(coarse_number)], coarse_bounds
        levels += 1
    return shares
