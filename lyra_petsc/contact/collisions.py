"""Collisions in a step: how far the sheet can move without any, and from where a solve can start.

The sheet and its obstacles must pass no part of each other on their way. The barrier finds that for the near
pairs; here the search for these pairs is extended where a displacement leaves what is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.contact.obstacle_points import ObstaclePositions, StepInterval
from lyra_petsc.contact.pair_search import PairSearch
from lyra_petsc.linear.discretisation import Discretisation

MAX_SEARCHES = 40
"""Largest number of searches for near pairs along one displacement."""

MIN_KNOWN = 0.3
"""If the near pairs are known on less than this fraction of a displacement, the search covers all of it."""

MAX_SEPARATIONS = 40
"""Largest number of iterations that separate pairs which come too near."""


class RefusedDisplacement(NamedTuple):
    """A displacement that is not free of collisions.

    Attributes
    ----------
    x, displacement : (n_local, 3)
        Start positions and displacements [m].
    part : StepInterval
        The part of the step in which the obstacles move meanwhile.
    """

    x: Array
    displacement: Array
    part: StepInterval


class Collisions:
    """Limits of motion; every method is collective.

    Positions x and displacements dx are those of the owned rows, (n_owned, 3) [m]; ``frozen`` are the
    obstacles in the step.

    Attributes
    ----------
    refused : RefusedDisplacement or None
        The displacement of the present step that was found to collide.
    """

    def __init__(self, discretisation: Discretisation, search: PairSearch, barrier: ContactBarrier) -> None:
        self._discretisation, self._search, self._barrier = discretisation, search, barrier
        self.refused: RefusedDisplacement | None = None

    def _local(self, x: Array, dx: Array) -> tuple[Array, Array]:
        """Both with ghost rows, (n_local, 3)."""
        layout = self._discretisation.layout
        return layout.extended(x), layout.extended(dx)

    def known_displacement(
        self, x: Array, dx: Array, minimum: float = MIN_KNOWN
    ) -> tuple[Array, Array, float]:
        """Both as arrays of local rows, and the fraction of dx on which all near pairs are known.

        Where the fraction is less than ``minimum``, pairs are searched along the whole displacement.
        """
        here, displacement = self._local(x, dx)
        known = self._search.fraction_covered(here, displacement)
        if known < minimum:
            self._search.update(here, displacement)
            here, displacement = self._local(x, dx)
            known = self._search.fraction_covered(here, displacement)
        return here, displacement, known

    def limit(self, x: Array, dx: Array, frozen: ObstaclePositions, maximum: float = 1.0) -> float:
        """Largest fraction, at most ``maximum``, of dx without a collision with obstacles at the stage."""
        done = 0.0
        for _ in range(MAX_SEARCHES):
            rest = (maximum - done) * dx if done > 0.0 or maximum < 1.0 else dx
            here, displacement, known = self.known_displacement(x + done * dx if done > 0.0 else x, rest)
            fraction = known
            if self._search.near:
                allowed = min(known, self._barrier.largest_step(here, displacement, frozen))
                fraction = -self._discretisation.layout.global_max(-allowed)[0]
            if fraction == 1.0:
                return maximum
            done += fraction * (maximum - done)
            if fraction < known:
                break
        return done

    def separate(self, x: Array, dx: Array, frozen: ObstaclePositions, free: Mask) -> Array | None:
        """The displacement dx, changed to separate the pairs that it brings too near; only unknowns that are
        ``free`` (n_owned, 3) change. None if no pair comes too near.

        Along a linear increment a sheet that rotates comes nearer to its contacts, or passes them, by the
        square of its rotation. (Nocedal & Wright, Numerical Optimization, 2nd ed., sec. 15.6.)
        """
        here, displacement, _ = self.known_displacement(x, dx, 1.0)
        if not self._search.near:
            return None
        layout, n, changed = self._discretisation.layout, len(dx), False
        targets = self._barrier.target_distances(here, displacement, frozen)
        for _ in range(MAX_SEPARATIONS):
            out, count = np.zeros_like(here), np.zeros((len(here), 1))
            found = self._barrier.add_corrections(here, displacement, frozen, targets, out, count)
            if not any(layout.global_max(found)):
                break
            change = np.divide(out[:n], count[:n], out=np.zeros((n, 3)), where=count[:n] > 0.0)
            displacement[:n] += np.where(free, change, 0.0)
            layout.update_ghosts(displacement)
            changed = True
        return displacement[:n] if changed else None

    def start(
        self,
        x: Array,
        guesses: Sequence[Array],
        driven: Array,
        free: Mask,
        frozen: ObstaclePositions,
        *,
        pushes: bool,
    ) -> Array | None:
        """A displacement from x, where the step begins, to its stage without a collision; None if none is
        found.

        The ``guesses`` are tried in this order, and then, with ``pushes``, with vertices moved by obstacles
        that would hit them. Unknowns that are not ``free`` (n_owned, 3) move by ``driven`` (n_owned, 3) [m],
        as they must.
        """
        tried = [(dx, pushed) for pushed in (False, True) for dx in guesses]
        refused = None
        pushes &= self._barrier.obstacles.moving
        for dx, pushed in tried if pushes else tried[: len(guesses)]:
            moved = np.where(free, self._moved_with_obstacles(x, dx, frozen) if pushed else dx, driven)
            if self.is_free(x, moved, frozen, StepInterval(0.0, 1.0)):
                self.refused = None
                return moved
            # keep the first one: with the sheet at rest it shows what moves into the sheet
            refused = refused or self.refused
        self.refused = refused
        return None

    def _moved_with_obstacles(self, x: Array, dx: Array, frozen: ObstaclePositions) -> Array:
        """The displacement, with vertices in the path of obstacles moved by them."""
        for _ in range(MAX_SEARCHES):
            moved = self._barrier.moved_with_obstacles(*self._local(x, dx), frozen)[: len(dx)]
            if not any(self._discretisation.layout.global_max(bool((moved != dx).any()))):
                break
            dx = moved
        return dx

    def is_free(self, x: Array, dx: Array, frozen: ObstaclePositions, interval: StepInterval) -> bool:
        """Whether nothing collides on the displacement dx from x while obstacles move as in an interval of
        the step. Sets `refused` on a collision.
        """
        done, length = 0.0, interval.end - interval.begin
        for _ in range(MAX_SEARCHES):
            here, displacement, known = self.known_displacement(x + done * dx, (1.0 - done) * dx)
            displacement *= known
            end = 1.0 if known == 1.0 else done + known * (1.0 - done)
            part = StepInterval(interval.begin + done * length, interval.begin + end * length)
            collides = not self._barrier.is_collision_free(here, displacement, frozen, part)
            if any(self._discretisation.layout.global_max(collides)):
                break
            if known == 1.0:
                return True
            done = end
        self.refused = RefusedDisplacement(here, displacement, part)
        return False
