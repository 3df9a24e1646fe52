"""Consistency of friction with the normal forces of an equilibrium.

Friction in a solve takes the normal forces of the solve before. Solves in which points slip far while normal
forces change are therefore repeated with a shorter Δτ, and a load step repeats its solves until these are
close to the normal forces in the equilibrium. If all contacts slide there may be none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.stage_equations import StageEquations

LAG, MAX_ROUNDS = 1e-3, 10
"""Fraction by which friction may differ from what the normal forces of the equilibrium allow, and largest
number of updates to reach it."""

MAX_SLIP = 0.1
"""Largest slip in a solve times the change of normal forces, over these and the mean edge length."""

SLIDES, MAX_SLIDING = 0.95, 3
"""Fraction of the allowed friction from which on all contacts slide, and number of failed load steps with
sliding after which smaller ones are not tried."""


class FrictionBalance:
    """The friction of a load step, and the number of failed steps in which all contacts slid; collective.

    Attributes
    ----------
    lag : float
        Error of the friction in the last equilibrium, as a fraction of what its normal forces allow.
    in_vain : bool
        Whether so many load steps failed with sliding that a smaller one would not help.
    """

    def __init__(self, system: StageEquations, spacing: float) -> None:
        self._system, self._spacing = system, spacing
        self._acts = system.contact is not None and system.contact.friction is not None
        self.lag = 0.0
        self._rounds = self._sliding_steps = 0
        self._sliding_increment = 0.0  # the last increment of the load factor in which all slid

    def begin_step(self) -> None:
        """Begin a load step."""
        self.lag, self._rounds = 0.0, 0

    def lags(self, begin: Array) -> bool:
        """Whether points slipped too far in the solve from positions ``begin`` (n_owned, 3) [m]; collective.

        Friction may have been far from what the normal forces allow.
        """
        if not (self._acts and self._system.near):
            return False
        x, points = self._system.x, self._system.points
        displacement = x.copy()
        displacement[: len(begin)] -= begin
        points.update_ghosts(displacement)
        slip, normal = points.global_sum(*self._system.active.slip_under_changed_forces(x, displacement))
        return bool(slip > MAX_SLIP * self._spacing * normal)

    def is_settled(self) -> bool:
        """Whether friction needs no further update in a state that is balanced otherwise; collective."""
        self.lag = self._sums()[0]
        self._rounds += 1
        return self.lag <= LAG or self._rounds > MAX_ROUNDS

    def record_success(self, increment: float) -> None:
        """Note that a load step of this increment of the load factor found an equilibrium."""
        if increment >= self._sliding_increment:
            self._sliding_steps, self._sliding_increment = 0, 0.0

    def record_failure(self, increment: float) -> str:
        """Note that a load step of this increment failed; a message if all contacts slide, else ''."""
        self.lag = 0.0
        message = self.sliding_message()
        if message:
            self._sliding_steps, self._sliding_increment = self._sliding_steps + 1, increment
        return message

    def sliding_message(self) -> str:
        """Text that names the contacts which slide now, or an empty one; collective."""
        return self._sums()[1]

    @property
    def in_vain(self) -> bool:
        return self._sliding_steps >= MAX_SLIDING

    def saved_state(self) -> dict[str, Any]:
        """Entries of a checkpoint, for `restore`."""
        return {"slid": self._sliding_steps, "slid_in": self._sliding_increment}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Restore a `saved_state`."""
        self._sliding_steps, self._sliding_increment = saved["slid"], saved["slid_in"]

    def _sums(self) -> tuple[float, str]:
        """Error of the friction as in `lag`, and the text of `sliding_message`; collective."""
        sums = self._system.active.friction_lag(self._system.x)
        if not sums:
            return 0.0, ""
        each = self._system.points.global_sum(*np.concatenate(list(sums.values()))).reshape(-1, 3)
        slides = [
            f"it slides on {name}" if name else "sheets slide on each other"
            for name, (_, friction, allowed) in zip(sums, each, strict=True)
            if friction > SLIDES * allowed > 0.0
        ]
        wrong, friction, allowed = each.sum(axis=0)
        message = f"{' and '.join(slides)}, with {friction:.3g} N of friction" if slides else ""
        return float(wrong / max(allowed, np.finfo(float).tiny)), message
