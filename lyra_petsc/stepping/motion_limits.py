"""How far a step's stage may move, by terms, directors and collisions; every function is collective."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.time_step import Evaluation

if TYPE_CHECKING:
    from lyra_petsc.contact.scene_contact import SceneContact

MAX_TURN = 0.25
"""Largest angle [rad] by which a Newton iteration of a static analysis may turn a director."""


def _stage_positions(equations: StageEquations, v: Array) -> Array:
    """Positions (n_owned, 3) [m] of the stage at velocities v (n_owned, 3), without ghosts."""
    return equations.step.stage.c * v + equations.step.x_h[: len(v)]


def limits_steps(equations: StageEquations) -> bool:
    """Whether `largest_step` may be less than 1.

    So it is with contact, and in statics with directors, which would else reach a distant equilibrium.
    """
    turns = bool(equations.active.with_edges) and not equations.integrator.dynamic
    return equations.contact is not None or bool(equations.active.limiting) or turns


def largest_step(equations: StageEquations, v: Array, increment: Array) -> float:
    """Largest fraction of an increment (n_owned, 3) [m/s] from v that may be taken."""
    reach = equations.step.stage.c
    turn = 0.0 if equations.integrator.dynamic else equations.directors.largest_turn(increment * reach)
    return _largest_step(equations, v, increment, MAX_TURN / turn if turn > MAX_TURN else 1.0)


def are_kept(equations: StageEquations, x: Array) -> bool:
    """Whether positions x (n_local, 3) are within the limits of all terms."""
    terms, frozen = equations.active.limiting, equations.step.frozen
    beyond = any(term.overrun(x, frozen[term])[1] for term in terms)
    return not terms or not any(equations.points.global_max(beyond))


def moves_freely(equations: StageEquations, v: Array, increment: Array) -> bool:
    """Whether no collision limits an increment (n_owned, 3) [m/s] from v."""
    return _largest_step(equations, v, increment, 1.0) == 1.0


def _largest_step(equations: StageEquations, v: Array, increment: Array, maximum: float) -> float:
    frozen, contact = equations.step.frozen, equations.contact
    if equations.active.limiting:
        x, displacement = equations.displacement(v, increment)
        allowed = [term.largest_step(x, displacement, frozen[term]) for term in equations.active.limiting]
        maximum = -equations.points.global_max(-min(maximum, *allowed))[0]
    if contact is None:
        return maximum
    x, dx = _stage_positions(equations, v), equations.step.stage.c * increment
    return contact.collisions.limit(x, dx, frozen[contact.barrier], maximum)


def separated(equations: StageEquations, v: Array, increment: Array) -> Array | None:
    """The increment (n_owned, 3) [m/s] from v, changed to separate the parts that it brings too near; None if
    there are none.
    """
    contact, step = equations.contact, equations.step
    if contact is None:
        return None
    x, dx = _stage_positions(equations, v), step.stage.c * increment
    moved = contact.collisions.separate(x, dx, step.frozen[contact.barrier], step.prescribed.free)
    return None if moved is None else moved / step.stage.c


def contact_at(
    equations: StageEquations, v: Array
) -> tuple[SceneContact, Discretisation, Array, float, Mask, Any]:
    """What Newton's model of contact takes from the equations at velocities v (n_owned, 3)."""
    assert equations.contact is not None
    step, x = equations.step, _stage_positions(equations, v)
    obstacles = step.frozen[equations.contact.barrier]
    return equations.contact, equations.discretisation, x, step.stage.c, step.prescribed.free, obstacles


def find_start(equations: StageEquations) -> Array | None:
    """Velocities (n_owned, 3) [m/s] from which the step's solve can start without a collision, if any.

    Free vertices stay, or keep their velocities, or obstacles push them; obstacles and prescribed unknowns
    move as they must.
    """
    still, contact = equations.stationary_velocity(), equations.contact
    c, n, free = equations.step.stage.c, len(still), equations.step.prescribed.free
    start = still.copy()
    equations.prescribe(start)
    if contact is None:
        return start
    driven = np.where(free, 0.0, c * (start - still))
    if not any(equations.points.global_max(contact.obstacles_move or bool(driven.any()))):
        return start
    guesses = [np.zeros_like(still)]
    if not equations.integrator.starts_at_rest:
        guesses.append(c * (equations.v[:n] - still))
    obstacles, pushes = equations.step.frozen[contact.barrier], len(guesses) > 1
    displacement = contact.collisions.start(equations.x[:n], guesses, driven, free, obstacles, pushes=pushes)
    if displacement is None:
        return None
    start = still + displacement / c
    equations.prescribe(start)
    return start


def end_is_free(equations: StageEquations, v: Array) -> bool:
    """Whether the sheet moves from the stage with velocities v (n_owned, 3) to the end of the step without a
    collision.
    """
    iterates, contact, step = equations.integrator.iterates, equations.contact, equations.step
    if contact is None or (step.ends_at_stage and iterates):
        return True
    from lyra_petsc.contact.obstacle_points import StepInterval

    x = equations.x[: len(v)]
    end = equations.integrator.end(x, equations.v[: len(v)], v, step.dt)[0]
    # Newton's method has checked the displacement to the stage, a single linear solve has not
    here = _stage_positions(equations, v) if iterates else x
    return contact.collisions.is_free(here, end - here, step.frozen[contact.barrier], StepInterval(1.0, 2.0))


def may_collide(equations: StageEquations, approach: float) -> bool:
    """Whether parts may collide in the step, approaching by more than ``approach`` [m]."""
    if not equations.near or not equations.integrator.dynamic or equations.step.of_edges:
        return False
    assert equations.contact is not None
    return equations.contact.may_collide(
        equations.x, equations.expected_displacement(), equations.step.frozen, approach
    )


def may_impact(equations: StageEquations) -> bool:
    """Whether parts that are near move by a notable part of the gap in the step."""
    if equations.contact is None:
        return False
    return equations.contact.may_impact(
        equations.step.stage.c * equations.evaluated.v[: equations.points.n_vertices]
    )


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
