"""Contact of a scene with friction, as the rest of the program knows it besides its two terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.contact.collisions import Collisions
from lyra_petsc.contact.contact_report import ContactReport
from lyra_petsc.contact.contact_setup import Barrier
from lyra_petsc.contact.friction import CoulombFriction
from lyra_petsc.contact.joined import JoinedVertices
from lyra_petsc.contact.pair_search import PairSearch
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.terms.step_end import ContactEnd, ContactImpulses, StepEnd
from lyra_petsc.terms.term import Term

Frozen = Mapping[Term, Any]

FOLLOWED = 0.1
"""Change of the normal forces in a step over their sum above which the step is solved again with friction by
those at its end. Otherwise an impulse corrects friction."""

RESOLVED = 0.2
"""Mean displacement of the vertices in contact by the change of their normal forces in a step, over the skin
of the contact search, up to which the step resolves contact."""


def set_up_terms(
    terms: Mapping[str, Term],
    barrier: Barrier,
    obstacles: Sequence[Solid | Container],
    tied: Ints,
    lengths: Callable[[float], Array],
) -> None:
    """Give the terms of a scene with contact the data that are the same on all ranks; ``tied`` (n, 2) are
    the global numbers of vertices that are held together, ``lengths`` (n,) [m] their threads' at a time [s].
    """
    contact = cast(ContactBarrier, terms["contact"])
    contact.set_up(barrier, obstacles, JoinedVertices(tied, lengths))
    if "friction" in terms:
        cast(CoulombFriction, terms["friction"]).set_up(contact)


class SceneContact:
    """The contact of a scene on one rank; every method is collective.

    ``frozen`` are the data of the terms in the present step.

    Parameters
    ----------
    discretisation : Discretisation
    terms : mapping of str to Term
        All of the scene, after `set_up_terms`.
    mass : (n_owned,)
        Of each row [kg].

    Attributes
    ----------
    skin : float
        Distance [m] by which points may approach each other between two searches.
    obstacles_move : bool
        Whether any obstacle moves in the scene.
    places : dict
        Number of each obstacle and of its first point, by name.
    """

    def __init__(self, discretisation: Discretisation, terms: Mapping[str, Term], mass: Array) -> None:
        self._discretisation, self._mass = discretisation, mass
        self._barrier = barrier = cast(ContactBarrier, terms["contact"])
        self._friction = cast("CoulombFriction | None", terms.get("friction"))
        self._search = PairSearch(discretisation, barrier, self._friction)
        self.skin, self.obstacles_move = barrier.search.skin, barrier.obstacles.moving
        self.places = barrier.obstacles.places

    @property
    def near(self) -> bool:
        """Whether any parts are near each other."""
        return self._search.near

    @property
    def has_friction_pairs(self) -> bool:
        """Whether there are friction pairs: one linear solve cannot decide whether they stick or slide."""
        if self._friction is None or not self.near:
            return False
        return any(self._discretisation.layout.global_max(self._friction.n_friction_pairs))

    def begin(self, start: float, end: float) -> None:
        """Prepare for an attempt at a step between two times [s] from the accepted state."""
        self._barrier.search.expect(start, end)
        if self._friction is not None:
            self._friction.begin_step()

    def update(
        self, x: Array, expected: Array | None = None, ahead: Callable[[int], Array] | None = None
    ) -> None:
        """Update the near pairs to positions x (n_local, 3) [m]; see `PairSearch.update`."""
        self._search.update(x, expected, ahead)

    def limit(self, frozen: Frozen) -> Collisions:
        """What collisions allow in the step."""
        return Collisions(self._discretisation, self._search, self._barrier, frozen[self._barrier])

    def follow(self, x: Array, start: Array, frozen: Frozen) -> bool:
        """Give friction the contacts at positions x, which solve the step from ``start``, (n_local, 3) each,
        if they differ notably from those of its equations; returns whether they do.
        """
        friction, layout = self._friction, self._discretisation.layout
        if friction is None or not self.near:
            return False
        pairs, *forces = friction.changed_contacts(x, start, frozen[friction])
        change, total = layout.global_sum(*forces).tolist()
        if change <= FOLLOWED * total:
            return False
        friction.take_contacts(pairs)
        return True

    def finish(self, step: StepEnd, frozen: Frozen, before: ContactEnd | None) -> ContactEnd:
        """Contact at the end of a step that began with the contact ``before``; None at the start of a run."""
        obstacles, layout = frozen[self._barrier], self._discretisation.layout
        sums, impulses = np.zeros_like(step.x), ContactImpulses()
        if self.near:
            sums[:, 0] = self._barrier.normal_forces(step.x, obstacles)
            layout.add_to_owners(sums)
        force = sums[: layout.n_vertices, 0].copy()
        touches = self.limit(frozen).touches(step.x)
        if before is None:
            return ContactEnd(touches, normal_force=force)
        if self.near:
            from lyra_petsc.contact import impacts  # needed only if something is near

            motion = None if self._friction is None else frozen[self._friction]
            impulses = impacts.end_step(step, self._barrier, obstacles, self._friction, motion)
        return ContactEnd(touches, self._resolves(before.normal_force, force, step.dt), force, impulses)

    def _resolves(self, before: Array, force: Array, dt: float) -> bool:
        """Whether the normal forces (n_vertices,) [N] changed little in a step of dt [s].

        A formula of second order continues a motion that contact has ended in the step: parts would rebound
        with up to their speed, and friction would reverse the sliding.
        """
        mass = self._mass[: len(force)][np.maximum(before, force) > 0.0]
        sums = float(np.abs(force - before).sum()), float(mass.sum())
        change, total = self._discretisation.layout.global_sum(*sums).tolist()
        return bool(change * dt**2 <= RESOLVED * self.skin * total)

    def report(self, x: Array, frozen: Frozen) -> ContactReport:
        """Contact at positions x (n_local, 3), for people."""
        return ContactReport(self._discretisation.layout, self._barrier, self._friction, x, frozen)
