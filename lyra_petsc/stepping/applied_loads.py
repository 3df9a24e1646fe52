"""Loads, which are constant within a step, and their factor in a static analysis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.points import Layout
from lyra_petsc.terms.term import Load

if TYPE_CHECKING:
    from lyra_petsc.stepping.statics.following_loads import FollowingLoads


class AppliedLoads:
    """The loads of the present step.

    Parameters
    ----------
    terms : sequence of Load

    Attributes
    ----------
    force : (n_owned, 3)
        Force [N] of the present step.
    factor : float
        Load factor (1 in a motion).
    unbalanced : (n_owned, 3) or None
        Static: force [N] that holds the start shape in balance, reduced as the factor grows.
    override : (n_owned, 3) or None
        Static: force [N] in place of the loads of the next step.
    following : FollowingLoads or None
        Static: change of loads that follow the shape within a solve.
    """

    def __init__(self, terms: Sequence[Load], layout: Layout) -> None:
        self._terms = terms
        self.force: Array = np.zeros((layout.n_owned, 3))
        self.factor = 1.0
        self.unbalanced: Array | None = None
        self.override: Array | None = None
        self.following: FollowingLoads | None = None

    def force_at(self, x: Array) -> Array:
        """Force (n_owned, 3) [N] at positions x (n_local, 3) within a solve."""
        if self.following is None:
            return self.force
        force = self.force.copy()
        self.following.add_force(x, force)
        return force

    def freeze(self, t0: float, t1: float, x: Array, wind: Array | None) -> None:
        """Compute the loads of a step from t0 to t1 [s] at positions x (n_local, 3).

        ``wind`` (n_owned, 3) [N] is the gradient of velocity potentials, if these count as loads.
        """
        force = np.zeros_like(x)
        for load in self._terms:
            load.add_force(x, t0, t1, force)
        self.force = force[: len(self.force)]
        if wind is not None:
            self.force -= wind
        self.force *= self.factor
        if self.unbalanced is not None:
            self.force += (1.0 - self.factor) * self.unbalanced
