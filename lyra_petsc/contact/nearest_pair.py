"""The pair of parts of sheets and obstacles that is nearest, or that stops a step; collective."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.contact.obstacle_points import ObstaclePositions
from lyra_petsc.contact.scene_contact import SceneContact
from lyra_petsc.mesh.points import describe_worst

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


def nearest_pair(contact: SceneContact, x: Array, frozen: ObstaclePositions) -> NearPair | None:
    """The pair with the smallest gap at positions x (n_local, 3); None where none is near; collective."""
    gaps = contact.barrier.gaps(x, frozen)
    return _worst(contact, x, frozen, _nearness(contact, gaps))


def blocking_pair(contact: SceneContact, x: Array, frozen: ObstaclePositions) -> NearPair | None:
    """The pair at which a failed step collides first; collective.

    If no displacement was refused, it is the nearest pair at positions x (n_local, 3).
    """
    refused = contact.collisions.refused
    if refused is None:
        return nearest_pair(contact, x, frozen)
    steps = contact.barrier.largest_steps(refused.x, refused.displacement, frozen, refused.part)
    return _worst(contact, refused.x, frozen, 1.0 - steps[: contact.barrier.n_owned])


def nearest_obstacle(contact: SceneContact, x: Array, frozen: ObstaclePositions) -> NearPair | None:
    """The nearest touching pair with an obstacle at positions x (n_local, 3); collective."""
    barrier, gaps = contact.barrier, contact.barrier.gaps(x, frozen)
    touches = (gaps < 2.0 * contact.skin) & (barrier.pairs.obstacle[: len(gaps)] >= 0)
    return _worst(contact, x, frozen, np.where(touches, _nearness(contact, gaps), 0.0))


def _nearness(contact: SceneContact, gaps: Array) -> Array:
    nearness: Array = 1.0 / np.maximum(gaps, TOUCHING * contact.skin)
    return nearness


def _worst(contact: SceneContact, x: Array, frozen: ObstaclePositions, badness: Array) -> NearPair | None:
    """The pair with the largest positive badness (n_owned,) at positions x (n_local, 3), or None;
    collective.
    """
    layout, barrier = contact.layout, contact.barrier
    if not layout.global_max(float(badness.max(initial=0.0)))[0] > 0.0:
        return None
    numbers = layout.mesh_vertex_of_local()
    first = numbers[barrier.stencil[: len(badness)]].min(axis=1)

    def describe(row: int) -> NearPair:
        pair, gap = barrier.pair(row), float(barrier.gaps(x, frozen)[row])
        middle = tuple(float(value) for value in x[list(pair.parts[0])].mean(axis=0))
        gap = gap if gap > TOUCHING * contact.skin else min(gap, 0.0)
        parts = tuple(tuple(int(numbers[point]) for point in part) for part in pair.parts)
        blocks = contact.collisions.refused is not None or gap <= TIGHT * contact.skin
        return NearPair(parts, pair.obstacle, middle, gap, pair.thickness, blocks)

    return describe_worst(layout.comm, badness, first, describe)


def _named(part: tuple[int, ...]) -> str:
    if len(part) == 1:
        return f"vertex {part[0]}"
    numbers = sorted(part)
    return (
        f"edge {numbers[0]}-{numbers[1]}" if len(part) == 2 else f"the triangle {'-'.join(map(str, numbers))}"
    )
