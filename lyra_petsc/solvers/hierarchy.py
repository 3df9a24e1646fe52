"""The levels of geometric multigrid: coarse meshes, interpolation from them, and Galerkin products."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.assembly.galerkin import Galerkin
from lyra_petsc.assembly.pattern import BlockPattern
from lyra_petsc.meshing.topology import boundary_edges
from lyra_petsc.partition.points import Points
from lyra_petsc.solvers.coarsening import Coarse, coarsen

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

COARSEST = 300
"""Vertices, over all ranks, at which a factorisation takes over."""

WORTH = 0.7
"""Fraction of the vertices left by a coarsening above which another brings nothing."""


@dataclass(frozen=True)
class Surface:
    """A rank's part of the mesh.

    Attributes
    ----------
    x : (n_local, 3)
        Positions [m] that interpolation follows.
    triangles : (F, 3)
        Local numbering.
    """

    x: Array
    triangles: NDArray[np.int32]


class Level:
    """Block rows of one level, and, but for the coarsest, the interpolation to it from the next coarser one.

    Attributes
    ----------
    points : Points
    pattern : BlockPattern
    values : (n_blocks, 3, 3)
    free : (n_owned, 3)
        0 for coordinates that take no part in interpolation, 1 for others.
    coarse : Coarse or None
    galerkin : Galerkin or None
        Makes the next coarser level's block rows.
    """

    def __init__(self, points: Points, pattern: BlockPattern) -> None:
        self.points, self.pattern = points, pattern
        self.values: Array = np.zeros((0, 3, 3))
        self.free: Array = np.ones((points.n_owned, 3))
        self.coarse: Coarse | None = None
        self.galerkin: Galerkin | None = None


class Hierarchy:
    """All levels of a mesh, finest first.

    Parameters
    ----------
    points : Points
    pattern : BlockPattern
    surface : Surface
    most : int
        Levels.

    Attributes
    ----------
    levels : list of Level
    """

    def __init__(self, points: Points, pattern: BlockPattern, surface: Surface, most: int) -> None:
        level = Level(points, pattern)
        self.levels = [level]
        n = points.n_owned
        x = surface.x[:n]
        triangles = surface.triangles[(surface.triangles < n).all(axis=1)].astype(np.int64)
        edge = _edge(surface.triangles, points)
        while len(self.levels) < most and (level.points.n_global > COARSEST or len(self.levels) == 1):
            coarse = coarsen(x, triangles, edge)
            left = points.comm.allreduce(len(coarse.vertices))
            if left > WORTH * level.points.n_global:
                break
            level.coarse = coarse
            interpolation = coarse.start, coarse.parents, coarse.weights, len(coarse.vertices)
            level.galerkin = Galerkin(level.points, level.pattern, *interpolation)
            level = Level(level.galerkin.points, level.galerkin.pattern)
            self.levels.append(level)
            x, triangles, edge = x[coarse.vertices], coarse.triangles, edge[coarse.vertices]

    def set(self, values: Array, held: Mask) -> None:
        """New block rows of the finest level; ``held`` (n_local, 3) are the prescribed coordinates."""
        finest = self.levels[0]
        finest.values, finest.free = values, np.where(held[: finest.points.n_owned], 0.0, 1.0)
        for level, coarser in zip(self.levels, self.levels[1:], strict=False):
            assert level.galerkin is not None
            level.galerkin.project(level.values, level.free)
            coarser.values, coarser.free = level.galerkin.values, level.galerkin.free

    def destroy(self) -> None:
        """Free the communication objects of the coarse levels; collective."""
        for level in self.levels[1:]:
            level.points.destroy()
        self.levels = []


def _edge(triangles: NDArray[np.int32], points: Points) -> Mask:
    """Owned vertices (n_owned,) where the sheet ends; all triangles around them are among the rank's."""
    ends = boundary_edges(triangles.astype(np.int64)).edges
    edge = np.zeros(points.n_local, dtype=bool)
    edge[ends[(ends < points.n_owned).any(axis=1)]] = True
    return edge[: points.n_owned]
