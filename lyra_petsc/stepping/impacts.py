"""Impacts under the midpoint rule: what contact would add to the energy is taken from the velocities.

The rule works with the forces at its stage, and a barrier that stiffens within a step stores less energy than
they take, or gives back more. The surplus of a step ::

    E(x_{n+1}) − E(x_n) − ∇E(x_s) · (x_{n+1} − x_n)

is summed up, negative no farther than what contact has stored, as only that comes back. What is above 0 is
taken from the kinetic energy by impulses between the pairs in contact, in proportion to their normal forces
and along the lines between their nearest points at the end of the step, so that momentum and angular momentum
stay as they are. (Energy by projection: Hairer, Lubich & Wanner, Geometric Numerical Integration, sec. IV.4.)
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.term import Elastic

Array = NDArray[np.float64]


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
    points, beta, normal, force = term.touching_points(system.stage_positions, frozen)
    sheet = points >= 0
    between = sheet.all(axis=1)
    beta = np.where(sheet, beta, 0.0)
    rows = np.where(sheet, points, 0)
    apart = np.einsum("ei,eik->ek", beta[between], system.x[rows[between]])
    normal = normal.copy()
    normal[between] = apart / np.maximum(np.linalg.norm(apart, axis=1), np.finfo(float).tiny)[:, None]
    np.add.at(out, rows, (force[:, None] * beta)[:, :, None] * normal[:, None, :])
