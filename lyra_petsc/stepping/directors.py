"""Directors on edges in a step: the frames of their angles, and how an increment turns them.

Only terms with directors (`ActiveTerms.with_edges`) have them; without them nothing is done.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.points import Layout
from lyra_petsc.stepping.active_terms import Frozen
from lyra_petsc.terms.protocols import LARGEST_ROTATION, HasDirectors
from lyra_petsc.terms.term import Term

if TYPE_CHECKING:
    from lyra_petsc.stepping.stage_equations import StageEquations

MIN_EDGE_STIFFNESS = 1e-10
"""Lower bound of the Jacobian's stiffness for an edge's unknown, over its stiffness at rest."""


class Directors:
    """The directors of a problem.

    Parameters
    ----------
    terms : sequence of HasDirectors
    layout : Layout

    Attributes
    ----------
    min_stiffness : (n,)
        Stiffness [N/m] that Jacobians add to the diagonal of the block rows of edges. Without it the rows of
        edges whose triangles have lost their area would be zero.
    frozen_in_step : mapping of Term or None
        Frozen data of terms in the last step, if its frames were updated at its end.
    """

    def __init__(self, terms: Sequence[HasDirectors], layout: Layout) -> None:
        self._terms, self._layout = terms, layout
        self.frozen_in_step: Frozen | None = None
        stiffness = np.zeros((layout.n_local, 3))
        for term in terms:
            stiffness.reshape(-1)[term.edge_indices] += MIN_EDGE_STIFFNESS * term.edge_stiffness()
        self.min_stiffness = stiffness[layout.n_vertices : layout.n_owned].max(axis=1)

    def begin_step(self) -> None:
        """Forget the last step."""
        self.frozen_in_step = None

    def frames_at_end(self, x: Array, frozen: Frozen) -> dict[Term, Any]:
        """Frames at the end x (n_local, 3) of a step that is one linear solve.

        The forces at the end are then those with which the next step begins.
        """
        self.frozen_in_step = frozen
        return {term: term.frames_at_end(x, frozen[term]) for term in self._terms}

    def largest_turn(self, displacement: Array) -> float:
        """Largest angle [rad] by which directors turn in a displacement (n_owned, 3) [m]; collective."""
        turn = max((term.largest_rotation(displacement) for term in self._terms), default=0.0)
        return self._layout.global_max(turn)[0]


def move_frames_to_end(equations: StageEquations) -> None:
    """Update the frames at the end of a step that is one linear solve."""
    if equations.active.with_edges and equations.step.lagged and equations.integrator.dynamic:
        equations.refreeze_end(equations.directors.frames_at_end(equations.x, equations.step.frozen))


def update_frames(equations: StageEquations, x: Array) -> bool:
    """Update the frames of edges that have turned far from theirs to positions x (n_local, 3).

    Returns whether any changed, and with them the forces on vertices; collective.
    """
    frames: dict[Term, Any] = {}
    for term in () if equations.step.of_edges else equations.active.with_edges:
        updated = term.updated_frames(x, equations.step.frozen[term], equations.step.prescribed.mask)
        frames |= {} if updated is None else {term: updated}
    if not any(equations.points.global_max(bool(frames))):
        return False
    equations.refreeze(frames)
    return True


def transport_frames(equations: StageEquations, frozen: Frozen | None = None) -> None:
    """Transport the frames, those in use or in ``frozen``, to the present positions."""
    frozen = equations.step.frozen if frozen is None else frozen
    for term in equations.active.with_edges:
        term.accept(equations.x, frozen[term])
    if equations.active.with_edges:
        equations.change()  # where directors are loaded, forces on vertices depend on the frames


def turn_with_triangles(equations: StageEquations, v: Array, increment: Array) -> bool:
    """Turn directors with their triangles where an increment (n_owned, 3) [m/s] from v turns them far.

    Changes ``increment``; returns whether it did; collective. The linear increment leads vertices off their
    circles, and directors much too far.
    """
    terms, changed, reach = equations.active.with_edges, 0, equations.step.stage.c
    if not terms or reach * equations.directors.largest_turn(increment) <= LARGEST_ROTATION:
        return False
    x, displacement = equations.displacement(v, increment)
    for term in terms:
        changed += _set(
            equations, increment, *term.edge_increments(x, displacement, equations.step.frozen[term])
        )
    return any(equations.points.global_max(changed))


def match(equations: StageEquations, v: Array, increment: Array, curved: Array) -> None:
    """Set the edges' unknowns in ``curved`` (n_owned, 3) [m/s], an increment from v along arcs.

    Each director gets the same angle to its triangles as by the linear ``increment``; collective.
    """
    along = equations.displacement(v, curved)[1]
    x, displacement = equations.displacement(v, increment)
    for term in equations.active.with_edges:
        turned = term.edge_increments(x, displacement, equations.step.frozen[term], along)
        _set(equations, curved, *turned)


def _set(equations: StageEquations, increment: Array, indices: Ints, values: Array) -> bool:
    """Put displacements (m,) [m] of the free unknowns ``indices`` (m,) into ``increment`` (n_owned, 3) [m/s].

    Returns whether there were any.
    """
    own = indices < increment.size
    own[own] = equations.step.prescribed.free.ravel()[indices[own]]
    increment.reshape(-1)[indices[own]] = values[own] / equations.step.stage.c
    return bool(own.any())
