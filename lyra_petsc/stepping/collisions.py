"""Collisions in a step: how far the sheet can move without any, and from where a solve can start.

The sheet and its obstacles must pass no part of each other on their way. Terms of contact find that for the
near pairs; here the search for these pairs is extended where a displacement leaves what is known.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.terms.term import StepInterval

if TYPE_CHECKING:
    from lyra_petsc.stepping.stage_equations import StageEquations

MAX_TURN = 0.25
"""Largest angle [rad] by which a Newton iteration of a static analysis may turn a director."""

MAX_SEARCHES = 40
"""Largest number of searches for near pairs along one displacement."""

MIN_KNOWN = 0.3
"""If the near pairs are known on less than this fraction of a displacement, the search covers all of it."""

IMPACT_STEP = 0.1
"""Displacement of a vertex in a step, over the skin of contact, from which on there may be an impact."""

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
    """Limits of motion in the step of a `StageEquations`; every method is collective.

    Parameters
    ----------
    system : StageEquations

    Attributes
    ----------
    refused : RefusedDisplacement or None
        The displacement of the present step that was found to collide.
    """

    refused: RefusedDisplacement | None = None
    _start_velocity: Array | None = None  # found by `find_start`

    def __init__(self, system: StageEquations) -> None:
        self._system, self._discretisation = system, system.discretisation
        self._limiting, self._pushing = system.active.limiting, system.active.pushing
        self._separating = system.active.separating

    def begin_step(self) -> None:
        """Forget what was found in the step before."""
        self.refused = self._start_velocity = None

    @property
    def limits_steps(self) -> bool:
        """Whether `largest_step` may be less than 1.

        So it is with contact, and in statics with directors, which would else reach a distant equilibrium.
        """
        system = self._system
        return bool(self._limiting) or (bool(system.active.with_edges) and not system.integrator.dynamic)

    def largest_step(self, v: Array, increment: Array) -> float:
        """Largest fraction of an increment (n_owned, 3) [m/s] from v that all terms allow; collective."""
        system = self._system
        turn = 0.0 if system.integrator.dynamic else system.directors.largest_turn(increment * system.stage.c)
        return self._free_fraction(v, increment, MAX_TURN / turn if turn > MAX_TURN else 1.0)

    def moves_freely(self, v: Array, increment: Array) -> bool:
        """Whether no collision limits an increment (n_owned, 3) [m/s] from v; collective."""
        return not self._limiting or self._free_fraction(v, increment, 1.0) == 1.0

    def _free_fraction(self, v: Array, increment: Array, maximum: float) -> float:
        """Largest fraction, at most ``maximum``, of an increment from v without a collision; collective."""
        done = 0.0
        for _ in range(MAX_SEARCHES):
            start, rest = v, increment
            if done > 0.0 or maximum < 1.0:
                start, rest = v + done * increment, (maximum - done) * increment
            x, displacement, known = self.known_displacement(start, rest)
            frozen, present = self._system.active.frozen, self._system.present(self._limiting)
            allowed = [term.largest_step(x, displacement, frozen[term]) for term in present]
            fraction = self._global_minimum(min([known, *allowed])) if present else known
            if fraction == 1.0:
                return maximum
            done += fraction * (maximum - done)
            if fraction < known:
                break
        return done

    def known_displacement(
        self, v: Array, increment: Array, minimum: float = MIN_KNOWN
    ) -> tuple[Array, Array, float]:
        """`displacement`, and the fraction of it on which all near pairs are known; collective.

        Where the fraction is less than ``minimum``, pairs are searched along the whole displacement.
        """
        system = self._system
        x, displacement = system.displacement(v, increment)
        known = self._discretisation.searched_fraction(x, displacement)
        if known >= minimum:
            return x, displacement, known
        system.update_stencils(x, displacement)
        x, displacement = system.displacement(v, increment)
        return x, displacement, self._discretisation.searched_fraction(x, displacement)

    def second_order_correction(self, v: Array, increment: Array) -> Array | None:
        """The increment (n_owned, 3) [m/s] from v, changed to separate the pairs that it brings too near.

        None if no pair comes too near; collective. Along a linear increment a sheet that rotates comes nearer
        to its contacts, or passes them, by the square of its rotation.
        (Nocedal & Wright, Numerical Optimization, 2nd ed., sec. 15.6.)
        """
        system = self._system
        if not self._separating:
            return None
        x, displacement, _ = self.known_displacement(v, increment, 1.0)
        if not self._discretisation.has_near_elements:
            return None
        n, frozen, changed = len(increment), system.active.frozen, False
        targets = {t: t.target_distances(x, displacement, frozen[t]) for t in self._separating}
        for _ in range(MAX_SEPARATIONS):
            out, count = np.zeros_like(x), np.zeros((len(x), 1))
            found = [t.add_corrections(x, displacement, frozen[t], targets[t], out, count) for t in targets]
            if not system.points.comm.allreduce(any(found), MPI.LOR):
                break
            change = np.divide(out[:n], count[:n], out=np.zeros((n, 3)), where=count[:n] > 0.0)
            displacement[:n] += np.where(system.prescribed.free, change, 0.0)
            system.points.update_ghosts(displacement)
            changed = True
        return displacement[:n] / system.stage.c if changed else None

    def find_start(self) -> bool:
        """Find velocities from which the step's solve can start without a collision; whether there are any.

        Tried in this order: all free vertices stay, all keep their velocities, and the same with vertices
        moved by the obstacles that would hit them. Obstacles and prescribed unknowns move as they must;
        collective.
        """
        system = self._system
        still = system.stationary_velocity()
        moves = system.prescribed.velocity != still.take(system.prescribed.indices)
        if not any(system.points.global_max(bool(self._pushing) or bool(moves.any()))):
            return True
        at_rest, refused = system.integrator.starts_at_rest, None
        candidates = [still] if at_rest else [still, system.v[: len(still)]]
        tried = [(v, False) for v in candidates]
        if self._pushing and not at_rest:
            tried += [(v, True) for v in candidates]
        for v, pushed in tried:
            start = still + self._moved_with_obstacles(still, v - still) if pushed else v.copy()
            system.prescribe(start)
            if self._is_collision_free(still, start - still):
                self.refused, self._start_velocity = None, start
                return True
            # keep the first one: with the sheet at rest it shows what moves into the sheet
            refused = refused or self.refused
        self.refused = refused
        return False

    def start_velocity(self) -> Array:
        """Collision-free velocities (n_owned, 3) [m/s] for the first guess, with the prescribed ones.

        They are those that `find_start` found, else `stationary_velocity`.
        """
        system = self._system
        if self._start_velocity is not None and not system.solving_edges:
            return self._start_velocity.copy()
        system.prescribe(v := system.stationary_velocity())
        return v

    def _moved_with_obstacles(self, v: Array, increment: Array) -> Array:
        """The ``increment`` (n_owned, 3) [m/s] from v, with vertices in the path of obstacles moved by them;
        collective.
        """
        system = self._system
        n = len(increment)
        for _ in range(MAX_SEARCHES):
            x, displacement = system.displacement(v, increment)
            moved = displacement
            for term in self._pushing:
                moved = term.moved_with_obstacles(x, moved, system.active.frozen[term])
            change = moved[:n] != displacement[:n]
            if not system.points.comm.allreduce(bool(change.any()), MPI.LOR):
                break
            increment = np.where(change, moved[:n] / system.stage.c, increment)
        return increment

    def _is_collision_free(self, v: Array, increment: Array, *, after: bool = False) -> bool:
        """Whether the sheet moves from velocities v by ``increment`` (n_owned, 3) [m/s] without a collision.

        Obstacles move to the stage meanwhile, or with ``after`` from the stage to the end of the step. Sets
        `refused` on a collision; collective.
        """
        done, begin = 0.0, float(after)
        for _ in range(MAX_SEARCHES):
            x, displacement, known = self.known_displacement(v + done * increment, (1.0 - done) * increment)
            displacement *= known
            part = StepInterval(begin + done, begin + (1.0 if known == 1.0 else done + known * (1.0 - done)))
            frozen = self._system.active.frozen
            free = [t.is_collision_free(x, displacement, frozen[t], part) for t in self._separating]
            if not self._global_minimum(float(all(free))):
                break
            if known == 1.0:
                return True
            done = part.end - begin
        self.refused = RefusedDisplacement(x.copy(), displacement, part)
        return False

    def end_is_free(self, v: Array) -> bool:
        """Whether the sheet moves from the stage with velocities v (n_owned, 3) to the end of the step
        without a collision; collective.
        """
        system = self._system
        if system.stage.offset == system.dt and system.integrator.iterates:
            return True
        n = system.points.n_owned
        end = system.integrator.end(system.x[:n], system.v[:n], v, system.dt)[0]
        # Newton's method has checked the displacement to the stage, a single linear solve has not
        x = system.evaluate_at(v)[0] if system.integrator.iterates else system.x
        displacement = end - x[:n]
        search = self._discretisation
        if not search.has_near_elements and search.searched_fraction(x, displacement) == 1.0:
            return True
        v = v if system.integrator.iterates else system.stationary_velocity()
        return self._is_collision_free(v, displacement / system.stage.c, after=True)

    def touches(self, x: Array) -> bool:
        """Whether anything touches at positions x (n_local, 3): the forces of contact and friction change too
        abruptly for one linear solve.

        Collective.
        """
        system = self._system
        if not self._discretisation.has_near_elements:
            return False
        acts = [mask.any() for term, mask in system.acting_elements(x).items() if not term.slips]
        return any(system.points.global_max(any(acts)))

    @property
    def may_impact(self) -> bool:
        """Whether parts are near each other, and vertices move by a notable part of the gap in the step;
        collective.
        """
        system = self._system
        if not (self._separating and self._discretisation.has_near_elements):
            return False
        largest = system.stage.c * np.abs(system.evaluated[1][: system.points.n_vertices]).max(initial=0.0)
        return system.points.global_max(float(largest))[0] > IMPACT_STEP * min(
            term.skin for term in self._separating
        )

    def may_collide(self, approach: float) -> bool:
        """Whether parts may collide in the step, approaching by more than ``approach`` [m]; collective."""
        system = self._system
        if (
            not self._discretisation.has_near_elements
            or not system.integrator.dynamic
            or system.solving_edges
        ):
            return False
        x, displacement, frozen = system.x, system.expected_displacement(), system.active.frozen
        found = any(t.may_collide(x, displacement, frozen[t], approach) for t in self._separating)
        return any(system.points.global_max(found))

    def _global_minimum(self, number: float) -> float:
        """Minimum over all ranks; collective."""
        return -self._system.points.global_max(-number)[0]
