"""Contact in a step of `StageEquations`; every function is collective."""

from __future__ import annotations

import numpy as np

from lyra_petsc.stepping.motion_limits import are_kept
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.time_step import Evaluation


def is_resolved(system: StageEquations) -> bool:
    """Whether the integrator of the step just accepted can follow the contact in it.

    Those for smooth motions cannot if anything touches, or a term acts that limits steps, at their stage, or
    their end is beyond such a limit; those of second order for contact if the normal forces have changed too
    much.
    """
    contact, x, frozen = system.contact, system.evaluated.x, system.step.frozen
    if system.integrators.suits_contact:
        return system.integrator.order == 1 or contact is None or contact.resolved(system.step.dt)
    if system.active.limits_act(x, frozen, system.points) or not are_kept(system, system.x):
        return False
    return contact is None or not contact.is_touching(x, frozen)


def has_friction_pairs(system: StageEquations) -> bool:
    """Whether there are friction pairs."""
    return system.contact is not None and system.contact.has_friction_pairs


def follow_contacts(system: StageEquations, solution: Evaluation) -> bool:
    """Give friction the contacts of the stage that solves the equations, where these differ notably from
    theirs; returns whether they do.
    """
    if not system.near or not system.integrator.dynamic or system.step.of_edges:
        return False
    assert system.contact is not None
    if not system.contact.follow(solution.x, system.x, system.step.frozen):
        return False
    system.change()
    return True


def block_summary(system: StageEquations) -> list[str]:
    """Lines of text on the elements with changing stencils and the blocks that they add to the matrix, none
    without such elements.
    """
    if system.contact is None:
        return []
    patterns = system.discretisation.fixed.pattern, system.discretisation.rows.pattern
    fixed, every = system.points.global_sum(*(each.n_couplings for each in patterns)).astype(np.int64)
    pairs = system.contact.summary(system.evaluated.x, system.step.frozen)
    return [f"blocks: {fixed} of the mesh, {every - fixed} of pairs that act ({pairs})"]
