"""Contact in a step of `StageEquations`; every function is collective."""

from __future__ import annotations

import numpy as np

from lyra_petsc.stepping.motion_limits import are_kept
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.time_step import Evaluation


def is_resolved(equations: StageEquations) -> bool:
    """Whether the integrator of the step just accepted can follow the contact in it.

    Those for smooth motions cannot if anything touches, or a term acts that limits steps, at their stage, or
    their end is beyond such a limit; those of second order for contact if the normal forces have changed too
    much.
    """
    contact, x, frozen = equations.contact, equations.evaluated.x, equations.step.frozen
    if equations.integrators.suits_contact:
        return equations.integrator.order == 1 or contact is None or contact.resolved(equations.step.dt)
    if equations.active.limits_act(x, frozen, equations.points) or not are_kept(equations, equations.x):
        return False
    return contact is None or not contact.is_touching(x, frozen)


def has_friction_pairs(equations: StageEquations) -> bool:
    """Whether there are friction pairs."""
    return equations.contact is not None and equations.contact.has_friction_pairs


def follow_contacts(equations: StageEquations, solution: Evaluation) -> bool:
    """Give friction the contacts of the stage that solves the equations, where these differ notably from
    theirs; returns whether they do.
    """
    if not equations.near or not equations.integrator.dynamic or equations.step.of_edges:
        return False
    assert equations.contact is not None
    if not equations.contact.follow(solution.x, equations.x, equations.step.frozen):
        return False
    equations.change()
    return True


def block_summary(equations: StageEquations) -> list[str]:
    """Lines of text on the elements with changing stencils and the blocks that they add to the matrix, none
    without such elements.
    """
    if equations.contact is None:
        return []
    patterns = equations.discretisation.fixed.pattern, equations.discretisation.rows.pattern
    fixed, every = equations.points.global_sum(*(each.n_couplings for each in patterns)).astype(np.int64)
    pairs = equations.contact.summary(equations.evaluated.x, equations.step.frozen)
    return [f"blocks: {fixed} of the mesh, {every - fixed} of pairs that act ({pairs})"]
