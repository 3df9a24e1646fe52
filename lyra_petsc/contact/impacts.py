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

Functions with a `StepEnd` are collective.
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.contact.friction import CoulombFriction, ObstacleMotion
from lyra_petsc.contact.friction_step import EndFriction
from lyra_petsc.contact.obstacle_points import ObstaclePositions, obstacle_loads
from lyra_petsc.contact.pairs import Contacts, FrictionPairs, Rows
from lyra_petsc.terms.step_end import ContactImpulses, StepEnd

MAX_SWEEPS, SETTLED = 30, 1e-7
"""Largest number of sweeps over the friction at the start or the end of a step, and change of it in a sweep
over the largest one below which they end."""


def end_step(
    step: StepEnd,
    barrier: ContactBarrier,
    obstacles: ObstaclePositions,
    friction: CoulombFriction | None,
    motion: ObstacleMotion | None,
) -> ContactImpulses:
    """All impulses at the end of a step that something may touch in."""
    contacts = barrier.find_contacts(step.x, obstacles.end)
    damped, push = _damp(step, barrier, contacts)
    if friction is None or motion is None:
        return damped
    damped_v = step.v + step.layout.extended(damped.change)
    slid = _slide(step._replace(v=damped_v), friction, motion, contacts, contacts.force + push)
    return ContactImpulses(
        damped.change + slid.change,
        damped.handle_force + slid.handle_force,
        damped.work + slid.work,
        damped.heat + slid.heat,
        np.concatenate([damped.obstacle, slid.obstacle]),
        np.concatenate([damped.loads, slid.loads]),
    )


def _damp(step: StepEnd, barrier: ContactBarrier, contacts: Contacts) -> tuple[ContactImpulses, Array]:
    """Damp the rates at which distances in contact change; returns also the forces (m,) [N].

    A pair with the rate r gets the impulse −w r of a dashpot, which keeps second order, with
    w/m = 1 − e^−q, q = 2 √(Δt² b″/m), m of `_pair_masses`.
    """
    rows, beta, dt = contacts.rows, contacts.sheet_beta, step.dt
    stiffness, pairs = barrier.contact_stiffness(contacts), (rows, beta, contacts.obstacle)
    mass = _pair_masses(step, rows, np.abs(beta), stiffness)
    rate = np.einsum("ei,eik,ek->e", beta, step.v[rows], contacts.normal)
    velocity = barrier.obstacles.contact_velocities(step.x, step.v, *pairs, contacts.points, step.last_times)
    approach = np.einsum("ek,ek->e", velocity, contacts.normal)
    q = 2.0 * dt * np.sqrt(stiffness / np.maximum(mass, np.finfo(float).tiny))
    push = np.maximum(mass * np.expm1(-q) * (rate - approach) / dt, -contacts.force)
    along = push[:, None] * contacts.normal
    impulse = _sums(rows, dt * beta[:, :, None] * along[:, None, :], len(step.x))
    change, heat = _applied(step, impulse, work := dt * float(push @ approach))
    loads = obstacle_loads(step.x, *pairs, along, np.column_stack([push, np.zeros_like(push)]))
    return ContactImpulses(change, step.handle_force(impulse), work, heat, *loads), push


def _slide(
    step: StepEnd, term: CoulombFriction, motion: ObstacleMotion, contacts: Contacts, normal_force: Array
) -> ContactImpulses:
    """Change the friction of the step to that of Coulomb's law with the ``normal_force`` (m,) [N] of the
    step.
    """
    dt = step.dt
    friction = term.end_friction(step.x, step.v, motion, contacts, normal_force, step.last_times)
    rows, pairs, of_obstacles = friction.rows, friction.pairs, friction.velocity
    mass = _pair_masses(step, rows, _sizes(pairs), pairs.force) / dt

    def rates(v: Array) -> Array:
        return pairs.displacement(v[rows]) - of_obstacles

    def after(force: Array) -> tuple[Array, Array]:
        """Impulses (n_local, 3) of a friction (m, 2), and the velocities (n_local, 3) after them."""
        impulse = _sums(rows, dt * pairs.pulls(force - friction.applied), len(step.x))
        return impulse, step.v + step.layout.extended(step.accelerations(impulse))

    force, before = friction.force - friction.applied, rates(step.v)
    impulse, v = after(force)
    largest = step.layout.global_max(float(friction.static.max(initial=0.0)))[0]
    for _ in range(MAX_SWEEPS):
        tried, (force, sticks) = force, _coulomb(friction, force, rates(v), mass, dt)
        impulse, v = after(force)
        moved = float(np.abs(force - tried).max(initial=0.0))
        if step.layout.global_max(moved)[0] <= SETTLED * largest:
            break
    changed, relative = force - friction.applied, rates(v)
    work = dt * float(np.vdot(changed, of_obstacles))
    own = impulse[: step.layout.n_owned]
    heat = work - 0.5 * float(np.vdot(own, (step.v + v)[: len(own)]))
    # of the change, with the mean of the velocities before and after, as external work
    of_change = -0.5 * dt * float(np.vdot(changed, before + relative))
    sliding = np.where(sticks, 0.0, -dt * np.einsum("ec,ec->e", force, relative))
    term.set_end_friction(friction, force, sticks, sliding)
    along, no_size = np.einsum("ec,eck->ek", changed, pairs.tangents), np.zeros_like(changed)
    loads = obstacle_loads(step.x, rows, pairs.beta, pairs.obstacle, along, no_size)
    handle_force, change = step.handle_force(impulse), (v - step.v)[: len(own)]
    return ContactImpulses(change, handle_force, work - of_change, heat - of_change, *loads)


