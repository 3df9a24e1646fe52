"""The terms of a problem, what each has frozen for the present step, and sums over them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.points import Layout
from lyra_petsc.terms.registry import Role
from lyra_petsc.terms.term import Elastic, Load, Term, UpcomingStep, Viscous


class ActiveTerms:
    """All terms that a scene needs.

    Parameters
    ----------
    terms : sequence of Term

    Attributes
    ----------
    elastic, viscous, loads : list of Term
        By kind.
    following : list of Load
        Those that follow the shape.
    sheet, constraints, moving, pushing, limiting, changing, with_edges : list of Elastic
        Those whose energy is the sheet's, those by which handles pull, and of these those whose targets move,
        those of them that work by forces, those that limit the length of Newton's steps, those whose stencils
        change, and those with unknowns on edges.
    coarse : dict of Elastic → Elastic
        Terms with unknowns of edges, and what stands for them on coarse levels of multigrid.
    frozen : dict of Term
        What each has frozen for the step.
    """

    def __init__(self, terms: Sequence[Term]) -> None:
        self.elastic = [term for term in terms if isinstance(term, Elastic)]
        self.viscous = [term for term in terms if isinstance(term, Viscous)]
        self.loads = [term for term in terms if isinstance(term, Load)]
        self.following = [load for load in self.loads if load.is_follower]
        roles = {term: term.registration.role for term in self.elastic}
        self.constraints = [term for term in self.elastic if roles[term] is Role.CONSTRAINT]
        self.sheet = [term for term in self.elastic if roles[term] is Role.ELASTIC]
        self.moving = [term for term in self.sheet if term.moving]
        self.pushing = [term for term in self.moving if term.pushes]
        self.limiting = [term for term in self.elastic if term.registration.limits_step]
        self.changing = [term for term in self.elastic if term.registration.neighbours]
        self.with_edges = [term for term in self.elastic if term.registration.edge_state]
        self.coarse: dict[Elastic, Elastic] = {}
        self.frozen: dict[Term, Any] = dict.fromkeys(terms)

    def freeze(self, step: UpcomingStep) -> None:
        """Let every term that acts through positions or velocities freeze what it does."""
        self.frozen = {}  # there is no room for both
        self.frozen = {term: term.freeze(step) for term in (*self.elastic, *self.viscous)}

    def refreeze(self, found: Mapping[Any, Any]) -> None:
        """Let terms, and those that follow them, have frozen this."""
        following: dict[Term, Any] = {
            term: found[term.partner] for term in self.elastic if term.partner and term.partner in found
        }
        self.frozen = {**self.frozen, **found, **following}

    def move_targets(self, step: UpcomingStep) -> None:
        """Let targets that move with handles stand where they do at ``step.target_time``."""
        self.frozen = self.frozen | {term: term.freeze(step) for term in (*self.moving, *self.constraints)}

    def gradient(self, terms: Sequence[Elastic | Viscous], at: Array, layout: Layout) -> Array:
        """Gradient (n_owned, 3) [N] of the sum of ``terms`` at positions or velocities (n_local, 3)."""
        out = np.zeros((layout.n_local, 3))
        for term in terms:
            term.add_gradient(at, self.frozen[term], out)
        return out[: layout.n_owned]

    def moving_energy(self, x: Array) -> float:
        """Energy [J] of this rank's terms whose targets work by it, which stand where they are now."""
        turning = [term for term in self.moving if not term.pushes]
        return sum(float(term.energies(x, self.frozen[term]).sum()) for term in turning)

    def accept_substep(self, x: Array) -> None:
        """A part of a static load step led to positions x."""
        for term in self.changing:
            term.accept_substep(x, self.frozen[term])

    def friction_lag(self, x: Array) -> dict[str, Array]:
        """See `Elastic.friction_lag`."""
        return {name: sums for t in self.changing for name, sums in t.friction_lag(x, self.frozen[t]).items()}

    def contact_state(self) -> dict[Elastic, Any]:
        """What terms know of what touches, to come back to by `restore_contacts`."""
        return {term: term.contact_state() for term in self.changing}

    def restore_contacts(self, states: Mapping[Elastic, Any]) -> None:
        """Know just this of what touches."""
        for term, what in states.items():
            term.restore_contacts(what)

    def transport_frames(self, x: Array, frozen: Mapping[Term, Any] | None = None) -> None:
        """Let the frames of directors follow to positions x, from those in use or ``frozen``."""
        for term in self.with_edges:
            term.accept(x, (frozen or self.frozen)[term])
