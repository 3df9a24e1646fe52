"""Which two parts of sheets and obstacles are nearest, or in each other's way; collective."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.failure_diagnosis import worst
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.term import Elastic

TOUCHING = 2e-9
"""Gap over the skin of a search up to which there is none."""

TIGHT = 0.1
"""The same, up to which next to nothing is left."""


@dataclass(frozen=True)
class NearPair:
    """Two parts of sheets, or one of a sheet and an obstacle.

    Attributes
    ----------
    parts : tuple of tuples of int
        Vertices of each part of a sheet, by their numbers in the mesh: one, two of an edge, three of a
        triangle.
    obstacle : str
        Its name; empty between sheets.
    position : tuple of 3 floats
        Middle of the first part [m].
    gap, kept : float
        Distance less what is to be kept, and this [m].
    blocks : bool
        A step may not go its way because of it, or next to nothing is left of the distance at which the
        parts begin to feel each other.
    """

    parts: tuple[tuple[int, ...], ...]
    obstacle: str
    position: tuple[float, ...]
    gap: float
    kept: float
    blocks: bool

    @property
    def words(self) -> str:
        """Which and where."""
        named = [_named(part) for part in self.parts]
        if self.obstacle:
            named.append(f"the obstacle {self.obstacle!r}")
        x, y, z = self.position
        return f"{' and '.join(named)}, around ({x:.4g}, {y:.4g}, {z:.4g}) m,"


def nearest_pair(system: StageEquations, x: Array) -> NearPair | None:
    """The pair with the smallest gap at positions x (n_local, 3); None where none is near; collective."""

    def nearness(term: Elastic) -> Array:
        return 1.0 / np.maximum(_gaps(system, term, x), TOUCHING * term.skin)

    return _worst(system, x, nearness)


def worst_pair(system: StageEquations) -> NearPair | None:
    """Of a step that failed: the pair that lets go the least of the way that it may not go; without such a
    way the nearest one where the solver stands; collective.
    """
    way = system.refused_way
    if way is None:
        return nearest_pair(system, system.evaluated[0])

    def obstruction(term: Elastic) -> Array:
        return 1.0 - term.collision_free_fractions(way.x, way.ahead, system.active.frozen[term], way.part)

    return _worst(system, way.x, obstruction)


def nearest_obstacle(system: StageEquations) -> NearPair | None:
    """The nearest pair with an obstacle that touches where the solver stands; collective."""

    def nearness(term: Elastic) -> Array:
        gaps = _gaps(system, term, system.evaluated[0])
        touch = [row for row in np.flatnonzero(gaps < 2.0 * term.skin) if term.pair(int(row)).obstacle]
        out = np.zeros(len(gaps))
        out[touch] = 1.0 / np.maximum(gaps[touch], TOUCHING * term.skin)
        return out

    return _worst(system, system.evaluated[0], nearness)


def _gaps(system: StageEquations, term: Elastic, x: Array) -> Array:
    return term.gaps(x, system.active.frozen[term])


def _worst(system: StageEquations, x: Array, sizes: Callable[[Elastic], Array]) -> NearPair | None:
    """The counted element of the largest size above 0, at positions x (n_local, 3)."""
    terms = [term for term in system.active.elastic if term.registration.neighbours]
    if not terms:
        return None
    points, found = system.points, [sizes(term) for term in terms]
    sized = np.concatenate(found)
    if not points.comm.allreduce(float(sized.max(initial=0.0)), MPI.MAX) > 0.0:
        return None
    numbers = points.mesh_vertex_of_local()
    ends = np.cumsum([len(size) for size in found])
    first = [numbers[term.stencil[: len(size)]].min(axis=1) for term, size in zip(terms, found, strict=True)]

    def describe(row: int) -> NearPair:
        which = int(np.searchsorted(ends, row, side="right"))
        term, row = terms[which], row - int(ends[which] - len(found[which]))
        pair = term.pair(row)
        middle = tuple(float(value) for value in x[list(pair.parts[0])].mean(axis=0))
        gap = float(_gaps(system, term, x)[row])
        gap = gap if gap > TOUCHING * term.skin else min(gap, 0.0)
        parts = tuple(tuple(int(numbers[point]) for point in part) for part in pair.parts)
        blocks = system.refused_way is not None or gap <= TIGHT * term.skin
        return NearPair(parts, pair.obstacle, middle, gap, pair.thickness, blocks)

    return worst(points.comm, sized, np.concatenate(first), describe)


def _named(part: tuple[int, ...]) -> str:
    if len(part) == 1:
        return f"vertex {part[0]}"
    numbers = sorted(part)
    return (
        f"edge {numbers[0]}-{numbers[1]}" if len(part) == 2 else f"the triangle {'-'.join(map(str, numbers))}"
    )
