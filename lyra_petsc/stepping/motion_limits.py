"""How far a step's stage may move, by terms, directors and collisions; every function is collective."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.time_step import Evaluation

if TYPE_CHECKING:
    from lyra_petsc.contact.collisions import RefusedDisplacement
    from lyra_petsc.contact.contact_model import ContactModel

MAX_TURN = 0.25
"""Largest angle [rad] by which a Newton iteration of a static analysis may turn a director."""


IMPACT_STEP = 0.1
"""Displacement of a vertex in a step, over the skin of contact, from which on there may be an impact."""


def _stage_positions(equations: StageEquations, v: Array) -> Array:
    """Positions (n_owned, 3) [m] of the stage at velocities v (n_owned, 3), without ghosts."""
    return equations.step.stage.c * v + equations.step.x_h[: len(v)]


def limits_steps(equations: StageEquations) -> bool:
    """Whether `largest_step` may be less than 1.

    So it is with contact, and in statics with directors, which would else reach a distant equilibrium.
    """
    turns = bool(equations.active.with_edges) and not equations.integrator.dynamic
    return equations.acting_contact is not None or bool(equations.active.limiting) or turns


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
    frozen, contact = equations.step.frozen, equations.acting_contact
    if equations.active.limiting:
        x, displacement = equations.displacement(v, increment)
        allowed = [term.largest_step(x, displacement, frozen[term]) for term in equations.active.limiting]
        maximum = -equations.points.global_max(-min(maximum, *allowed))[0]
    if contact is None:
        return maximum
    x, dx = _stage_positions(equations, v), equations.step.stage.c * increment
    return contact.limit(frozen).largest_step(x, dx, maximum)


def separated(equations: StageEquations, v: Array, increment: Array) -> Array | None:
    """The increment (n_owned, 3) [m/s] from v, changed to separate the parts that it brings too near; None if
    there are none.
    """
    contact, step = equations.acting_contact, equations.step
    if contact is None:
        return None
    x, dx = _stage_positions(equations, v), step.stage.c * increment
    moved = contact.limit(step.frozen).separated(x, dx, step.prescribed.free)
    return None if moved is None else moved / step.stage.c


def contact_model(equations: StageEquations, v: Array) -> ContactModel:
    """Newton's model of contact at velocities v (n_owned, 3)."""
    assert equations.contact is not None
    step, x = equations.step, _stage_positions(equations, v)
    return equations.contact.limit(step.frozen).model(x, step.stage.c, step.prescribed.free)


def find_start(equations: StageEquations) -> tuple[Array | None, RefusedDisplacement | None]:
    """Velocities (n_owned, 3) [m/s] from which the step's solve can start without a collision; or None, and a
    displacement that collides.

    Free vertices stay, or keep their velocities, or obstacles push them; obstacles and prescribed unknowns
    move as they must.
    """
    still, contact = equations.stationary_velocity(), equations.acting_contact
    c, n, free = equations.step.stage.c, len(still), equations.step.prescribed.free
    start = still.copy()
    equations.prescribe(start)
    if contact is None:
        return start, None
    driven = np.where(free, 0.0, c * (start - still))
    if not any(equations.points.global_max(contact.obstacles_move or bool(driven.any()))):
        return start, None
    guesses = [np.zeros_like(still)]
    if not equations.integrator.starts_at_rest:
        guesses.append(c * (equations.v[:n] - still))
    collisions = contact.limit(equations.step.frozen)
    moved, refused = collisions.start(equations.x[:n], guesses, driven, free, with_obstacles=len(guesses) > 1)
    if moved is None:
        return None, refused
    start = still + moved / c
    equations.prescribe(start)
    return start, None


def stays_apart(equations: StageEquations, solution: Evaluation) -> bool:
    """Whether an integrator for smooth motions may take the step to its end: nothing collides on the way or
    touches there, and no term that limits steps acts there or at the stage, its ``solution``.
    """
    step, n, contact = equations.step, len(equations.mass), equations.contact
    if step.in_contact:
        return True
    x, active = equations.x[:n], equations.active
    end = equations.integrator.end(x, equations.v[:n], solution.v[:n], step.dt)[0]
    step.prescribed.overwrite(end, step.prescribed.goal)
    ends = (solution.x, equations.points.extended(end)) if active.limiting else ()
    if any(active.limits_act(at, step.frozen, equations.points) for at in ends):
        return False
    if contact is None:
        return True
    frozen = equations.active.with_targets(step.frozen, equations.targets_at(step.end))
    return contact.limit(frozen).stays_apart(x, end - x)


def may_collide(equations: StageEquations, approach: float) -> bool:
    """Whether parts may collide in the step, approaching by more than ``approach`` [m]."""
    contact = equations.acting_contact
    if contact is None or not equations.integrator.dynamic:
        return False
    collisions, expected = contact.limit(equations.step.frozen), equations.expected_displacement()
    return collisions.may_collide(equations.x, expected, approach)


def may_impact(equations: StageEquations) -> bool:
    """Whether parts that are near move by a notable part of the gap in the step."""
    contact = equations.acting_contact
    if contact is None or not contact.near:
        return False
    moved = equations.step.stage.c * equations.evaluated.v[: equations.points.n_vertices]
    (largest,) = equations.points.global_max(float(np.abs(moved).max(initial=0.0)))
    return bool(largest > IMPACT_STEP * contact.skin)


def is_resolved(equations: StageEquations) -> bool:
    """Whether the integrator of the step just taken can follow the contact in it: one of second order only
    if the normal forces have not changed too much.
    """
    return equations.integrator.order == 1 or equations.contact_end.resolved


def has_friction_pairs(equations: StageEquations) -> bool:
    """Whether there are friction pairs."""
    return equations.contact is not None and equations.contact.has_friction_pairs


def follow_contacts(equations: StageEquations, solution: Evaluation) -> bool:
    """Give friction the contacts of the stage that solves the equations, where these differ notably from
    theirs; returns whether they do.
    """
    contact = equations.acting_contact
    if contact is None or not equations.integrator.dynamic:
        return False
    if not contact.follow(solution.x, equations.x, equations.step.frozen):
        return False
    equations.change()
    return True
