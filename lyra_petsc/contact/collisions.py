"""Collisions in a step: how far the sheet can move without any, and from where a solve can start.

The sheet and its obstacles must pass no part of each other on their way. The barrier finds that for the near
pairs; here the search for these pairs is extended where a displacement leaves what is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.contact.obstacle_points import ObstaclePositions
from lyra_petsc.contact.pair_search import PairSearch
from lyra_petsc.linear.discretisation import Discretisation

if TYPE_CHECKING:
    from lyra_petsc.contact.contact_model import ContactModel

MAX_ROUNDS = 40
"""Largest number of searches for near pairs along one displacement, and of iterations that separate pairs
which come too near."""

MIN_KNOWN = 0.3
"""If the near pairs are known on less than this fraction of a displacement, the search covers all of it."""


class RefusedDisplacement(NamedTuple):
    """A displacement that is not free of collisions.

    Attributes
    ----------
    x, displacement : (n_local, 3)
        Start positions and displacements [m].
    obstacles : ObstaclePositions
        The obstacles, which move meanwhile.
    """

    x: Array
    displacement: Array
    obstacles: ObstaclePositions


class Collisions:
    """Limits of motion in a step; every method is collective.

    Positions x and displacements dx are those of the owned rows, (n_owned, 3) [m].

    Parameters
    ----------
    discretisation : Discretisation
    search : PairSearch
    barrier : ContactBarrier
    obstacles : ObstaclePositions
        In the step.
    """

    def __init__(
        self,
        discretisation: Discretisation,
        search: PairSearch,
        barrier: ContactBarrier,
        obstacles: ObstaclePositions,
    ) -> None:
        self._discretisation, self._search, self._barrier = discretisation, search, barrier
        self._obstacles = obstacles

    def _local(self, x: Array, dx: Array) -> tuple[Array, Array]:
        """Both with ghost rows, (n_local, 3)."""
        layout = self._discretisation.layout
        return layout.extended(x), layout.extended(dx)

    def _known(self, x: Array, dx: Array, minimum: float = MIN_KNOWN) -> tuple[Array, Array, float]:
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

    def largest_step(self, x: Array, dx: Array, maximum: float = 1.0) -> float:
        """Largest fraction, up to ``maximum``, of dx without a collision; obstacles are at the end."""
        done = 0.0
        for _ in range(MAX_ROUNDS):
            rest = (maximum - done) * dx if done > 0.0 or maximum < 1.0 else dx
            here, displacement, known = self._known(x + done * dx if done > 0.0 else x, rest)
            fraction = known
            if self._search.near:
                allowed = min(known, self._barrier.largest_step(here, displacement, self._obstacles))
                fraction = -self._discretisation.layout.global_max(-allowed)[0]
            if fraction == 1.0:
                return maximum
            done += fraction * (maximum - done)
            if fraction < known:
                break
        return done

    def separated(self, x: Array, dx: Array, free: Mask) -> Array | None:
        """The displacement dx, changed to separate the pairs that it brings too near; only unknowns that are
        ``free`` (n_owned, 3) change. None if no pair comes too near.

        Along a linear increment a sheet that rotates comes nearer to its contacts, or passes them, by the
        square of its rotation. (Nocedal & Wright, Numerical Optimization, 2nd ed., sec. 15.6.)
        """
        here, displacement, _ = self._known(x, dx, 1.0)
        if not self._search.near:
            return None
        layout, n, changed = self._discretisation.layout, len(dx), False
        targets = self._barrier.target_distances(here, displacement, self._obstacles)
        for _ in range(MAX_ROUNDS):
            out, count = np.zeros_like(here), np.zeros((len(here), 1))
            pairs = here, displacement, self._obstacles, targets
            if not any(layout.global_max(self._barrier.add_corrections(*pairs, out, count))):
                break
            change = np.divide(out[:n], count[:n], out=np.zeros((n, 3)), where=count[:n] > 0.0)
            displacement[:n] += np.where(free, change, 0.0)
            layout.update_ghosts(displacement)
            changed = True
        return displacement[:n] if changed else None

    def start(
        self, x: Array, guesses: Sequence[Array], driven: Array, free: Mask, *, with_obstacles: bool
    ) -> tuple[Array | None, RefusedDisplacement | None]:
        """A displacement from x, where the step begins, to its end without a collision; or None, and the
        first one that was refused.

        The ``guesses`` are tried in this order, and then, ``with_obstacles``, once more with vertices moved
        by obstacles that would hit them. Unknowns that are not ``free`` (n_owned, 3) move by ``driven``
        (n_owned, 3) [m], as they must.
        """
        trials = [(dx, carried) for carried in (False, True) for dx in guesses]
        first = None
        with_obstacles &= self._barrier.obstacles.moving
        for dx, carried in trials if with_obstacles else trials[: len(guesses)]:
            moved = np.where(free, self._moved_with_obstacles(x, dx) if carried else dx, driven)
            refused = self._collision(x, moved)
            if refused is None:
                return moved, None
            # keep the first one: with the sheet at rest it shows what moves into the sheet
            first = first or refused
        return None, first

    def _moved_with_obstacles(self, x: Array, dx: Array) -> Array:
        """The displacement, with vertices in the path of obstacles moved by them."""
        for _ in range(MAX_ROUNDS):
            moved = self._barrier.moved_with_obstacles(*self._local(x, dx), self._obstacles)[: len(dx)]
            if not any(self._discretisation.layout.global_max(bool((moved != dx).any()))):
                break
            dx = moved
        return dx

    def _collision(self, x: Array, dx: Array) -> RefusedDisplacement | None:
        """The part of the displacement dx from x in the step on which something collides."""
        done = 0.0
        for _ in range(MAX_ROUNDS):
            here, displacement, known = self._known(x + done * dx, (1.0 - done) * dx)
            displacement *= known
            end = 1.0 if known == 1.0 else done + known * (1.0 - done)
            obstacles = self._obstacles.part(done, end)
            collides = not self._barrier.is_collision_free(here, displacement, obstacles)
            if any(self._discretisation.layout.global_max(collides)):
                break
            if known == 1.0:
                return None
            done = end
        return RefusedDisplacement(here, displacement, obstacles)

    def touches(self, x: Array) -> bool:
        """Whether anything touches at positions x (n_local, 3) [m] at the end of the step."""
        if not self._search.near:
            return False
        pairs = self._barrier.active_pairs(x, self._obstacles.end).pair
        return any(self._discretisation.layout.global_max(len(pairs)))

    def stays_apart(self, x: Array, dx: Array) -> bool:
        """Whether nothing collides on the displacement dx from x in the step, nor touches at its end."""
        if self._collision(x, dx) is not None:
            return False
        return not self.touches(self._discretisation.layout.extended(x + dx))

    def may_collide(self, x: Array, dx: Array, approach: float) -> bool:
        """Whether parts may collide on the displacement dx from x, (n_local, 3) [m] each, approaching by more
        than ``approach`` [m].
        """
        if not self._search.near:
            return False
        collides = self._barrier.may_collide(x, dx, self._obstacles, approach)
        return any(self._discretisation.layout.global_max(collides))

    def model(self, x: Array, c: float, free: Mask) -> ContactModel:
        """Newton's model of contact at positions x, where displacements are c [s] times velocities, of the
        unknowns that are ``free`` (n_owned, 3).
        """
        from lyra_petsc.contact.contact_model import ContactModel  # needed with small gaps only

        known = self._known
        return ContactModel(self._barrier, self._discretisation, known, x, c, free, self._obstacles)
