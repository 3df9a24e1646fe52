"""The pair of parts of sheets and obstacles that is nearest, or that stops a step; collective."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.failure.failure_diagnosis import describe_worst
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.term import Elastic

TOUCHING = 2e-9
"""Gap over the skin of contact below which the gap counts as closed."""

TIGHT = 0.1
"""Gap over the skin below which the gap counts as nearly closed."""


@dataclass(frozen=True)
class NearPair:
    """Two parts of sheets, or a part of a sheet and an obstacle.

    Attributes
    ----------
    parts : tuple of tuples of int
        Vertices of each part of a sheet, by their numbers in the mesh: one of a vertex, two of an edge, three
        of a triangle.
    obstacle : str
        Name of the obstacle; empty between sheets.
    position : tuple of 3 floats
        Middle of the first part [m].
    gap, kept : float
        Distance minus the distance to keep, and the distance to keep [m].
    blocks : bool
        Whether the pair stops a step, or its gap is nearly closed.
    """

    parts: tuple[tuple[int, ...], ...]
    obstacle: str
    position: tuple[float, ...]
    gap: float
    kept: float
    blocks: bool

    @property
    def text(self) -> str:
        """Description of the pair and its position."""
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
    """The pair at which a failed step collides first; collective.

    If no displacement was refused, it is the nearest pair at the positions last evaluated.
    """
    refused = system.collisions.refused
    if refused is None:
        return nearest_pair(system, system.evaluated[0])

    def obstruction(term: Elastic) -> Array:
        x, displacement, part = refused
        return 1.0 - term.collision_free_fractions(x, displacement, system.active.frozen[term], part)

    return _worst(system, refused.x, obstruction)


def nearest_obstacle(system: StageEquations) -> NearPair | None:
    """The nearest touching pair with an obstacle at the positions last evaluated; collective."""

    def nearness(term: Elastic) -> Array:
        gaps = _gaps(system, term, system.evaluated[0])
        rows = [row for row in np.flatnonzero(gaps < 2.0 * term.skin) if term.pair(int(row)).obstacle]
        out = np.zeros(len(gaps))
        out[rows] = 1.0 / np.maximum(gaps[rows], TOUCHING * term.skin)
        return out

    return _worst(system, system.evaluated[0], nearness)


def _gaps(system: StageEquations, term: Elastic, x: Array) -> Array:
    return term.gaps(x, system.active.frozen[term])


def _worst(system: StageEquations, x: Array, badness: Callable[[Elastic], Array]) -> NearPair | None:
    """The pair with the largest positive badness at positions x (n_local, 3), or None; collective.

    ``badness`` gives a number for each owned element of a term.
    """
    terms = [term for term in system.active.elastic if term.registration.neighbours]
    if not terms:
        return None
    points, by_term = system.points, [badness(term) for term in terms]
    values = np.concatenate(by_term)
    if not points.comm.allreduce(float(values.max(initial=0.0)), MPI.MAX) > 0.0:
        return None
    numbers = points.mesh_vertex_of_local()
    ends = np.cumsum([len(part) for part in by_term])
    stencils = [term.stencil[: len(part)] for term, part in zip(terms, by_term, strict=True)]
    first = np.concatenate([numbers[stencil].min(axis=1) for stencil in stencils])

    def describe(row: int) -> NearPair:
        which = int(np.searchsorted(ends, row, side="right"))
        term, row = terms[which], row - int(ends[which] - len(by_term[which]))
        pair = term.pair(row)
        middle = tuple(float(value) for value in x[list(pair.parts[0])].mean(axis=0))
        gap = float(_gaps(system, term, x)[row])
        gap = gap if gap > TOUCHING * term.skin else min(gap, 0.0)
        parts = tuple(tuple(int(numbers[point]) for point in part) for part in pair.parts)
        blocks = system.collisions.refused is not None or gap <= TIGHT * term.skin
        return NearPair(parts, pair.obstacle, middle, gap, pair.thickness, blocks)

    return describe_worst(points.comm, values, first, describe)


def _named(part: tuple[int, ...]) -> str:
    if len(part) == 1:
        return f"vertex {part[0]}"
    numbers = sorted(part)
    return (
        f"edge {numbers[0]}-{numbers[1]}" if len(part) == 2 else f"the triangle {'-'.join(map(str, numbers))}"
    )
