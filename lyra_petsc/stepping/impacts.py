"""Impacts: what is done to velocities at the end of a step where something touches.

**All integrators**: the barrier is no spring to bounce on. `damp_impacts` damps the rates at which distances
in contact change by dashpots of half the critical damping of barrier and mass, along the lines between
nearest points. What meets parts with about a tenth of its speed, whatever Δt is, and comes to rest within a
few periods of the barrier; what lies, slides or rolls at the same distance is not damped. (Without it sheets
bounce for long under backward Euler with short steps, and with any under integrators of second order; and
what bounces slides on where it should stand, as its normal force is too small every other moment.)
`make_up_friction` then lets friction follow the normal forces that acted in the step, those of dashpots,
too.

**The midpoint rule**: what contact would add to the energy is taken from the velocities. The rule works with
the forces at its stage, and a barrier that stiffens within a step stores less energy than they take, or gives
back more. The surplus of a step ::

    E(x_{n+1}) − E(x_n) − ∇E(x_s) · (x_{n+1} − x_n)

is summed up, negative no farther than what contact has stored, as only that comes back. What is above 0 is
taken from the kinetic energy by impulses between the pairs in contact, in proportion to their normal forces
and along the lines between their nearest points at the end of the step, so that momentum and angular momentum
stay as they are. (Energy by projection: Hairer, Lubich & Wanner, Geometric Numerical Integration, sec. IV.4.)
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms import dashpots
from lyra_petsc.terms.term import Elastic

DAMPING = 0.5
"""Of the distances in contact, over the critical one."""


class Damped(NamedTuple):
    """What impulses at the end of a step did, on this rank.

    Attributes
    ----------
    felt : (n_owned,)
        Mean forces [N] of dashpots on vertices that meet what friction follows.
    held : (m,)
        What handles must hold against [N], at the prescribed unknowns.
    work, heat : float
        What obstacles did by them [J], and what became heat.
    obstacle, at, force : (m,), (m, 3), (m, 3)
        Obstacles, where they are pushed [m], and the mean force on them [N].
    """

    felt: Array
    held: Array
    work: float
    heat: float
    obstacle: Ints
    at: Array
    force: Array


def surplus(system: StageEquations, before: float, x_before: Array, surplus_before: float) -> float:
    """The surplus [J] that is left after a step to the present state, whose velocities lose the rest.

    ``before`` [J] is this rank's energy of contact at x_before (n_owned, 3); collective.
    """
    n = system.points.n_owned
    terms, frozen = system.active.limiting, system.active.frozen
    moved, work, after = system.x[:n] - x_before, 0.0, 0.0
    for term in terms:
        term.add_gradient(system.stage_positions, frozen[term], pull := np.zeros_like(system.x))
        work += float(np.vdot(pull[:n], moved))
        after += float(term.energies(system.x, frozen[term]).sum())
    gain, stored = (float(value) for value in system.points.global_sum(after - before - work, after))
    left = max(surplus_before + gain, -stored)
    if not left > 0.0:
        return left
    impulse = np.zeros_like(system.x)
    for term in terms:
        _add_impulses(term, system, frozen[term], impulse)
    system.points.add_to_owners(impulse)
    impulse = np.where(system.prescribed.free, impulse[:n], 0.0)
    mass = system.mass[:, None]
    change = np.divide(impulse, mass, out=np.zeros_like(impulse), where=mass > 0.0)
    local = float(np.vdot(impulse, change)), float(np.vdot(impulse, system.v[:n]))
    square, rate = (float(value) for value in system.points.global_sum(*local))
    if not square > 0.0:
        return left
    # ½ square s² + rate s = −left, or as near to that as can be
    inside = max(rate * rate - 2.0 * square * left, 0.0)
    size = (-rate + math.copysign(math.sqrt(inside), rate)) / square
    system.state.set(system.x[:n], system.v[:n] + size * change)
    return left + (0.5 * square * size + rate) * size


def _add_impulses(term: Elastic, system: StageEquations, frozen: Any, out: Array) -> None:
    """Add impulses, up to a factor, to rows of out (n_local, 3), between what touches at the stage of the
    pairs that this rank counts.
    """
    points, beta, normal, force, _ = term.contact_points(system.stage_positions, frozen)
    sheet = points >= 0
    between = sheet.all(axis=1)
    beta = np.where(sheet, beta, 0.0)
    rows = np.where(sheet, points, 0)
    apart = np.einsum("ei,eik->ek", beta[between], system.x[rows[between]])
    normal = normal.copy()
    normal[between] = apart / np.maximum(np.linalg.norm(apart, axis=1), np.finfo(float).tiny)[:, None]
    np.add.at(out, rows, (force[:, None] * beta)[:, :, None] * normal[:, None, :])


def damp_impacts(system: StageEquations) -> Damped:
    """Damp the rates at which distances in contact change; collective.

    Impulses −w r of a pair with the rate r, w/m = 1 − e^−q, q = 2 ζ √(Δt² b″/m), which is a dashpot's in Δt
    and keeps second order; m as `_inverse_masses` has it, so that no impulse is too large.
    """
    layout, n, dt, felt = system.points, system.points.n_owned, system.dt, np.zeros(system.points.n_owned)
    every = [term.dashpots(system.x, system.active.frozen[term]) for term in system.active.limiting]
    if not any(layout.global_max(sum(len(pairs.points) for pairs in every))):
        held = np.zeros(len(system.prescribed.indices))
        return Damped(felt, held, 0.0, 0.0, np.empty(0, dtype=np.int64), *np.empty((2, 0, 3)))
    # each is that of the rank of one vertex, which knows all pairs with the same nearest points
    mine = [np.empty(len(pairs.points), dtype=bool) for pairs in every]
    for pairs, own in zip(every, mine, strict=True):
        dashpots.find_own(*pairs[:2], pairs.vertex, layout.global_number, n, own)
    sheets = _between_sheets_too(system)
    inverse = _inverse_masses(system, [(*pairs[:2], own) for pairs, own in zip(every, mine, strict=True)])
    work, impulse, pushes = 0.0, np.zeros_like(system.x), []
    for pairs, own in zip(every, mine, strict=True):
        push = np.empty(len(own))
        given = *pairs[:4], pairs.pushed, own, dt, DAMPING
        dashpots.damp(system.v, inverse, *given, push, impulse)
        vertex = np.flatnonzero(own & (pairs.vertex >= 0) & (sheets | (pairs.obstacle >= 0)))
        felt += np.bincount(pairs.vertex[vertex], push[vertex] / dt, minlength=n)
        work += float(push @ pairs.pushed) / dt
        on = np.flatnonzero(own & (pairs.obstacle >= 0))
        force = (push[on] / dt)[:, None] * pairs.normal[on]
        pushes.append(_on_obstacles(system, pairs.points[on], pairs.beta[on], pairs.obstacle[on], force))
    held, heat = _give(system, impulse, work)
    return Damped(felt, held, work, heat, *(np.concatenate(part) for part in zip(*pushes, strict=True)))


def make_up_friction(system: StageEquations, term: Elastic, damped: Damped) -> Damped:
    """Give what slides the friction that it lacks, or take back what it had too much, by impulses; what all
    impulses of the step did; collective.

    No pair is turned round by more friction, nor more than twice as fast by less: both are at most its speed
    times m of `_inverse_masses`. Friction of a light vertex that others press on an obstacle's edge is
    balanced by them: all of it back would throw the vertex off. Friction has no moment where the step begins;
    what it and these impulses have of it elsewhere is taken back under the midpoint rule, so that angular
    momentum stays as it is.
    """
    stage, x, dt = system.stage_positions, system.x, system.dt
    frozen, sheets = system.active.frozen[term], _between_sheets_too(system)
    corrections = term.friction_corrections(stage, x, system.v, frozen, damped.felt, dt, sheets=sheets)
    points, beta, along, ways, more, obstacle, moved = corrections
    pairs, moments = np.empty((0, 4), dtype=np.int64), np.empty((0, 3))
    if system.integrator.exact_work:
        pairs, moments = term.moments(stage, frozen)
    if not any(system.points.global_max(float(np.abs(more).max(initial=0.0)), len(pairs))):
        return damped
    impulse = np.zeros_like(x)
    size = np.linalg.norm(ways, axis=2)
    inverse = _inverse_masses(system, [(points, size, more != 0.0)])
    speed = np.einsum("eik,eik->e", system.v[points], ways) - np.einsum("ek,ek->e", moved, along) / dt
    most = np.where((size != 0.0)[:, :, None], inverse[points], 0.0).max(axis=(1, 2), initial=0.0)
    stops = np.divide(np.maximum(speed, 0.0), dt * most, out=np.zeros_like(speed), where=most > 0.0)
    push = -np.clip(more, -stops, stops)
    force, impulses = push[:, None] * along, (dt * push)[:, None, None] * ways
    np.add.at(impulse, points, impulses)
    if system.integrator.exact_work:
        between = obstacle < 0
        theirs = np.cross(x[points[between]], impulses[between]).sum(axis=1)
        pairs, moments = np.concatenate([pairs, points[between]]), np.concatenate([dt * moments, theirs])
        dashpots.add_couples(x, pairs, -moments, impulse)
    work, on = float(np.vdot(force, moved)), obstacle >= 0
    pushed = _on_obstacles(system, points[on], beta[on], obstacle[on], force[on])
    held, heat = _give(system, impulse, work)
    return Damped(
        damped.felt,
        damped.held + held,
        damped.work + work,
        damped.heat + heat,
        *(np.concatenate(part) for part in zip(damped[4:], pushed, strict=True)),
    )


def _between_sheets_too(system: StageEquations) -> bool:
    """Whether friction between sheets follows their normal forces, too: of a stage before the step's end."""
    return system.stage.offset < system.dt


