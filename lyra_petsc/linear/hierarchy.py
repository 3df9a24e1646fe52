"""The levels of geometric multigrid: coarse meshes, interpolation from them, and Galerkin products."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.linear.coarsening import coarsen
from lyra_petsc.linear.galerkin import Galerkin
from lyra_petsc.linear.pattern import BlockPattern, row_pointers
from lyra_petsc.mesh.partitioner import locality_order, vertex_graph
from lyra_petsc.mesh.points import Layout, Points

if TYPE_CHECKING:
    from lyra_petsc.terms.edge_turns import EdgeTurns


COARSEST = 100
"""Vertices, over all ranks, at which a factorisation takes over."""

WORTH = 0.7
"""Fraction of the vertices left by a coarsening above which another brings nothing."""


@dataclass(frozen=True)
class Surface:
    """A rank's part of the mesh.

    Attributes
    ----------
    x : (n_vertices, 3)
        Positions [m] of the owned vertices that interpolation follows.
    triangles : (F, 3)
        Local numbering.
    """

    x: Array
    triangles: NDArray[np.int32]


@dataclass(frozen=True)
class InterpolationRows:
    """A rank's rows of the interpolation from a coarser level.

    Attributes
    ----------
    bounds : (ranks + 1,)
        First coarse vertex of each rank.
    start : (n_owned + 1,)
        Where each vertex' parents begin.
    parents : (P,)
        Coarse vertices that it is interpolated from, in global numbers.
    weights : (P,)
    """

    bounds: Ints
    start: Ints
    parents: Ints
    weights: Array


class WithoutEdges(Protocol):
    """Stands for the finest level's matrix where coarser ones, without unknowns of edges, are made.

    Attributes
    ----------
    pattern : BlockPattern
        Of the same rows as the finest level's; those of edges are empty.
    turns : EdgeTurns
        How edges follow vertices.
    """

    pattern: BlockPattern
    turns: EdgeTurns

    def values(self, held: Mask, memory: Array) -> Array:
        """Its block rows (n_blocks, 3, 3) now, in ``memory``, and ``turns`` with them; held (n_local, 3) are
        prescribed.
        """


class Level:
    """Points of one level, and, but for the coarsest, what makes the next coarser one.

    Attributes
    ----------
    points : Points
    pattern : BlockPattern
    galerkin : Galerkin or None
        Interpolates from the next coarser level, and makes its block rows.
    turns : EdgeTurns or None
        How unknowns of edges, that nothing is interpolated to, follow the vertices.
    memory : (n,) float64 or None
        Where edges carry unknowns, what the sweeps work in; before that, the block rows below are in it.
    """

    def __init__(self, points: Points, pattern: BlockPattern, turns: EdgeTurns | None = None) -> None:
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
    below : WithoutEdges, optional
        Where edges carry unknowns.
    spare : bool
        The finest level's block rows are of no use once it has taken them.

    Attributes
    ----------
    levels : list of Level
    rows : (n_stored, 3, 3) or None
        Where ``below`` is given and rows are spare: where the finest level's should be, in its memory.
    """

    def __init__(
        self,
        points: Points,
        pattern: BlockPattern,
        interpolations: Sequence[InterpolationRows],
        below: WithoutEdges | None = None,
        *,
        spare: bool = False,
    ) -> None:
        self._below = below
        level = Level(points, pattern, below.turns if below else None)
        self.rows: Array | None = None
        self._spare, self._overwritten = spare, False
        if below is not None:
            from lyra_petsc.linear.edge_sweeps import room  # of use for nothing else

            # copies of rows take the place of these, if they are spare, and then what is below that of the
            # vectors; else what is below comes first of all
            of_rows, of_vectors = room(pattern)
            begin = of_rows if spare else 0
            least = max(of_rows + of_vectors, begin + 9 * below.pattern.n_blocks)
            level.memory = np.zeros(max(least, 9 * pattern.n_stored) if spare else least)
            self._room_below = level.memory[begin:]
            if spare:
                self.rows = level.memory[: 9 * pattern.n_stored].reshape(-1, 3, 3)
        self.levels = [level]
        for interpolation in interpolations:
            rows = interpolation.start, interpolation.parents, interpolation.weights, interpolation.bounds
            fine = below.pattern if below is not None and level is self.levels[0] else level.pattern
            level.galerkin = Galerkin(level.points, fine, *rows)
            level = Level(level.galerkin.points, level.galerkin.pattern)
            self.levels.append(level)

    def rows_changed(self) -> None:
        """``rows`` are those of a new matrix."""
        self._overwritten = False

    def entries(self) -> Array:
        """What ``rows`` were set to, or what the sweeps keep of that, in single precision."""
        finest = self.levels[0]
        assert self.rows is not None
        assert finest.memory is not None
        if not self._overwritten:
            return self.rows
        kept = finest.memory.view(np.float32)[: self.rows.size].reshape(self.rows.shape)
        return kept.astype(np.float64)

    def block_rows(self, values: Array, held: Mask) -> Iterator[tuple[Array, Array]]:
        """Of each level, finest first, the block rows that those of the finest make; collective.

        Each is made when it is asked for, and the one before should be freed by then; in ``rows`` the finest
        ones are overwritten.

        Parameters
        ----------
        values : (n_blocks, 3, 3)
            Of the finest level.
        held : (n_local, 3)
            Its prescribed coordinates.

        Yields
        ------
        values : (n_blocks, 3, 3)
        free : (n_owned, 3)
            0 for coordinates that take no part in interpolation, 1 for others; of the finest level those of
            vertices alone, as edges take none.
        """
        finest = self.levels[0]
        free = np.where(held[: finest.pattern.n_diagonal], 0.0, 1.0)
        below: tuple[Array, Array] | None = None
        if self._below is not None and not self._spare and finest.galerkin is not None:
            below = finest.galerkin.project(self._below.values(held, self._room_below), free)
        for level in self.levels:
            yield values, free
            if self._below is not None and self._spare and level is finest:
                self._overwritten = True
                values = self._below.values(held, self._room_below)
            if below is not None:
                (values, free), below = below, None
            elif level.galerkin is not None:
                values, free = level.galerkin.project(values, free)

    def destroy(self) -> None:
        """Free the communication objects of the coarse levels; collective."""
        for level in self.levels[1:]:
            level.points.destroy()
        self.levels = []


