"""How far a step's stage may move, by terms, directors and collisions; every function is collective."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.stepping.stage_equations import StageEquations

if TYPE_CHECKING:
    from lyra_petsc.contact.scene_contact import SceneContact

MAX_TURN = 0.25
"""Largest angle [rad] by which a Newton iteration of a static analysis may turn a director."""


def _stage_positions(system: StageEquations, v: Array) -> Array:
    """Positions (n_owned, 3) [m] of the stage at velocities v (n_owned, 3), without ghosts."""
    return system.step.stage.c * v + system.step.x_h[: len(v)]


def limits_steps(system: StageEquations) -> bool:
    """Whether `largest_step` may be less than 1.

    So it is with contact, and in statics with directors, which would else reach a distant equilibrium.
    """
    turns = bool(system.active.with_edges) and not system.integrator.dynamic
    return system.contact is not None or bool(system.active.limiting) or turns


def largest_step(system: StageEquations, v: Array, increment: Array) -> float:
    """Largest fraction of an increment (n_owned, 3) [m/s] from v that may be taken."""
    reach = system.step.stage.c
    turn = 0.0 if system.integrator.dynamic else system.directors.largest_turn(increment * reach)
    return _largest_step(system, v, increment, MAX_TURN / turn if turn > MAX_TURN else 1.0)


def are_kept(system: StageEquations, x: Array) -> bool:
    """Whether positions x (n_local, 3) are within the limits of all terms."""
    terms, frozen = system.active.limiting, system.step.frozen
    beyond = any(term.overrun(x, frozen[term])[1] for term in terms)
    return not terms or not any(system.points.global_max(beyond))


def moves_freely(system: StageEquations, v: Array, increment: Array) -> bool:
    """Whether no collision limits an increment (n_owned, 3) [m/s] from v."""
    return _largest_step(system, v, increment, 1.0) == 1.0


def _largest_step(system: StageEquations, v: Array, increment: Array, maximum: float) -> float:
    frozen, contact = system.step.frozen, system.contact
    if system.active.limiting:
        x, displacement = system.displacement(v, increment)
        allowed = [term.largest_step(x, displacement, frozen[term]) for term in system.active.limiting]
        maximum = -system.points.global_max(-min(maximum, *allowed))[0]
    if contact is None:
        return maximum
    x, dx = _stage_positions(system, v), system.step.stage.c * increment
    return contact.collisions.limit(x, dx, frozen[contact.barrier], maximum)


def separated(system: StageEquations, v: Array, increment: Array) -> Array | None:
    """The increment (n_owned, 3) [m/s] from v, changed to separate the parts that it brings too near; None if
    there are none.
    """
    contact, step = system.contact, system.step
    if contact is None:
        return None
    x, dx = _stage_positions(system, v), step.stage.c * increment
    moved = contact.collisions.separate(x, dx, step.frozen[contact.barrier], step.prescribed.free)
    return None if moved is None else moved / step.stage.c


def contact_at(
    system: StageEquations, v: Array
) -> tuple[SceneContact, Discretisation, Array, float, Mask, Any]:
    """What Newton's model of contact takes from the equations at velocities v (n_owned, 3)."""
    assert system.contact is not None
    step, x = system.step, _stage_positions(system, v)
    obstacles = step.frozen[system.contact.barrier]
    return system.contact, system.discretisation, x, step.stage.c, step.prescribed.free, obstacles


def find_start(system: StageEquations) -> Array | None:
    """Velocities (n_owned, 3) [m/s] from which the step's solve can start without a collision, if any.

    Free vertices stay, or keep their velocities, or obstacles push them; obstacles and prescribed unknowns
    move as they must.
    """
    still, contact = system.stationary_velocity(), system.contact
    c, n, free = system.step.stage.c, len(still), system.step.prescribed.free
    start = still.copy()
    system.prescribe(start)
    if contact is None:
        return start
    driven = np.where(free, 0.0, c * (start - still))
    if not any(system.points.global_max(contact.obstacles_move or bool(driven.any()))):
        return start
    guesses = [np.zeros_like(still)]
    if not system.integrator.starts_at_rest:
        guesses.append(c * (system.v[:n] - still))
    obstacles, pushes = system.step.frozen[contact.barrier], len(guesses) > 1
    found = contact.collisions.start(system.x[:n], guesses, driven, free, obstacles, pushes=pushes)
    if found is None:
        return None
    start = still + found / c
    system.prescribe(start)
    return start


def end_is_free(system: StageEquations, v: Array) -> bool:
    """Whether the sheet moves from the stage with velocities v (n_owned, 3) to the end of the step without a
    collision.
    """
    iterates, contact, step = system.integrator.iterates, system.contact, system.step
    if contact is None or (step.ends_at_stage and iterates):
        return True
    from lyra_petsc.contact.obstacle_points import StepInterval

    x = system.x[: len(v)]
    end = system.integrator.end(x, system.v[: len(v)], v, step.dt)[0]
    # Newton's method has checked the displacement to the stage, a single linear solve has not
    here = _stage_positions(system, v) if iterates else x
    return contact.collisions.is_free(here, end - here, step.frozen[contact.barrier], StepInterval(1.0, 2.0))


def may_collide(system: StageEquations, approach: float) -> bool:
    """Whether parts may collide in the step, approaching by more than ``approach`` [m]."""
    if not system.near or not system.integrator.dynamic or system.step.of_edges:
        return False
    assert system.contact is not None
    return system.contact.may_collide(system.x, system.expected_displacement(), system.step.frozen, approach)


def may_impact(system: StageEquations) -> bool:
    """Whether parts that are near move by a notable part of the gap in the step."""
    if system.contact is None:
        return False
    return system.contact.may_impact(system.step.stage.c * system.evaluated.v[: system.points.n_vertices])
