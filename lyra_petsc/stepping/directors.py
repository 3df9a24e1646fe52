"""Directors on edges in a step: the frames of their angles, and how an increment turns them.

Only terms with unknowns of edges (`ActiveTerms.with_edges`) have directors; without them nothing is done.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.terms.protocols import LARGEST_ROTATION
from lyra_petsc.terms.term import Term

if TYPE_CHECKING:
    from lyra_petsc.stepping.stage_equations import StageEquations

MIN_EDGE_STIFFNESS = 1e-10
"""Lower bound of the Jacobian's stiffness for an edge's unknown, over its stiffness at rest."""


class Directors:
    """The directors of the terms of a `StageEquations`.

    Parameters
    ----------
    system : StageEquations

    Attributes
    ----------
    min_stiffness : (n,)
        Stiffness [N/m] that Jacobians add to the diagonal of the block rows of edges. Without it the rows of
        edges whose triangles have lost their area would be zero.
    """

    _frozen_before: Mapping[Term, Any] | None = None

    def __init__(self, system: StageEquations) -> None:
        self._system, self._terms, points = system, system.active.with_edges, system.points
        self._end_frames: dict[Term, Any] = {}  # at the end of the last step
        stiffness = np.zeros((points.n_local, 3))
        for term in self._terms:
            stiffness.reshape(-1)[term.edge_indices] += MIN_EDGE_STIFFNESS * term.edge_stiffness()
        self.min_stiffness = stiffness[points.n_vertices : points.n_owned].max(axis=1)

    def begin_step(self) -> bool:
        """Begin a step; returns whether its frames differ from those at the end of the last step."""
        frozen, self._frozen_before = self._system.active.frozen, None
        return any(frozen[term] is not self._end_frames.get(term) for term in self._terms)

    @property
    def frozen_in_step(self) -> Mapping[Term, Any]:
        """Frozen data of terms in the step, before `move_frames_to_end`."""
        return self._system.active.frozen if self._frozen_before is None else self._frozen_before

    def move_frames_to_end(self) -> None:
        """Update the frames at the end of a step that is one linear solve.

        The forces at the end are then those with which the next step begins.
        """
        system, integrator, frozen = self._system, self._system.integrator, self._system.active.frozen
        if self._terms and integrator.lagged_loads and integrator.dynamic:
            system.active.refreeze({term: term.frames_at_end(system.x, frozen[term]) for term in self._terms})
            self._frozen_before = frozen
            system.change()
            self._end_frames = {term: system.active.frozen[term] for term in self._terms}

    def update_frames(self, x: Array) -> bool:
        """Update the frames of edges that have turned far from theirs to positions x (n_local, 3).

        Returns whether any changed, and with them the forces on vertices; collective.
        """
        system = self._system
        found: dict[Term, Any] = {}
        for term in () if system.solving_edges else self._terms:
            updated = term.updated_frames(x, system.active.frozen[term], system.prescribed.mask)
            found |= {} if updated is None else {term: updated}
        if not system.points.comm.allreduce(len(found), MPI.MAX):
            return False
        system.active.refreeze(found)
        system.change()
        return True

    def transport_frames(self, frozen: Mapping[Term, Any] | None = None) -> None:
        """Transport the frames, those in use or in ``frozen``, to the present positions."""
        for term in self._terms:
            term.accept(self._system.x, (frozen or self._system.active.frozen)[term])
        if self._terms:
            self._system.change()  # where directors are loaded, those on vertices depend on the frames

    def forget(self) -> None:
        """Discard the remembered directors, whose memory the linear solve needs."""
        for term in self._terms:
            term.clear_cache()

    def largest_turn(self, displacement: Array) -> float:
        """Largest angle [rad] by which directors turn in a displacement (n_owned, 3) [m]; collective."""
        turn = max((term.largest_rotation(displacement) for term in self._terms), default=0.0)
        return float(self._system.points.comm.allreduce(turn, MPI.MAX))

    def turn_with_triangles(self, v: Array, increment: Array) -> bool:
        """Turn directors with their triangles where an increment (n_owned, 3) [m/s] from v turns them far.

        Changes ``increment``; returns whether it did; collective. The linear increment leads vertices off
        their circles, and directors much too far.
        """
        system, changed = self._system, 0
        if not self._terms or system.stage.c * self.largest_turn(increment) <= LARGEST_ROTATION:
            return False
        x, displacement = system.displacement(v, increment)
        for term in self._terms:
            changed += self._set(
                increment, *term.edge_increments(x, displacement, system.active.frozen[term])
            )
        return bool(system.points.comm.allreduce(changed, MPI.MAX))

    def match(self, v: Array, increment: Array, curved: Array) -> None:
        """Set the edges' unknowns in ``curved`` (n_owned, 3) [m/s], an increment from v along arcs.

        Each director gets the same angle to its triangles as by the linear ``increment``; collective.
        """
        system = self._system
        along = system.displacement(v, curved)[1]
        x, displacement = system.displacement(v, increment)
        for term in self._terms:
            self._set(curved, *term.edge_increments(x, displacement, system.active.frozen[term], along))

    def _set(self, increment: Array, indices: Ints, values: Array) -> bool:
        """Put displacements (m,) [m] of the free unknowns ``indices`` (m,) into ``increment`` (n_owned, 3).

        Returns whether there were any.
        """
        own = indices < increment.size
        own[own] = self._system.prescribed.free.ravel()[indices[own]]
        increment.reshape(-1)[indices[own]] = values[own] / self._system.stage.c
        return bool(own.any())
