"""Impacts: what is done to velocities at the end of a step where something touches.

**All integrators**: the barrier is no spring to bounce on. `damp_impacts` damps the rates at which distances
in contact change by dashpots of half the critical damping of barrier and mass, along the lines between
nearest points. What meets parts with about a tenth of its speed, whatever Δt is, and comes to rest within a
few periods of the barrier; what lies, slides or rolls at the same distance is not damped. (Without it sheets
bounce for long under backward Euler with short steps, and with any under integrators of second order; and
what bounces slides on where it should stand, as its normal force is too small every other moment.)

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
from typing import Any, NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms import dashpots
from lyra_petsc.terms.term import Elastic

DAMPING = 0.5
"""Of the distances in contact, over the critical one."""


class Damped(NamedTuple):
    """What dashpots did in a step, on this rank.

    Attributes
    ----------
    felt : (n_owned,)
        Mean forces [N] on vertices that meet something.
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
    gain, stored = (float(value) for value in system.points.summed(after - before - work, after))
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
    square, rate = (float(value) for value in system.points.summed(*local))
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
    points, beta, normal, force, _ = term.touching_points(system.stage_positions, frozen)
    sheet = points >= 0
    between = sheet.all(axis=1)
    beta = np.where(sheet, beta, 0.0)
    rows = np.where(sheet, points, 0)
    apart = np.einsum("ei,eik->ek", beta[between], system.x[rows[between]])
    normal = normal.copy()
    normal[between] = apart / np.maximum(np.linalg.norm(apart, axis=1), np.finfo(float).tiny)[:, None]
    np.add.at(out, rows, (force[:, None] * beta)[:, :, None] * normal[:, None, :])


def normal_forces(system: StageEquations) -> Array | None:
    """Normal forces (n_owned,) [N] on vertices that meet something, at the stage of the step just taken; None
    where that is its end.
    """
    if system.stage.after == system.dt:
        return None
    out = np.zeros(system.points.n_owned)
    for term in system.active.limiting:
        *_, force, vertex = term.touching_points(system.stage_positions, system.active.frozen[term])
        out += np.bincount(vertex[vertex >= 0], force[vertex >= 0], minlength=len(out))
    return out


def damp_impacts(system: StageEquations) -> Damped:
    """Damp the rates at which distances in contact change; collective.

    Impulses −w r of a pair with the rate r, w/m = 1 − e^−q, q = 2 ζ √(Δt² b″/m), which is a dashpot's in Δt
    and keeps second order. As Σ_e w_e a_e a_eᵀ is not beyond the mass matrix for m the least over the pair's
    vertices of mass over Σ_e |β_ei| Σ_j |β_ej|, with all pairs e, no impulse is too large, however many pairs
    a vertex has.
    """
    layout, free = system.points, system.prescribed.free
    n, dt, felt = layout.n_owned, system.dt, np.zeros(layout.n_owned)
    every = [term.dashpots(system.x, system.active.frozen[term]) for term in system.active.limiting]
    if not any(layout.largest(sum(len(pairs.points) for pairs in every))):
        held = np.zeros(len(system.prescribed.at))
        return Damped(felt, held, 0.0, 0.0, np.empty(0, dtype=np.int64), *np.empty((2, 0, 3)))
    # each is that of the rank of one vertex, which knows all pairs with the same nearest points
    mine = [np.empty(len(pairs.points), dtype=bool) for pairs in every]
    shared, inverse, impulse = np.zeros((3, *system.x.shape))
    for pairs, own in zip(every, mine, strict=True):
        dashpots.find_own(*pairs[:2], pairs.vertex, layout.global_number, n, own)
        dashpots.share(*pairs[:2], own, shared)
    layout.add_to_owners(shared)
    mass = system.mass[:, None]
    free = free & (mass > 0.0)
    np.divide(shared[:n, :1], mass, out=inverse[:n], where=free)  # 0 of what is held
    layout.update_ghosts(inverse)
    work, obstacle, at, force = 0.0, [], [], []
    for pairs, own in zip(every, mine, strict=True):
        push = np.empty(len(own))
        given = *pairs[:4], pairs.pushed, own, dt, DAMPING
        dashpots.damp(system.v, inverse, *given, push, impulse)
        vertex = np.flatnonzero(own & (pairs.vertex >= 0))
        felt += np.bincount(pairs.vertex[vertex], push[vertex] / dt, minlength=n)
        work += float(push @ pairs.pushed) / dt
        on = np.flatnonzero(own & (pairs.obstacle >= 0))
        beta = np.where(pairs.points[on] >= 0, pairs.beta[on], 0.0)
        side, corners = beta.sum(axis=1), system.x[np.maximum(pairs.points[on], 0)]
        obstacle.append(pairs.obstacle[on])
        at.append(np.einsum("ei,eik->ek", beta, corners) / side[:, None])
        force.append(-(push[on] * side / dt)[:, None] * pairs.normal[on])
    layout.add_to_owners(impulse)
    change = np.divide(impulse[:n], mass, out=np.zeros_like(impulse[:n]), where=free)
    # what is held goes on, against its part of the impulses; what is not loses or gains
    heat = work - float(np.vdot(impulse[:n], system.v[:n] + 0.5 * change))
    system.state.set(system.x[:n], system.v[:n] + change)
    system.integrator.take_jump(change)
    held = -impulse[:n].take(system.prescribed.at) / dt
    return Damped(felt, held, work, heat, *(np.concatenate(part) for part in (obstacle, at, force)))
