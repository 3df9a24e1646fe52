"""Impulses on velocities at the end of a step with contact, and friction at the start of one.

**All integrators**: a barrier stores the energy of an impact and would return it as a bounce. `damp_impacts`
damps the rates of change of the distances in contact, by dashpots of half the critical damping of barrier and
mass along the lines between the nearest points. After an impact parts separate with about a tenth of their
speed, whatever Δt is, and come to rest within a few periods of the barrier. Parts that lie, slide or roll at
a constant distance are not damped. (Without damping sheets bounce for long under backward Euler with short
steps, and under integrators of second order with any. Bouncing parts slide where they should stick, as their
normal force is too small half of the time.) `correct_friction` then adapts friction to the normal forces of
the step, dashpots included.

**The midpoint rule**: energy that contact adds is removed from the velocities. The rule works with the forces
at its stage, and a barrier that stiffens within a step stores less energy than the work of these forces, or
returns more. The surplus of a step ::

    E(x_{n+1}) − E(x_n) − ∇E(x_s) · (x_{n+1} − x_n)

is summed over the steps. A negative sum is bounded by the energy stored in contact, because only that can be
returned. A positive sum is removed from the kinetic energy by impulses between the pairs in contact, in
proportion to their normal forces and along the lines between their nearest points at the end of the step, so
that momentum and angular momentum are conserved. (Energy by projection: Hairer, Lubich & Wanner, Geometric
Numerical Integration, sec. IV.4.)
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.contact import dashpots
from lyra_petsc.terms.term import Elastic

DAMPING = 0.5
"""Damping of the distances in contact, over the critical damping."""

END = 1e-3
"""Last part of a step by whose motion the velocities of obstacles at its end are measured."""

MAX_SWEEPS, SETTLED = 30, 1e-4
"""Largest number of sweeps over the friction at the start of a step, and change of it in a sweep over the
largest one below which they end."""


class ContactImpulses(NamedTuple):
    """Effects of the impulses at the end of a step, on this rank.

    Attributes
    ----------
    normal_force : (n_owned,)
        Mean normal forces [N] of impulses on vertices, for friction.
    handle_force : (m,)
        Mean reaction forces [N] of handles, at the prescribed unknowns.
    work, heat : float
        Work of the obstacles by the impulses, and energy that became heat [J].
    obstacle, position, force : (m,), (m, 3), (m, 3)
        Numbers of obstacles, positions [m] of the mean forces on them, and these forces [N].
    """

    normal_force: Array
    handle_force: Array
    work: float
    heat: float
    obstacle: Ints
    position: Array
    force: Array


def apply_impulses(system: StageEquations, x_before: Array, contact_energy: float | None) -> ContactImpulses:
    """Apply all impulses at the end of a step from x_before (n_owned, 3) [m]; collective.

    ``contact_energy`` [J] is this rank's energy of contact there, or None if no surplus is removed.
    """
    normal_force, integrator = np.zeros(system.points.n_owned), system.integrator
    if contact_energy is not None:
        integrator.surplus, normal_force = remove_surplus(
            system, contact_energy, x_before, integrator.surplus
        )
    impulses = damp_impacts(system, normal_force)
    for term in system.active.changing:
        if term.slips:
            impulses = correct_friction(system, term, impulses)
    return impulses


def remove_surplus(
    system: StageEquations, before: float, x_before: Array, surplus_before: float
) -> tuple[float, Array]:
    """Remove the energy that contact has added from the velocities of the present state; collective.

    ``before`` [J] is this rank's energy of contact at x_before (n_owned, 3), ``surplus_before`` [J] the
    surplus of the steps before. Returns the surplus [J] that remains, and the mean normal forces [N] of the
    impulses on vertices, (n_owned,), for friction.
    """
    n = system.points.n_owned
    terms, frozen = system.active.separating, system.active.frozen
    moved, work, after = system.x[:n] - x_before, 0.0, 0.0
    for term in terms:
        term.add_gradient(system.stage_positions, frozen[term], pull := np.zeros_like(system.x))
        work += float(np.vdot(pull[:n], moved))
        after += float(term.energies(system.x, frozen[term]).sum())
    gain, stored = (float(value) for value in system.points.global_sum(after - before - work, after))
    remaining, normal_force = max(surplus_before + gain, -stored), np.zeros(n)
    if not remaining > 0.0:
        return remaining, normal_force
    impulse = np.zeros_like(system.x)
    for term in terms:
        normal_force += _add_impulses(term, system, frozen[term], impulse)
    system.points.add_to_owners(impulse)
    impulse = np.where(system.prescribed.free, impulse[:n], 0.0)
    mass = system.mass[:, None]
    change = np.divide(impulse, mass, out=np.zeros_like(impulse), where=mass > 0.0)
    local = float(np.vdot(impulse, change)), float(np.vdot(impulse, system.v[:n]))
    square, rate = (float(value) for value in system.points.global_sum(*local))
    if not square > 0.0:
        return remaining, np.zeros(n)
    # solve ½ square s² + rate s = −remaining, or minimise the left side if there is no solution
    discriminant = max(rate * rate - 2.0 * square * remaining, 0.0)
    size = (-rate + math.copysign(math.sqrt(discriminant), rate)) / square
    system.state.set(system.x[:n], system.v[:n] + size * change)
    return remaining + (0.5 * square * size + rate) * size, size / system.dt * normal_force


def _add_impulses(term: Elastic, system: StageEquations, frozen: Any, out: Array) -> Array:
    """Add impulses, up to a factor, of the counted pairs in contact at the stage to out (n_local, 3); returns
    their sums for vertices in contact, (n_owned,).
    """
    points, beta, normal, force, vertex = term.contact_points(system.stage_positions, frozen)
    sheet = points >= 0
    between = sheet.all(axis=1)
    beta = np.where(sheet, beta, 0.0)
    rows = np.where(sheet, points, 0)
    separation = np.einsum("ei,eik->ek", beta[between], system.x[rows[between]])
    normal = normal.copy()
    length = np.maximum(np.linalg.norm(separation, axis=1), np.finfo(float).tiny)
    normal[between] = separation / length[:, None]
    np.add.at(out, rows, (force[:, None] * beta)[:, :, None] * normal[:, None, :])
    at = vertex >= 0
    return np.bincount(vertex[at], force[at], system.points.n_owned).astype(np.float64)


def damp_impacts(system: StageEquations, normal_force: Array) -> ContactImpulses:
    """Damp the rates at which distances in contact change; collective.

    ``normal_force`` (n_owned,) are mean normal forces [N] of earlier impulses of the step on vertices.
    A pair with the rate r gets the impulse −w r of a dashpot in Δt, which keeps second order, with
    w/m = 1 − e^−q, q = 2 ζ √(Δt² b″/m). The mass m of `_inverse_masses` is such that no impulse is too large;
    the masses of vertices are divided in proportion to b″, so that a pair that hardly touches takes no mass
    from others, and two halves of a pair are damped as the whole.
    """
    layout, n, dt = system.points, system.points.n_owned, system.dt
    last = _last_times(system)
    all_pairs = [
        term.dashpots(system.x, system.v, system.active.frozen[term], last)
        for term in system.active.separating
    ]
    if not any(layout.global_max(sum(len(pairs.points) for pairs in all_pairs))):
        reactions, obstacle = np.zeros(len(system.prescribed.indices)), np.empty(0, dtype=np.int64)
        return ContactImpulses(normal_force, reactions, 0.0, 0.0, obstacle, *np.empty((2, 0, 3)))
    # a pair is handled by the rank of one of its vertices, which knows all pairs with the same nearest points
    owned = [np.empty(len(pairs.points), dtype=bool) for pairs in all_pairs]
    for pairs, own in zip(all_pairs, owned, strict=True):
        dashpots.find_own(*pairs[:2], pairs.vertex, layout.global_number, n, own)
    sheets = _corrects_sheets(system)
    both = list(zip(all_pairs, owned, strict=True))
    inverse = _inverse_masses(system, [(*pairs[:2], pairs.stiffness, own) for pairs, own in both])
    work, impulse, pushes = 0.0, np.zeros_like(system.x), []
    for pairs, own in both:
        push = np.empty(len(own))
        given = *pairs[:4], pairs.approach, own, dt, DAMPING
        dashpots.damp(system.v, inverse, *given, push, impulse)
        vertex = np.flatnonzero(own & (pairs.vertex >= 0) & (sheets | (pairs.obstacle >= 0)))
        normal_force = normal_force + np.bincount(pairs.vertex[vertex], push[vertex] / dt, minlength=n)
        work += float(push @ pairs.approach)
        on = np.flatnonzero(own & (pairs.obstacle >= 0))
        force = (push[on] / dt)[:, None] * pairs.normal[on]
        pushes.append(_obstacle_forces(system, pairs.points[on], pairs.beta[on], pairs.obstacle[on], force))
    handle_force, heat = _apply_impulse(system, impulse, work)
    on_obstacles = (np.concatenate(part) for part in zip(*pushes, strict=True))
    return ContactImpulses(normal_force, handle_force, work, heat, *on_obstacles)


def correct_friction(system: StageEquations, term: Elastic, before: ContactImpulses) -> ContactImpulses:
    """Correct the friction of sliding pairs by impulses: add what is missing, remove what was too much.

    Returns the effects of all impulses of the step, those ``before`` included; collective. An impulse is at
    most the sliding speed times m of `_inverse_masses`, so that missing friction reverses no pair, and
    removed friction at most doubles its speed. (Friction of a light vertex that others press on an obstacle's
    edge is balanced by them; without the bound the vertex would be thrown off.) Friction forces have no
    moment at the positions where the step begins. The moment that they and these impulses have elsewhere is
    removed under the midpoint rule, so that angular momentum is conserved.
    """
    stage, x, dt = system.stage_positions, system.x, system.dt
    frozen, sheets = system.active.frozen[term], _corrects_sheets(system)
    last = _last_times(system)
    corrections = term.friction_corrections(
        stage, x, system.v, frozen, before.normal_force, dt, sheets=sheets, last=last
    )
    points, beta, weight, direction, gradient, missing, obstacle, moved = corrections
    pairs, moments = np.empty((0, 4), dtype=np.int64), np.empty((0, 3))
    if system.integrator.exact_work:
        pairs, moments = term.moments(stage, frozen)
    if not any(system.points.global_max(float(np.abs(missing).max(initial=0.0)), len(pairs))):
        return before
    impulse = np.zeros_like(x)
    size = np.linalg.norm(gradient, axis=2)
    stopped = _stoppable_masses(system, points, size, weight, missing != 0.0)
    speed = np.einsum("eik,eik->e", system.v[points], gradient) - np.einsum("ek,ek->e", moved, direction) / dt
    stopping = stopped * np.maximum(speed, 0.0) / dt
    push = -np.clip(missing, -stopping, stopping)
    force, impulses = push[:, None] * direction, (dt * push)[:, None, None] * gradient
    np.add.at(impulse, points, impulses)
    if system.integrator.exact_work:
        between = obstacle < 0
        theirs = np.cross(x[points[between]], impulses[between]).sum(axis=1)
        pairs, moments = np.concatenate([pairs, points[between]]), np.concatenate([dt * moments, theirs])
        dashpots.add_couples(x, pairs, -moments, impulse)
    work, on = float(np.vdot(force, moved)), obstacle >= 0
    pushed = _obstacle_forces(system, points[on], beta[on], obstacle[on], force[on])
    handle_force, heat = _apply_impulse(system, impulse, work)
    # the work of friction, with the mean of the speeds before and after, is external work
    after = np.einsum("eik,eik->e", system.v[points], gradient) - np.einsum("ek,ek->e", moved, direction) / dt
    friction_work = -0.5 * dt * push * (speed + after)
    term.set_impulse_work(points[:, 0], friction_work)
    total = float(friction_work.sum())
    sums = before.handle_force + handle_force, before.work + work - total, before.heat + heat - total
    on_obstacles = (np.concatenate(part) for part in zip(before[4:], pushed, strict=True))
    return ContactImpulses(before.normal_force, *sums, *on_obstacles)


def hold_by_friction(system: StageEquations, term: Elastic, v: Array, acceleration: Array) -> Array:
    """The accelerations (n_owned, 3) [m/s²] at the start of a step with the friction that opposes motion.

    ``acceleration`` has the friction of the elastic slip, which the forces that begin to act have not yet
    changed. Friction as a constraint stops the relative displacements in a step with velocities v
    (n_local, 3) [m/s], as far as its limit allows; collective. (Projected gradients with momentum: Nesterov,
    Soviet Mathematics Doklady 27 (1983) 372-376.)
    """
    points, gradients, size, weight, limit, elastic, moved = term.starting_friction(
        system.active.frozen[term]
    )
    layout, dt, mass = system.points, system.dt, system.mass[:, None]
    largest = layout.global_max(float(limit.max(initial=0.0)))[0]
    if not largest > 0.0:
        return acceleration
    stopped = _stoppable_masses(system, points, size, weight, np.ones(len(points), dtype=np.bool_))
    moves = system.prescribed.free & (mass > 0.0)

    def with_friction(friction: Array) -> Array:
        pull = np.zeros_like(v)
        np.add.at(pull, points, np.einsum("ec,ecik->eik", friction - elastic, gradients))
        layout.add_to_owners(pull)
        change = pull[: layout.n_owned]
        return acceleration + np.divide(change, mass, out=np.zeros_like(change), where=moves)

    a, friction, tried = np.zeros_like(v), elastic, elastic
    for sweep in range(MAX_SWEEPS):
        a[: layout.n_owned] = with_friction(tried)
        layout.update_ghosts(a)
        rate = np.einsum("ecik,eik->ec", gradients, (v + 0.5 * dt * a)[points]) + moved / dt
        after = tried - 2.0 / dt * stopped[:, None] * rate
        after *= np.minimum(1.0, limit / np.maximum(np.linalg.norm(after, axis=1), 1e-300))[:, None]
        change = float(np.abs(after - tried).max(initial=0.0))
        friction, tried = after, after + sweep / (sweep + 3.0) * (after - friction)
        if layout.global_max(change)[0] <= SETTLED * largest:
            break
    return with_friction(friction)


def _last_times(system: StageEquations) -> tuple[float, float]:
    """Times [s] between which the mean velocity of obstacles is comparable with velocities after the step,
    which are means of the step under backward Euler.
    """
    part = END if system.integrator.order > 1 else 1.0
    return system.t1 - part * system.dt, system.t1


def _corrects_sheets(system: StageEquations) -> bool:
    """Whether friction between sheets is corrected, too: if the stage is not the end of the step."""
    return system.stage.offset < system.dt


def _stoppable_masses(
    system: StageEquations, points: Ints, size: Array, weight: Array, own: NDArray[np.bool_]
) -> Array:
    """The m (m,) [kg] of `_inverse_masses` of pairs whose gradients have the norms ``size`` (m, 4);
    collective.
    """
    inverse = _inverse_masses(system, [(points, size, weight, own)])
    largest = np.where((size != 0.0)[:, :, None], inverse[points], 0.0).max(axis=(1, 2), initial=0.0)
    return np.divide(weight, largest, out=np.zeros_like(weight), where=largest > 0.0)


def _inverse_masses(
    system: StageEquations, all_pairs: Iterable[tuple[Ints, Array, Array, NDArray[np.bool_]]]
) -> Array:
    """1/m (n_local, 3) [1/kg] of the share of a vertex's mass that a pair of weight 1 may stop; collective.

    It is 0 for prescribed unknowns. ``all_pairs`` are points, β, weights c and masks of the pairs of this
    rank. With m_e = c_e times the least over the vertices i of a pair of mass over Σ_e c_e |β_ei| Σ_j |β_ej|,
    summed over all pairs e, the sum Σ_e w_e a_e a_eᵀ with w_e ≤ m_e does not exceed the mass matrix. All
    impulses together then reverse no motion, however many pairs a vertex has.
    """
    n, mass = system.points.n_owned, system.mass[:, None]
    shared, inverse = np.zeros((2, *system.x.shape))
    for points, beta, weight, own in all_pairs:
        dashpots.share(points, beta, weight, own, shared)
    system.points.add_to_owners(shared)
    free = system.prescribed.free & (mass > 0.0)
    np.divide(shared[:n, :1], mass, out=inverse[:n], where=free)
    system.points.update_ghosts(inverse)
    return inverse


def _obstacle_forces(
    system: StageEquations, points: Ints, beta: Array, obstacle: Ints, force: Array
) -> tuple[Ints, Array, Array]:
    """Obstacles of pairs, positions (m, 3) [m] of the forces on them, and these forces (m, 3) [N].

    A sheet's points get ``force`` (m, 3) [N] times β.
    """
    of_sheet = np.where(points >= 0, beta, 0.0)
    side = of_sheet.sum(axis=1, keepdims=True)
    at = np.einsum("ei,eik->ek", of_sheet, system.x[np.maximum(points, 0)]) / side
    return obstacle, at, -side * force


def _apply_impulse(system: StageEquations, impulse: Array, work: float) -> tuple[Array, float]:
    """Apply impulses (n_local, 3) [N s] to the velocities; collective.

    Returns the mean reaction forces [N] of handles, and the heat [J]: ``work`` of obstacles minus the change
    of kinetic energy.
    """
    n, mass = system.points.n_owned, system.mass[:, None]
    system.points.add_to_owners(impulse)
    # prescribed unknowns keep their velocities, with reactions against the impulses
    free = system.prescribed.free & (mass > 0.0)
    change = np.divide(impulse[:n], mass, out=np.zeros_like(impulse[:n]), where=free)
    heat = work - float(np.vdot(impulse[:n], system.v[:n] + 0.5 * change))
    system.state.set(system.x[:n], system.v[:n] + change)
    system.integrator.shift_past_velocities(change)
    return -impulse[:n].take(system.prescribed.indices) / system.dt, heat
