"""A value in time that a program continues step by step."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.scene.time_curve import TimeCurve


@dataclass(frozen=True, eq=False)
class DrivenCurve(TimeCurve):
    """The scene's own value until a program continues it.

    Attributes
    ----------
    continued : list of TimeCurve
        Continuations; the last one holds.
    """

    continued: list[TimeCurve] = field(default_factory=list)

    def at(self, time: float) -> Array:
        """The value, () or (3,), at a time [s]."""
        return self.continued[-1].at(time) if self.continued else super().at(time)

    @property
    def varies(self) -> bool:
        """True, as the program may change it."""
        return True

    @property
    def acts(self) -> bool:
        """True, as the program may change it."""
        return True

    def saved_state(self) -> list[TimeCurve]:
        """What `restore` returns to."""
        return self.continued.copy()

    def restore(self, saved: list[TimeCurve]) -> None:
        """Return to a `saved_state`."""
        self.continued[:] = saved

    def go_to(self, value: Array, now: float, time: float) -> None:
        """Go from the value ``now`` [s] to another in a straight line until ``time``, or at once."""
        if time > now:
            curve = TimeCurve(np.array([now, time]), np.array([self.at(now), value]))
        else:
            curve = TimeCurve(np.array([now]), np.array([value]))
        self.continued[:] = [curve]
