"""Whether friction in an equilibrium is what normal forces there allow.

A sheet that comes to lie on something in a load step is held there by the forces found on the way. They are
taken anew until they are near those that the equilibrium has; where all slides there may be none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lyra_petsc.stepping.stage_equations import StageEquations

LAG, MOST_ROUNDS = 1e-3, 10
"""Part of the friction that may be other than normal forces in the equilibrium allow; how often it is taken
anew for that, at most."""

SLIDES, MOST_SLID = 0.95, 3
"""Part of the friction allowed from which on all slides; after how many load steps without an equilibrium
where it does a smaller one is no help."""


class FrictionBalance:
    """Friction of the load step that is taken, and whether all slid in those before; collective.

    Attributes
    ----------
    lag : float
        Part of what normal forces allow that is not known of the friction in the last equilibrium.
    in_vain : bool
        Whether all slid in so many load steps that a smaller one is no help.
    """

    def __init__(self, system: StageEquations) -> None:
        self._system = system
        self.lag = 0.0
        self._rounds = self._slid = 0
        self._slid_in = 0.0  # the last increment of the load factor in which all slid

    def begin(self) -> None:
        """Begin a load step."""
        self.lag, self._rounds = 0.0, 0

    def settled(self) -> bool:
        """Whether friction need not be taken anew in an equilibrium but for that."""
        self.lag = self._sums()[0]
        self._rounds += 1
        return self.lag <= LAG or self._rounds > MOST_ROUNDS

    def found(self, increment: float) -> None:
        """There is an equilibrium so much of the load factor farther on."""
        if increment >= self._slid_in:
            self._slid, self._slid_in = 0, 0.0

    def lost(self, increment: float) -> str:
        """There is none, since all slides, as these words tell; or for another reason."""
        self.lag = 0.0
        words = self.slides()
        if words:
            self._slid, self._slid_in = self._slid + 1, increment
        return words

    def slides(self) -> str:
        """What slides now, in words."""
        return self._sums()[1]

    @property
    def in_vain(self) -> bool:
        return self._slid >= MOST_SLID

    def memory(self) -> dict[str, Any]:
        """What to go on with after a restart."""
        return {"slid": self._slid, "slid_in": self._slid_in}

    def restore(self, memory: Mapping[str, Any]) -> None:
        """Go on with a memory; an older one is empty."""
        self._slid = int(memory.get("slid", self._slid))
        self._slid_in = float(memory.get("slid_in", self._slid_in))

    def _sums(self) -> tuple[float, str]:
        """Friction that normal forces now do not allow, over what they allow, and in words what slides."""
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
        words = f"{' and '.join(slides)}, with {friction:.3g} N of friction" if slides else ""
        return float(wrong / max(allowed, np.finfo(float).tiny)), words