def interpolations(layout: Layout, surface: Surface, most: int) -> list[InterpolationRows]:
    """This rank's rows of the interpolations between at most so many levels, finest first; collective.

    Rank 0 makes all coarse meshes, in the order in which one rank numbers vertices: so they do not depend on
    the ranks, nor on the partition, which is another each time. Nothing is interpolated to the unknowns of
    edges.
    """
    comm, n = layout.comm, layout.n_vertices
    first_owned = surface.triangles[:, 0] < n  # each triangle is sent once
    corners = layout.vertex_numbers(layout.global_number[surface.triangles[first_owned]])
    parts = comm.gather((surface.x, corners, layout.mesh_vertices))
    shares: list[list[InterpolationRows]] = []
    if parts is not None:
        x, triangles, original = (np.concatenate(pieces) for pieces in zip(*parts, strict=True))
        del parts
        place = np.arange(len(x)) if comm.size == 1 else _places(triangles, original)
        shares = _shares(x, triangles, place, layout.vertex_bounds, most)
    share: list[InterpolationRows] = comm.scatter(shares)
    if share and layout.n_owned > n:
        start = share[0].start
        share[0] = replace(share[0], start=np.append(start, np.full(layout.n_owned - n, start[-1])))
    return share


def _places(triangles: Ints, original: Ints) -> Ints:
    """Number (N,) that each vertex has on one rank; ``original`` (N,) are their positions in the mesh."""
    position: Ints = locality_order(vertex_graph([original[triangles]], len(original)))[original]
    return position


def _shares(x: Array, triangles: Ints, place: Ints, bounds: Ints, most: int) -> list[list[InterpolationRows]]:
    """Of each rank its rows, from all vertices x (N, 3) and triangles (F, 3) in global numbers.

    ``place`` (N,) are the vertices' places in the order in which coarse meshes are made.
    """
    shares: list[list[InterpolationRows]] = [[] for _ in bounds[1:]]
    number = np.argsort(place)
    x, triangles = x[number], place[triangles]
    triangles = triangles[np.lexsort(np.sort(triangles, axis=1).T[::-1])]
    levels = 1
    while levels < most and (len(x) > COARSEST or levels == 1):
        coarse = coarsen(x, triangles)
        if len(coarse.vertices) > WORTH * len(x):
            break
        kept = number[coarse.vertices]
        below = np.searchsorted(np.sort(kept), bounds)
        number_below = np.argsort(np.argsort(kept))
        place = np.argsort(number)
        for share, lo, hi in zip(shares, bounds, bounds[1:], strict=False):
            first, counts = coarse.start[place[lo:hi]], np.diff(coarse.start)[place[lo:hi]]
            start = row_pointers(counts)
            rows = np.arange(start[-1]) + np.repeat(first - start[:-1], counts)
            parents = number_below[coarse.parents[rows]]
            share.append(InterpolationRows(below, start, parents, coarse.weights[rows]))
        x, triangles, number, bounds = x[coarse.vertices], coarse.triangles, number_below, below
        levels += 1
    return shares
