"""Loads of a step, and what a static analysis makes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.terms.term import Load, UpcomingStep

if TYPE_CHECKING:
    from lyra_petsc.stepping.statics.following_loads import FollowingLoads


@dataclass(frozen=True, eq=False)
class StepLoads:
    """The loads of a step.

    Attributes
    ----------
    force : (n_owned, 3)
        Force [N], constant in the step.
    following : FollowingLoads or None
        Change of loads that follow the shape of the sheet.
    """

    force: Array
    following: FollowingLoads | None = None

    def force_at(self, x: Array) -> Array:
        """Force (n_owned, 3) [N] at positions x (n_local, 3) within a solve."""
        if self.following is None:
            return self.force
        force = self.force.copy()
        self.following.add_force(x, force)
        return force


@dataclass(frozen=True, eq=False)
class LoadCase:
    """What a static analysis makes of the loads; a motion takes them as they are.

    Attributes
    ----------
    unbalanced : (n_owned, 3) or None
        Force [N] that holds the start shape in balance, reduced as the load factor grows.
    override : (n_owned, 3) or None
        Force [N] in place of the loads.
    following : FollowingLoads or None
        Change of loads that follow the shape within a solve.
    """

    unbalanced: Array | None = None
    override: Array | None = None
    following: FollowingLoads | None = None

    def loads(self, terms: Sequence[Load], step: UpcomingStep, n_owned: int, wind: Array | None) -> StepLoads:
        """The loads of a step.

        ``wind`` (n_owned, 3) [N] is the gradient of velocity potentials, if these count as loads.
        """
        if self.override is not None:
            return StepLoads(self.override, self.following)
        every = np.zeros_like(step.x)
        for load in terms:
            load.add_force(step, every)
        force = every[:n_owned]
        if wind is not None:
            force -= wind
        if self.unbalanced is not None:
            force += (1.0 - step.target_time) * self.unbalanced
        return StepLoads(force, self.following)
