"""The terms of a problem, their frozen data in a step, and sums over them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.points import Layout
from lyra_petsc.terms.protocols import (
    Dissipates,
    GlobalSums,
    HasDirectors,
    HasGeometry,
    HoldsTogether,
    LimitsStep,
    MovingTargets,
    SharesFrozen,
    Stateful,
    TellsEvents,
)
from lyra_petsc.terms.registry import Role
from lyra_petsc.terms.term import Elastic, Load, Term, UpcomingStep, Viscous

Frozen = Mapping[Term, Any]


def gradient(terms: Sequence[Elastic | Viscous], at: Array, frozen: Frozen, layout: Layout) -> Array:
    """Gradient (n_owned, 3) [N] of the sum of ``terms`` at positions or velocities (n_local, 3)."""
    out = np.zeros((layout.n_local, 3))
    for term in terms:
        term.add_gradient(at, frozen[term], out)
    return out[: layout.n_owned]


class ActiveTerms:
    """All terms that a scene needs, by kind and property.

    Parameters
    ----------
    terms : sequence of Term
    obstacles_move : bool
        Whether the obstacles of contact do.
    damps_stiff : bool
        As that of the integrator.

    Attributes
    ----------
    elastic, viscous, loads : list of Term
        The terms with an elastic energy, with a potential of the velocities, and the loads.
    following, varying : list of Load
        Loads that follow the shape of the sheet; those, and potentials of the velocities, that change in
        time.
    sheet, external : list of Elastic
        Terms that add to the energy of the sheet, and springs by which handles pull.
    moving, targets, obstacles : list of Elastic
        Terms of ``sheet`` with moving targets or obstacles; those with targets; that with obstacles.
    limiting : list of LimitsStep
        Terms that limit the length of steps, besides contact.
    holding : list of HoldsTogether
        Those that need an integrator that damps stiff motions, if the scene's does not.
    stateful, dissipating, telling : list of Stateful
        Terms with a state; those of which steps make heat; those with events for the user.
    of_contact, sliding, barriers : list of Elastic
        The terms of contact, friction alone, and the barrier alone, if there are any.
    with_edges, with_geometry : list of Elastic
        Terms with directors; those of which several methods need the same geometry.
    summing : list of GlobalSums
        Those that depend on sums over all ranks.
    coarse : dict of Elastic → Elastic
        The terms that replace terms with unknowns of edges on coarse levels of multigrid.
    """

    def __init__(self, terms: Sequence[Term], *, obstacles_move: bool, damps_stiff: bool) -> None:
        self.elastic = [term for term in terms if isinstance(term, Elastic)]
        self.viscous = [term for term in terms if isinstance(term, Viscous)]
        self.loads = [term for term in terms if isinstance(term, Load)]
        self.following = [load for load in self.loads if load.is_follower]
        changing: list[Load | Viscous] = [*self.loads, *self.viscous]
        self.varying = [term for term in changing if term.varies]
        roles = {term: term.registration.role for term in self.elastic}
        self.external = [term for term in self.elastic if roles[term] is Role.EXTERNAL]
        self.sheet = [term for term in self.elastic if roles[term] is Role.ELASTIC]
        self.targets = [term for term in self.sheet if isinstance(term, MovingTargets)]
        self.obstacles: list[Any] = [t for t in self.sheet if obstacles_move and t.registration.of_contact]
        self.moving: list[Elastic] = [*self.targets, *self.obstacles]
        self.dissipating = [term for term in self.sheet if isinstance(term, Dissipates)]
        limiting = [term for term in self.elastic if isinstance(term, LimitsStep)]
        self.limiting = [term for term in limiting if not term.registration.of_contact]
        self.holding = [t for t in self.elastic if isinstance(t, HoldsTogether) and not damps_stiff]
        self.stateful = [term for term in self.elastic if isinstance(term, Stateful)]
        self.telling = [term for term in self.stateful if isinstance(term, TellsEvents)]
        self.sliding: list[Any] = [term for term in self.external if term.registration.of_contact]
        self.of_contact: list[Any] = [term for term in self.elastic if term.registration.of_contact]
        self.barriers = [term for term in self.of_contact if term not in self.sliding]
        self.with_edges = [term for term in self.elastic if isinstance(term, HasDirectors)]
        self.with_geometry = [term for term in self.elastic if isinstance(term, HasGeometry)]
        self.summing = [term for term in self.elastic if isinstance(term, GlobalSums)]
        self.coarse: dict[Elastic, Elastic] = {}

    def add_load(self, load: Load) -> None:
        """Let a further load act, which does not follow the shape of the sheet."""
        self.loads.append(load)

    def freeze(self, step: UpcomingStep) -> Frozen:
        """Data of all terms that depend on positions or velocities and are constant in the step."""
        return {term: term.freeze(step) for term in (*self.elastic, *self.viscous)}

    def refreeze(self, frozen: Frozen, changed: Mapping[Any, Any]) -> Frozen:
        """Other data of some terms, and of the terms that share them as their partners."""
        partners: dict[Term, Any] = {
            term: changed[term.partner]
            for term in self.elastic
            if isinstance(term, SharesFrozen) and term.partner in changed
        }
        return {**frozen, **changed, **partners}

    def with_targets(self, frozen: Frozen, step: UpcomingStep) -> Frozen:
        """The data with moving targets and springs at their positions at ``step.target_time``."""
        return {**frozen, **{term: term.freeze(step) for term in (*self.moving, *self.external)}}

    def limits_act(self, x: Array, frozen: Frozen, layout: Layout) -> bool:
        """Whether any term that limits steps acts at positions x (n_local, 3): its forces change too abruptly
        for one linear solve; or whether parts that one holds together are apart; collective.
        """
        if not (self.limiting or self.holding):
            return False
        acts = any(term.energies(x, frozen[term]).any() for term in self.limiting)
        return any(layout.global_max(acts or any(t.are_apart(x, frozen[t]) for t in self.holding)))

    def accept_substep(
        self, x: Array, frozen: Frozen, start: tuple[Array, Mapping[Any, Any]] | None
    ) -> Array:
        """Accept a part of a static load step as `CoulombFriction.accept_substep`, with ``start`` a
        `contact_state`; returns the sum of the results on this rank.
        """
        landed = np.zeros(3)
        for term in self.sliding:
            landed += term.accept_substep(x, frozen[term], start and (start[0], start[1][term]))
        return landed

    def friction_lag(self, x: Array, frozen: Frozen) -> dict[str, Array]:
        """The results of `Elastic.friction_lag` of all terms."""
        return {name: sums for t in self.sliding for name, sums in t.friction_lag(x, frozen[t]).items()}

    def slip_under_changed_forces(self, x: Array, dx: Array, frozen: Frozen) -> Array:
        """The sums of `Elastic.slip_under_changed_forces` over all terms, (2,)."""
        sums = [t.slip_under_changed_forces(x, dx, frozen[t]) for t in self.sliding]
        return np.sum(sums, axis=0)

    def contact_state(self) -> dict[Any, Any]:
        """State of the contacts of all terms, for `restore_contacts`."""
        return {term: term.contact_state() for term in self.sliding}

    def restore_contacts(self, states: Mapping[Any, Any]) -> None:
        """Return to a `contact_state`."""
        for term, state in states.items():
            term.restore_contacts(state)
