"""The stress that the Jacobian takes at Newton's iterate: predicted from the iterate before.

The strain is linearised at the iterate before, as in a mixed method: stiff sheets then converge as fast as
soft ones. (Magisano, Leonetti & Garcea, Comput. Meth. Appl. Mech. Engng 313, 2017.)
"""

from __future__ import annotations

from lyra_petsc.arrays import Array


class PredictedStress:
    """The iterates from which the stress is predicted.

    Attributes
    ----------
    positions : ((n_local, 3), (n_local, 3)) or None
        Positions [m] where the strain is linearised, and positions at which this linearisation is taken; None
        before the second iterate.
    """

    positions: tuple[Array, Array] | None = None
    _iterate: Array | None = None
    _uncorrected: Array | None = None
    _at_state = False

    def forget(self) -> None:
        """Forget all iterates."""
        self.positions = self._iterate = self._uncorrected = None
        self._at_state = False

    def set_iterate(self, x: Array) -> None:
        """Take Newton's iterate x (n_local, 3) [m], and predict its stress from the iterate before."""
        before, self._iterate = self._iterate, x.copy()
        reached = self._iterate if self._uncorrected is None else self._uncorrected
        self.positions = None if before is None else (before, before if self._at_state else reached)
        self._uncorrected, self._at_state = None, False

    def take_uncorrected(self, x: Array) -> None:
        """Predict the stress of the next iterate at x (n_local, 3) [m], where it was before a correction."""
        self._uncorrected = x.copy()

    def take_state(self, x: Array) -> None:
        """Let the first Jacobian take the stress of the state x (n_local, 3) [m]."""
        self._iterate, self._at_state = x.copy(), True
