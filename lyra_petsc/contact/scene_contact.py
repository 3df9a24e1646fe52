"""Contact of a scene with friction, as the steps and Newton's method see it.

Besides energies, gradients and Hessians, which are those of its two terms, contact

- updates the near pairs to positions, and friction to the normal forces of a solve (`SceneContact.update`,
  `SceneContact.follow`);
- limits displacements to what is free of collisions, or changes them (`SceneContact.collisions`);
- finishes a step by impulses (`SceneContact.finish`);
- reports whether and where parts are near or touch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.contact.collisions import Collisions
from lyra_petsc.contact.friction import CoulombFriction
from lyra_petsc.contact.pair_search import PairSearch
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.mesh.points import Layout
from lyra_petsc.terms.term import Term

if TYPE_CHECKING:
    from lyra_petsc.contact.impacts import ContactImpulses, StepEnd

Frozen = Mapping[Term, Any]

FOLLOWED = 0.1
"""Change of the normal forces in a step over their sum above which the step is solved again with friction by
those at its end. Otherwise an impulse corrects friction."""

RESOLVED = 0.2
"""Mean displacement of the vertices in contact by the change of their normal forces in a step, over the skin
of the contact search, up to which the step resolves contact."""

IMPACT_STEP = 0.1
"""Displacement of a vertex in a step, over the skin of contact, from which on there may be an impact."""


class SceneContact:
    """The contact of a scene on one rank; every method is collective.

    ``frozen`` are the data of the terms in the present step.

    Parameters
    ----------
    discretisation : Discretisation
    barrier : ContactBarrier
    friction : CoulombFriction or None
    mass : (n_owned,)
        Of each row [kg].

    Attributes
    ----------
    collisions : Collisions
    impulses : ContactImpulses or None
        Those at the end of the last step, if there were any.
    touches : bool
        Whether anything touched at the end of the last step.
    """

    def __init__(
        self,
        discretisation: Discretisation,
        barrier: ContactBarrier,
        friction: CoulombFriction | None,
        mass: Array,
    ) -> None:
        self.barrier, self.friction = barrier, friction
        self._discretisation, self._mass = discretisation, mass
        self.search = PairSearch(discretisation, barrier, friction)
        self.collisions = Collisions(discretisation, self.search, barrier)
        self.impulses: ContactImpulses | None = None
        self.touches = False
        self._normal_force = self._next_normal_force = np.empty(0)  # at the start and the end of the step

    @property
    def layout(self) -> Layout:
        """Layout of the local rows."""
        return self._discretisation.layout

    @property
    def near(self) -> bool:
        """Whether any parts are near each other."""
        return self.search.near

    @property
    def skin(self) -> float:
        """Distance [m] by which points may approach each other between two searches."""
        return self.barrier.search.skin

    @property
    def obstacles_move(self) -> bool:
        """Whether any obstacle moves in the scene."""
        return self.barrier.obstacles.moving

    # -- pairs -------------------------------------------------------------------------------------

    def update(
        self, x: Array, expected: Array | None = None, ahead: Callable[[int], Array] | None = None
    ) -> None:
        """Update the near pairs to positions x (n_local, 3) [m]; see `PairSearch.update`."""
        self.search.update(x, expected, ahead)

    def initialise(self, x: Array, frozen: Frozen) -> None:
        """Take the pairs in contact at positions x (n_local, 3), where a run begins or is resumed."""
        if self.friction is not None:
            self.friction.initialise_pairs(x, frozen[self.friction])
        self.touches = self.is_touching(x, frozen)
        self._normal_force = self._normal_forces(x, frozen)

    def begin_step(self) -> None:
        """Prepare for an attempt at a step from the accepted state."""
        self.collisions.refused = None
        if self.friction is not None:
            self.friction.begin_step()

    def follow(self, x: Array, start: Array, frozen: Frozen) -> bool:
        """Give friction the contacts at positions x, where the stage of the step from ``start``, (n_local, 3)
        each, is solved, if they differ notably from those of its equations; returns whether they do.
        """
        friction, layout = self.friction, self.layout
        if friction is None or not self.near:
            return False
        pairs, *forces = friction.changed_contacts(x, start, frozen[friction])
        change, total = layout.global_sum(*forces).tolist()
        if change <= FOLLOWED * total:
            return False
        friction.take_contacts(pairs)
        return True

    def acting(self, x: Array, frozen: Frozen) -> dict[str, Mask]:
        """Which pairs (E,) of each term act at positions x (n_local, 3), by the name of the term."""
        acting = {self.barrier.name: self.barrier.active_elements(x, frozen[self.barrier])}
        if self.friction is not None:
            acting[self.friction.name] = np.ones(self.friction.n_elements, dtype=np.bool_)
        return acting

    def is_touching(self, x: Array, frozen: Frozen) -> bool:
        """Whether anything touches at positions x (n_local, 3): the forces of contact and friction change too
        abruptly for one linear solve.
        """
        if not self.near:
            return False
        acts = self.barrier.active_elements(x, frozen[self.barrier]).any()
        return any(self.layout.global_max(bool(acts)))

    @property
    def has_friction_pairs(self) -> bool:
        """Whether there are friction pairs: one linear solve cannot decide whether they stick or slide."""
        if self.friction is None or not self.near:
            return False
        return any(self.layout.global_max(self.friction.n_friction_pairs))

    def may_collide(self, x: Array, dx: Array, frozen: Frozen, approach: float) -> bool:
        """Whether parts may collide on the displacement dx (n_local, 3) [m] from x, approaching by more than
        ``approach`` [m].
        """
        if not self.near:
            return False
        found = self.barrier.may_collide(x, dx, frozen[self.barrier], approach)
        return any(self.layout.global_max(found))

    def may_impact(self, dx: Array) -> bool:
        """Whether parts are near each other, and a displacement dx (n, 3) [m] of the vertices is a notable
        part of the gap.
        """
        if not self.near:
            return False
        largest = float(np.abs(dx).max(initial=0.0))
        return self.layout.global_max(largest)[0] > IMPACT_STEP * self.skin

    # -- the end of a step -------------------------------------------------------------------------

    def finish(self, step: StepEnd, frozen: Frozen, *, damps: bool) -> ContactImpulses | None:
        """Find the impulses at the end of a step, or None without any; ``damps``: there may be some."""
        self._next_normal_force = self._normal_forces(step.x, frozen)
        self.touches, self.impulses = self.is_touching(step.x, frozen), None
        if damps and self.near:
            from lyra_petsc.contact import impacts  # needed only if something is near

            motion = None if self.friction is None else frozen[self.friction]
            obstacles = frozen[self.barrier]
            self.impulses = impacts.end_step(step, self.barrier, obstacles, self.friction, motion)
        return self.impulses

    def accept(self) -> None:
        """Begin the next step from the end of the last one."""
        self._normal_force = self._next_normal_force

    def resolved(self, dt: float) -> bool:
        """Whether the normal forces changed so little in the step of dt [s] that integrators of second order
        follow them.

        A formula of second order continues a motion that contact has ended in the step: parts would rebound
        with up to their speed, and friction would reverse the sliding.
        """
        before, now = self._normal_force, self._next_normal_force
        mass = self._mass[: len(now)][np.maximum(before, now) > 0.0]
        layout = self.layout
        change, total = layout.global_sum(float(np.abs(now - before).sum()), float(mass.sum())).tolist()
        return bool(change * dt**2 <= RESOLVED * self.skin * total)

    def hold(self, step: StepEnd, acceleration: Array, frozen: Frozen) -> Array:
        """The accelerations (n_owned, 3) [m/s²] at the start of a step with friction that opposes motion."""
        if self.friction is None or not self.near:
            return acceleration
        from lyra_petsc.contact import impacts  # needed only if something is near

        return impacts.hold_by_friction(step, self.friction, frozen[self.friction], acceleration)

    def _normal_forces(self, x: Array, frozen: Frozen) -> Array:
        """Normal forces [N] at the owned vertices for positions x (n_local, 3), (n_vertices,)."""
        out, layout = np.zeros_like(x), self.layout
        if self.near:
            out[:, 0] = self.barrier.normal_forces(x, frozen[self.barrier])
            layout.add_to_owners(out)
        return out[: layout.n_vertices, 0].copy()

    # -- reports -----------------------------------------------------------------------------------

    def obstacle_loads(self, x: Array, frozen: Frozen) -> Array:
        """Force [N] of this rank's pairs on each obstacle and symmetry plane in the last step, torque [N m]
        about the origin, and the sums over contacts of the magnitudes of normal force and friction [N],
        (obstacles, 8), at positions x (n_local, 3); not summed over ranks.
        """
        loads = self.barrier.obstacle_forces(x, frozen[self.barrier])
        if self.friction is not None:
            loads += self.friction.obstacle_loads
        if self.impulses is not None:
            np.add.at(loads, self.impulses.obstacle, self.impulses.loads)
        return loads

    def summary(self, x: Array, frozen: Frozen) -> str:
        """Numbers of near pairs, and of those that act at positions x (n_local, 3), as text."""
        acting = self.acting(x, frozen)
        counted = {t.name: t.n_owned for t in (self.barrier, self.friction) if t is not None}
        acts = [np.count_nonzero(mask[: counted[name]]) for name, mask in acting.items()]
        numbers = self.layout.global_sum(*acts, *counted.values()).astype(np.int64)
        parts = zip(counted, numbers, numbers[len(counted) :], strict=False)
        return ", ".join(f"{name} {n} of {known}" for name, n, known in parts)
