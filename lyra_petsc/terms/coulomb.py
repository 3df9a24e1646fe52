"""Dry friction within the fabric: elastic up to a limit, and beyond it sliding.

A pair of energy and force of a strain q that has slid to q_p, with the limit M and the give q_y::

    energy = ½ (M/q_y) u²  for |u| ≤ q_y, u = q − q_p,    M (|u| − q_y/2)  beyond
    after the step  q_p ← q − u min(1, q_y/|u|)

The energy is convex with a continuous slope, which never exceeds M: minimising it in a step with the rest is
backward Euler for perfect plasticity, the return mapping of J. C. Simo & T. J. R. Hughes, Computational
Inelasticity, Springer 1998, ch. 1. What is stored is the elastic part ½ (M/q_y) u² with |u| ≤ q_y, the rest,
M (|u| − q_y), turns into heat when the step is accepted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array

LEAST = 1e-14
"""Stiffness of what slides, over that of what sticks, where a parabola stands for it."""


class Friction(NamedTuple):
    """Limit M and give q_y of elements, (E,) each."""

    limit: Array
    give: Array

    def parabola(self, u: Array) -> tuple[Array, Array]:
        """k and c (E,): the parabola k c² has the energy at u, and 2 k c the force."""
        size = np.abs(u)
        sticks = size <= self.give
        half = np.where(sticks, size, 2.0 * (size - 0.5 * self.give))
        k = 0.5 * self.limit / np.where(sticks, self.give, half)
        return k, np.copysign(half, u)

    def tangent(self, u: Array, blend: float) -> tuple[Array, Array]:
        """k and c (E,): 2 k is the second derivative at u, with ``blend`` of 2 k of `parabola`; 2 k c the
        force."""
        k, c = self.parabola(u)
        force = 2.0 * k * c
        exact = np.where(np.abs(u) <= self.give, k, LEAST * self.limit / self.give)
        mixed = (1.0 - blend) * exact + blend * k
        return mixed, 0.5 * force / mixed

    def slid(self, u: Array) -> Array:
        """By how much q_p changes (E,) when the step is accepted."""
        return np.copysign(np.maximum(np.abs(u) - self.give, 0.0), u)
