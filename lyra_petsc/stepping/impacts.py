"""Impulses on velocities at the end of a step with contact: dashpots, and friction by the normal forces of
the step.

**Impacts.** A barrier stores the energy of an impact and would return it as a bounce. Dashpots of critical
damping of barrier and mass damp the rates of change of the distances in contact, along the lines
between the nearest points. Parts that lie, slide or roll at a constant distance are not damped. A dashpot
reduces the normal force of a step at most to 0: contact never pulls.

**Friction.** The equations of a step have normal forces from before the solve. Its own normal force N,
dashpots included, is known at its end, where the friction f of each pair becomes that of Coulomb's law: with
the friction f_0 in the equations, the relative tangential velocity v_t and the mass m of the pair,

    f = projection of f_0 − m v_t / Δt on the disc |f| ≤ μ N,

which stops the pair if it can, and else opposes the motion (the proximal form of Coulomb's law; Jean,
Computer Methods in Applied Mechanics and Engineering 177 (1999) 235-257).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.term import Contacts, Elastic, EndFriction

END = 1e-3
"""Last part of a step by whose motion the velocities of obstacles at its end are measured."""

MAX_SWEEPS, SETTLED = 30, 1e-7
"""Largest number of sweeps over the friction at the start or the end of a step, and change of it in a sweep
over the largest one below which they end."""


class ContactImpulses(NamedTuple):
    """Effects of the impulses at the end of a step, on this rank.

    Attributes
    ----------
    handle_force : (m,)
        Mean reaction forces [N] of handles, at the prescribed unknowns.
    work, heat : float
        Work of the obstacles by the impulses, and energy that became heat [J].
    obstacle, loads : (m,), (m, 8)
        Numbers of obstacles, and loads on them as in `Elastic.obstacle_forces`.
    """

    handle_force: Array
    work: float
    heat: float
    obstacle: Ints
    loads: Array


def end_step(system: StageEquations) -> ContactImpulses:
    """Apply all impulses at the end of a step that something may touch in; collective."""
    last, impulses = _last_times(system), []
    for contact in system.active.separating:
        contacts = contact.contacts(system.x, system.v, system.active.frozen[contact], last)
        if contacts is None:
            continue
        damped, push = _damp(system, contacts)
        impulses.append(damped)
        normal_force = contacts.force + push
        for term in system.active.changing:
            if term.slips:
                impulses.append(_slide(system, term, contacts, normal_force))
    handle_force = np.zeros(len(system.prescribed.indices))
    for each in impulses:
        handle_force += each.handle_force
    obstacle = np.concatenate([np.empty(0, np.int64), *(each.obstacle for each in impulses)])
    loads = np.concatenate([np.empty((0, 8)), *(each.loads for each in impulses)])
    work, heat = sum(each.work for each in impulses), sum(each.heat for each in impulses)
    return ContactImpulses(handle_force, work, heat, obstacle, loads)


def _damp(system: StageEquations, contacts: Contacts) -> tuple[ContactImpulses, Array]:
    """Damp the rates at which distances in contact change; returns also the forces (m,) [N]; collective.

    A pair with the rate r gets the impulse −w r of a dashpot, which keeps second order, with
    w/m = 1 − e^−q, q = 2 √(Δt² b″/m), m of `_pair_masses`.
    """
    points, beta, dt = contacts.points, contacts.sheet_beta, system.dt
    mass = _pair_masses(system, points, np.abs(beta), contacts.stiffness)
    rate = np.einsum("ei,eik,ek->e", beta, system.v[points], contacts.normal)
    approach = np.einsum("ek,ek->e", contacts.velocity, contacts.normal)
    q = 2.0 * dt * np.sqrt(contacts.stiffness / np.maximum(mass, np.finfo(float).tiny))
    push = np.maximum(mass * np.expm1(-q) * (rate - approach) / dt, -contacts.force)
    along = push[:, None] * contacts.normal
    impulse = _sums(points, dt * beta[:, :, None] * along[:, None, :], len(system.x))
    handle_force, heat = _apply(system, impulse, work := dt * float(push @ approach))
    loads = _loads(system, points, beta, contacts.obstacle, along, push)
    return ContactImpulses(handle_force, work, heat, *loads), push


def _slide(system: StageEquations, term: Elastic, contacts: Contacts, normal_force: Array) -> ContactImpulses:
    """Change the friction of the step to that of Coulomb's law with the ``normal_force`` (m,) [N] of the
    step; collective.
    """
    frozen, last, dt = system.active.frozen[term], _last_times(system), system.dt
    friction = term.end_friction(system.x, system.v, frozen, contacts, normal_force, last)
    points, gradients = friction.points, friction.gradients
    of_obstacles = np.einsum("eck,ek->ec", friction.tangents, friction.velocity)
    mass = _pair_masses(system, points, _sizes(gradients, friction.beta), friction.normal_force) / dt

    def rates(v: Array) -> Array:
        relative: Array = np.einsum("ecik,eik->ec", gradients, v[points]) - of_obstacles
        return relative

    def impulse_of(change: Array) -> Array:
        return _sums(points, dt * np.einsum("ec,ecik->eik", change, gradients), len(system.x))

    before, force = rates(system.v), friction.force - friction.applied
    largest = system.points.global_max(float(friction.static.max(initial=0.0)))[0]
    for _ in range(MAX_SWEEPS):
        v = system.v + _velocity_change(system, impulse_of(force - friction.applied))
        tried, (force, sticks) = force, _coulomb(friction, force, rates(v), mass, dt)
        moved = float(np.abs(force - tried).max(initial=0.0))
        if system.points.global_max(moved)[0] <= SETTLED * largest:
            break
    change = force - friction.applied
    impulse = impulse_of(change)
    work = dt * float(np.vdot(change, of_obstacles))
    handle_force, heat = _apply(system, impulse, work)
    after = rates(system.v)
    # of the change, with the mean of the velocities before and after, as external work
    of_change = -0.5 * dt * float(np.vdot(change, before + after))
    sliding = np.where(sticks, 0.0, -dt * np.einsum("ec,ec->e", force, after))
    term.set_end_friction(friction, force, sticks, sliding)
    along = np.einsum("ec,eck->ek", change, friction.tangents)
    loads = _loads(system, points, friction.beta, friction.obstacle, along, np.zeros(len(along)))
    return ContactImpulses(handle_force, work - of_change, heat - of_change, *loads)


def _coulomb(
    friction: EndFriction, force: Array, velocity: Array, mass: Array, dt: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Friction (m, 2) [N] of pairs with relative velocities (m, 2) [m/s] under the friction ``force`` (m, 2)
    [N], and which of them stick; ``mass`` (m,) [kg/s] is the mass over Δt.
    """
    moves = friction.slides | (dt * np.linalg.norm(velocity, axis=1) > friction.still)
    stopping = force - np.where(moves, mass, 0.0)[:, None] * velocity
    size = np.linalg.norm(stopping, axis=1)
    # a spring that still yields less than its limit need not stop the pair within the step
    holds = friction.held & (np.linalg.norm(friction.force, axis=1) <= friction.static)
    sticks = holds | (size <= np.where(friction.slides, friction.kinetic, friction.static))
    limit = np.where(sticks, friction.static, friction.kinetic)
    return stopping * np.minimum(limit / np.maximum(size, 1e-300), 1.0)[:, None], sticks


