"""Dry friction within the fabric: elastic up to a limit, and sliding beyond it.

For a strain q that has slid to q_p, with the limit M (a force or moment) and the yield strain q_y::

    energy = ½ (M/q_y) u²  for |u| ≤ q_y, u = q − q_p,    M (|u| − q_y/2)  beyond
    after the step  q_p ← q − u min(1, q_y/|u|)

The energy is convex with a continuous slope that never exceeds M. To minimise it in a step together with the
other energies is backward Euler for perfect plasticity, the return mapping of J. C. Simo & T. J. R. Hughes,
Computational Inelasticity, Springer 1998, ch. 1. The elastic part ½ (M/q_y) u² with |u| ≤ q_y is stored; the
rest, M (|u| − q_y), turns into heat when the step is accepted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.terms.protocols import AT_LIMIT

MIN_STIFFNESS = 1e-14
"""Tangent stiffness of sliding elements over that of sticking ones, where it is replaced by a parabola."""


class FrictionLimits(NamedTuple):
    """Limit M and yield strain q_y of elements, (E,) each."""

    limit: Array
    yield_strain: Array

    def parabola(self, u: Array) -> tuple[Array, Array]:
        """k and c (E,) such that k c² is the energy at u and 2 k c the force."""
        size = np.abs(u)
        sticks = size <= self.yield_strain
        c = np.where(sticks, size, 2.0 * (size - 0.5 * self.yield_strain))
        k = 0.5 * self.limit / np.where(sticks, self.yield_strain, c)
        return k, np.copysign(c, u)

    def tangent(self, u: Array, convexity: float) -> tuple[Array, Array]:
        """k and c (E,) such that 2 k c is the force at u and 2 k the second derivative, mixed with
        ``convexity`` times 2 k of `parabola`.
        """
        k, c = self.parabola(u)
        force = 2.0 * k * c
        exact = np.where(np.abs(u) <= self.yield_strain, k, MIN_STIFFNESS * self.limit / self.yield_strain)
        mixed = (1.0 - convexity) * exact + convexity * k
        return mixed, 0.5 * force / mixed

    def moved(self, *, yields: bool) -> FrictionLimits:
        """Limits that all elements at theirs are beyond, or else below."""
        factor = 1.0 - AT_LIMIT if yields else 1.0 + AT_LIMIT
        return FrictionLimits(factor * self.limit, factor * self.yield_strain)

    def slid(self, u: Array) -> Array:
        """Change of q_p (E,) when the step is accepted."""
        return np.copysign(np.maximum(np.abs(u) - self.yield_strain, 0.0), u)