def _inverse_masses(system: StageEquations, every: Iterable[tuple[Ints, Array, NDArray[np.bool_]]]) -> Array:
    """1/m (n_local, 3) [1/kg] of the parts of vertices' masses that one pair may stop; 0 of what is held;
    collective.

    ``every`` are points, β and which are this rank's. As Σ_e w_e a_e a_eᵀ with w_e ≤ m_e is not beyond the
    mass matrix for m_e the least over a pair's vertices of mass over Σ_e |β_ei| Σ_j |β_ej|, with all pairs e,
    impulses of all of them together turn nothing round, however many pairs a vertex has.
    """
    n, mass = system.points.n_owned, system.mass[:, None]
    shared, inverse = np.zeros((2, *system.x.shape))
    for points, beta, own in every:
        dashpots.share(points, beta, own, shared)
    system.points.add_to_owners(shared)
    free = system.prescribed.free & (mass > 0.0)
    np.divide(shared[:n, :1], mass, out=inverse[:n], where=free)
    system.points.update_ghosts(inverse)
    return inverse


def _on_obstacles(
    system: StageEquations, points: Ints, beta: Array, obstacle: Ints, force: Array
) -> tuple[Ints, Array, Array]:
    """Obstacles of pairs, where (m, 3) [m] they are pushed, and the force on them, where a sheet is pushed by
    ``force`` (m, 3) [N] times β.
    """
    of_sheet = np.where(points >= 0, beta, 0.0)
    side = of_sheet.sum(axis=1, keepdims=True)
    at = np.einsum("ei,eik->ek", of_sheet, system.x[np.maximum(points, 0)]) / side
    return obstacle, at, -side * force


def _give(system: StageEquations, impulse: Array, work: float) -> tuple[Array, float]:
    """Let impulses (n_local, 3) [N s] change the velocities; mean forces [N] of handles against them, and how
    much of the ``work`` [J] of obstacles, and of kinetic energy, became heat; collective.
    """
    n, mass = system.points.n_owned, system.mass[:, None]
    system.points.add_to_owners(impulse)
    # what is held goes on, against its part of the impulses; what is not loses or gains
    free = system.prescribed.free & (mass > 0.0)
    change = np.divide(impulse[:n], mass, out=np.zeros_like(impulse[:n]), where=free)
    heat = work - float(np.vdot(impulse[:n], system.v[:n] + 0.5 * change))
    system.state.set(system.x[:n], system.v[:n] + change)
    system.integrator.shift_past_velocities(change)
    return -impulse[:n].take(system.prescribed.indices) / system.dt, heat