def hold_by_friction(system: StageEquations, term: Elastic, v: Array, acceleration: Array) -> Array:
    """The accelerations (n_owned, 3) [m/s²] at the start of a step with the friction that opposes motion.

    ``acceleration`` has the friction of the elastic slip, which the forces that begin to act have not yet
    changed; the slip becomes that of the friction found, as the springs of sticking pairs would otherwise
    overshoot and yield. Friction as a constraint stops the relative displacements in a step with velocities v
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
    stopped = _pair_masses(system, points, size, weight)
    moves = system.prescribed.free & (mass > 0.0)

    def with_friction(friction: Array) -> Array:
        pull = _sums(points, np.einsum("ec,ecik->eik", friction - elastic, gradients), len(v))
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
    term.set_starting_friction(friction)
    return with_friction(friction)


def _last_times(system: StageEquations) -> tuple[float, float]:
    """Times [s] between which the mean velocity of obstacles is comparable with velocities after the step,
    which are means of the step under backward Euler.
    """
    part = END if system.integrator.order > 1 else 1.0
    return system.t1 - part * system.dt, system.t1


def _sizes(gradients: Array, beta: Array) -> Array:
    """Largest norms (m, 4) of ``gradients`` (m, 2, 4, 3) over all tangential directions.

    A gradient β t + (d · t) n is longest for t along d, and has the length |β| for t perpendicular to d.
    """
    return np.sqrt(np.maximum((gradients * gradients).sum(axis=(1, 3)) - beta * beta, 0.0))


def _sums(points: Ints, values: Array, n: int) -> Array:
    """Sums (n, 3) of ``values`` (m, 4, 3) over the rows ``points`` (m, 4)."""
    rows = points.reshape(-1)
    columns = [np.bincount(rows, column, n) for column in values.reshape(-1, 3).T]
    return np.stack(columns, axis=1).astype(np.float64)


def _pair_masses(system: StageEquations, points: Ints, size: Array, weight: Array) -> Array:
    """Masses m (m,) [kg] that pairs of this rank may stop, whose gradients have the norms ``size`` (m, 4);
    collective.

    The masses of vertices are divided in proportion to ``weight`` (m,), so that a pair that hardly touches
    takes no mass from others, and two halves of a pair are damped as the whole. With m_e = c_e times the
    least over the vertices i of a pair of mass over Σ_e c_e s_ei Σ_j s_ej, summed over all pairs e, the sum
    Σ_e w_e a_e a_eᵀ with w_e ≤ m_e does not exceed the mass matrix. All impulses together then reverse no
    motion, however many pairs a vertex has. It is 0 for pairs with prescribed unknowns.
    """
    n, mass = system.points.n_owned, system.mass[:, None]
    shares = weight[:, None] * size * size.sum(axis=1, keepdims=True)
    shared, inverse = np.zeros((2, *system.x.shape))
    shared[:, 0] = np.bincount(points.reshape(-1), shares.reshape(-1), len(shared))
    system.points.add_to_owners(shared)
    free = system.prescribed.free & (mass > 0.0)
    np.divide(shared[:n, :1], mass, out=inverse[:n], where=free)
    system.points.update_ghosts(inverse)
    largest = np.where((size != 0.0)[:, :, None], inverse[points], 0.0).max(axis=(1, 2), initial=0.0)
    return np.divide(weight, largest, out=np.zeros_like(weight), where=largest > 0.0)


def _loads(
    system: StageEquations, points: Ints, beta: Array, obstacle: Ints, force: Array, normal_force: Array
) -> tuple[Ints, Array]:
    """Numbers of obstacles and loads (m, 8) on them by forces β times ``force`` (m, 3) [N] on the points of
    sheets, of which ``normal_force`` (m,) [N] are the normal forces.
    """
    on = np.flatnonzero(obstacle >= 0)
    side = beta[on].sum(axis=1, keepdims=True)
    at = np.einsum("ei,eik->ek", beta[on], system.x[points[on]]) / side
    on_obstacle = -side * force[on]
    magnitudes = np.column_stack([normal_force[on], np.zeros(len(on))])
    return obstacle[on], np.hstack([on_obstacle, np.cross(at, on_obstacle), magnitudes])


def _velocity_change(system: StageEquations, impulse: Array) -> Array:
    """Change (n_local, 3) [m/s] of the velocities by impulses (n_local, 3) [N s]; collective.

    Prescribed unknowns keep their velocities. ``impulse`` gets the sums over ranks in its owned rows.
    """
    n, mass = system.points.n_owned, system.mass[:, None]
    system.points.add_to_owners(impulse)
    change, free = np.zeros_like(impulse), system.prescribed.free & (mass > 0.0)
    np.divide(impulse[:n], mass, out=change[:n], where=free)
    system.points.update_ghosts(change)
    return change


def _apply(system: StageEquations, impulse: Array, work: float) -> tuple[Array, float]:
    """Apply impulses (n_local, 3) [N s] to the velocities; collective.

    Returns the mean reaction forces [N] of handles, and the heat [J]: ``work`` of obstacles minus the change
    of kinetic energy.
    """
    n = system.points.n_owned
    change = _velocity_change(system, impulse)[:n]
    heat = work - float(np.vdot(impulse[:n], system.v[:n] + 0.5 * change))
    system.state.set(system.x[:n], system.v[:n] + change)
    system.in_contact.shift_past_velocities(change)
    return -impulse[:n].take(system.prescribed.indices) / system.dt, heat