def _coulomb(
    friction: EndFriction, force: Array, velocity: Array, mass: Array, dt: float
) -> tuple[Array, Mask]:
    """Friction (m, 2) [N] of pairs with relative velocities (m, 2) [m/s] under the friction ``force`` (m, 2)
    [N], and which of them stick; ``mass`` (m,) [kg/s] is the mass over Δt.
    """
    slides = friction.pairs.slides
    moves = slides | (dt * np.linalg.norm(velocity, axis=1) > friction.still)
    stopping = force - np.where(moves, mass, 0.0)[:, None] * velocity
    size = np.linalg.norm(stopping, axis=1)
    sticks = friction.holds | (size <= np.where(slides, friction.kinetic, friction.static))
    limit = np.where(sticks, friction.static, friction.kinetic)
    return stopping * np.minimum(limit / np.maximum(size, 1e-300), 1.0)[:, None], sticks


def hold_by_friction(
    step: StepEnd, term: CoulombFriction, motion: ObstacleMotion, acceleration: Array
) -> Array:
    """The accelerations (n_owned, 3) [m/s²] at the start of a step with the friction that opposes motion.

    ``acceleration`` has the friction of the elastic slip, which the forces that begin to act have not yet
    changed; the slip becomes that of the friction found, as the springs of sticking pairs would otherwise
    overshoot and yield. Friction as a constraint stops the relative displacements in a step with the
    velocities of ``step``, as far as its limit allows. (Projected gradients with momentum: Nesterov, Soviet
    Mathematics Doklady 27 (1983) 372-376.)
    """
    start, elastic, moved = term.starting_friction(motion)
    rows, pairs, limit = start.rows, start.pairs, start.limit
    layout, dt, n = step.layout, step.dt, len(step.v)
    largest = layout.global_max(float(limit.max(initial=0.0)))[0]
    if not largest > 0.0:
        return acceleration
    stopped = _pair_masses(step, rows, _sizes(pairs), pairs.force)

    def with_friction(friction: Array) -> Array:
        return acceleration + step.accelerations(_sums(rows, pairs.pulls(friction - elastic), n))

    friction = tried = elastic
    for sweep in range(MAX_SWEEPS):
        a = layout.extended(with_friction(tried))
        rate = pairs.displacement((step.v + 0.5 * dt * a)[rows]) + moved / dt
        after = tried - 2.0 / dt * stopped[:, None] * rate
        after *= np.minimum(1.0, limit / np.maximum(np.linalg.norm(after, axis=1), 1e-300))[:, None]
        change = float(np.abs(after - tried).max(initial=0.0))
        friction, tried = after, after + sweep / (sweep + 3.0) * (after - friction)
        if layout.global_max(change)[0] <= SETTLED * largest:
            break
    term.set_starting_friction(friction)
    return with_friction(friction)


def _sizes(pairs: FrictionPairs) -> Array:
    """Largest norms (m, 4) of the gradients of pairs over all tangential directions.

    A gradient β t + (d · t) n is longest for t along d, and has the length |β| for t perpendicular to d.
    """
    square = (pairs.gradients * pairs.gradients).sum(axis=(1, 3)) - pairs.beta * pairs.beta
    return np.sqrt(np.maximum(square, 0.0))


def _sums(points: Rows, values: Array, n: int) -> Array:
    """Sums (n, 3) of ``values`` (m, 4, 3) over the rows ``points`` (m, 4)."""
    rows = points.reshape(-1)
    columns = [np.bincount(rows, column, n) for column in values.reshape(-1, 3).T]
    return np.stack(columns, axis=1).astype(np.float64)


def _pair_masses(step: StepEnd, points: Rows, size: Array, weight: Array) -> Array:
    """Masses m (m,) [kg] that pairs of this rank may stop, whose gradients have the norms ``size`` (m, 4).

    The masses of vertices are divided in proportion to ``weight`` (m,), so that a pair that hardly touches
    takes no mass from others, and two halves of a pair are damped as the whole. With m_e = c_e times the
    least over the vertices i of a pair of mass over Σ_e c_e s_ei Σ_j s_ej, summed over all pairs e, the sum
    Σ_e w_e a_e a_eᵀ with w_e ≤ m_e does not exceed the mass matrix. All impulses together then reverse no
    motion, however many pairs a vertex has. It is 0 for pairs with prescribed unknowns.
    """
    shares = weight[:, None] * size * size.sum(axis=1, keepdims=True)
    shared = np.zeros_like(step.x)
    shared[:, 0] = np.bincount(points.reshape(-1), shares.reshape(-1), len(shared))
    step.layout.add_to_owners(shared)
    own, mass = shared[: step.layout.n_owned, :1], step.mass[:, None]
    inverse = np.divide(own, mass, out=np.zeros(step.free.shape), where=step.free & (mass > 0.0))
    inverse = step.layout.extended(inverse)
    largest = np.where((size != 0.0)[:, :, None], inverse[points], 0.0).max(axis=(1, 2), initial=0.0)
    return np.divide(weight, largest, out=np.zeros_like(weight), where=largest > 0.0)


def _applied(step: StepEnd, impulse: Array, work: float) -> tuple[Array, float]:
    """Change (n_owned, 3) [m/s] of the velocities by impulses (n_local, 3) [N s], and the heat [J]: ``work``
    of obstacles minus the change of kinetic energy.
    """
    change = step.accelerations(impulse)
    n = len(change)
    return change, work - float(np.vdot(impulse[:n], step.v[:n] + 0.5 * change))
